//! The scene's meshes among the voxels: read or extracted once, carried by breath in every frame.
//!
//! x = X + u(X) for each vertex, normals anew from the triangles. Edges stay straight, so they must be short beside the length over which u bends. What a tool
//! does to tissue moves no mesh. Cost: 0.1 µs a vertex and frame where the patient breathes; nothing elsewhere, and no memory in a scene without.

use crate::{RenderingError, organs};
use maille_raycast::MeshView;
use maille_scene::Scene;
use maille_surface::{Border, Mesh, decimate, marching_cubes_bricks, read_mesh};
use maille_volume::{BrickSource, BrickedVolume};
use rayon::prelude::*;
use std::path::Path;

/// Colours of meshes, in turn: organs and instruments as atlases have them.
const COLORS: [[f32; 3]; 6] =
    [[0.85, 0.35, 0.3], [0.4, 0.65, 0.9], [0.55, 0.8, 0.45], [0.95, 0.8, 0.4], [0.75, 0.5, 0.85], [0.8, 0.8, 0.8]];

/// The meshes of a scene.
#[derive(Default)]
pub struct Meshes {
    all: Vec<Carried>,
}

struct Carried {
    /// in the patient at rest
    rest: Vec<[f32; 3]>,
    /// where it is now
    now: Mesh,
    color: [f32; 3],
}

impl Meshes {
    /// Of a scene, in a volume at rest.
    ///
    /// # Errors
    /// When a mesh cannot be read, has no triangles, or is of an organ that is not there.
    pub fn of(scene: &Scene, rest: &impl BrickSource) -> Result<Self, RenderingError> {
        let mut all = Vec::with_capacity(scene.meshes.len());
        for (n, said) in scene.meshes.iter().enumerate() {
            let name = said.file.as_deref().map_or_else(|| said.organ.clone().unwrap_or_default(), |file| file.display().to_string());
            let fault = |reason: String| RenderingError::Mesh { name: name.clone(), reason };
            let mut mesh = match (&said.file, &said.organ) {
                (Some(file), _) => read(file).map_err(fault)?,
                (None, Some(organ)) => surface(scene, organ, rest)?,
                (None, None) => continue,
            };
            if let Some(triangles) = said.triangles {
                mesh = decimate(&mesh, triangles).map_err(|e| fault(e.to_string()))?.mesh;
            }
            if mesh.triangles.is_empty() {
                return Err(fault("it has no triangles".into()));
            }
            let color = said.color.map_or(COLORS[n % COLORS.len()], |c| c.map(|v| v as f32));
            all.push(Carried { rest: mesh.positions.clone(), now: mesh, color });
        }
        Ok(Self { all })
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Brings them to where the patient is.
    pub fn carry(&mut self, to_world: impl Fn([f64; 3]) -> [f64; 3] + Sync) {
        for Carried { rest, now, .. } in &mut self.all {
            let moved = rest.par_iter().with_min_len(1024).map(|p| to_world(p.map(f64::from)).map(|v| v as f32));
            moved.collect_into_vec(&mut now.positions);
            turn(now);
        }
    }

    /// As the ray caster takes them.
    pub fn views(&self) -> Vec<MeshView<'_>> {
        self.all
            .iter()
            .map(|c| MeshView { positions: &c.now.positions, normals: &c.now.normals, triangles: &c.now.triangles, color: c.color })
            .collect()
    }
}

/// Normals of a mesh's vertices from its triangles, each by its area.
fn turn(mesh: &mut Mesh) {
    mesh.normals.clear();
    mesh.normals.resize(mesh.positions.len(), [0.0; 3]);
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|v| mesh.positions[v as usize]);
        let (u, v): ([f32; 3], [f32; 3]) = (std::array::from_fn(|n| b[n] - a[n]), std::array::from_fn(|n| c[n] - a[n]));
        let area = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        for &vertex in t {
            (0..3).for_each(|n| mesh.normals[vertex as usize][n] += area[n]);
        }
    }
    for normal in &mut mesh.normals {
        let length = normal.iter().map(|v| v * v).sum::<f32>().sqrt();
        *normal = if length > 0.0 { normal.map(|v| v / length) } else { [0.0, 0.0, 1.0] };
    }
}

fn read(path: &Path) -> Result<Mesh, String> {
    let bytes = std::fs::read(path).map_err(|e| format!("it cannot be read: {e}"))?;
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    read_mesh(&bytes, ending).map_err(|e| e.to_string())
}

/// The surface of an organ, of its own field.
fn surface(scene: &Scene, name: &str, rest: &impl BrickSource) -> Result<Mesh, RenderingError> {
    let said = scene.organs.iter().find(|organ| organ.name == name);
    let said = said.ok_or_else(|| RenderingError::Organ { name: name.into(), reason: "there is none".into() })?;
    let found = organs::find(said, rest)?;
    let rescale = rest.info().rescale;
    let (mut low, mut high) = (i16::MAX, i16::MIN);
    for id in 0..rest.layout().count() as u32 {
        rest.brick(id).cells.iter().for_each(|[a, b]| (low, high) = (low.min(*a), high.max(*b)));
    }
    let band = (rescale.value(f64::from(high)) - rescale.value(f64::from(low))).abs().max(1.0);
    Ok(marching_cubes_bricks(&BrickedVolume::from_volume(&found.field(rest, &said.hu, band)), 0.0, Border::Closed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{compose::Composer, view::View};
    use maille_scene::BoxMm;
    use maille_transport::Untimed;
    use maille_volume::{Grid, Rescale, Volume};

    /// A ball of bone in soft tissue.
    fn ball() -> BrickedVolume {
        let mut grid = Grid::axis_aligned([48, 44, 40], [1.0; 3]);
        grid.origin = [-24.0, -22.0, -20.0];
        let voxels = (0..grid.voxel_count())
            .map(|n| {
                let p = grid.world_from_index([n % 48, n / 48 % 44, n / (48 * 44)].map(|v| v as f64));
                let r = p.iter().map(|v| v * v).sum::<f64>().sqrt();
                (40.0 + 960.0 / (1.0 + (2.0 * (r - 11.0)).exp())) as i16
            })
            .collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    /// Nothing of the volume is seen: no value is as high as its surface's.
    const SCENE: &str = "[rendering]\nmode = \"isosurface\"\nsize = [120, 90]\nfrom = [0.3, -1.0, 0.2]\n[deformation]\nthreshold_hu = 3000.0\nbone_hu = 3070.0\n\
                         [[organ]]\nname = \"bone\"\nhu = [[500.0, 3000.0]]\n[[mesh]]\norgan = \"bone\"\ncolor = [1.0, 0.2, 0.2]\n";

    fn drawn(scene: &Scene, bricks: &BrickedVolume, meshes: Meshes, eye_mm: [f64; 3]) -> Vec<u8> {
        let (mut scene, bounds) = (scene.clone(), BoxMm::of(&bricks.info().grid));
        let view = scene.rendering.view(&bounds);
        let lifted = |p: [f64; 3]| Some(std::array::from_fn(|c| p[c] + eye_mm[c]));
        (scene.rendering.eye, scene.rendering.target) = (lifted(view.eye), lifted(view.target));
        let mut composer = Composer::new(&scene);
        composer.meshes = meshes;
        composer
            .draw(bricks, None, &View::new(&scene, &bounds).expect("a view"), None, false, None, &mut Untimed)
            .expect("it can be drawn");
        composer.pictures[0].rgb.clone()
    }

    #[test]
    fn a_mesh_that_breath_carries_aside_is_the_mesh_seen_from_elsewhere() {
        let (bricks, scene) = (ball(), Scene::parse("meshes", SCENE).expect("a scene"));
        let of = || Meshes::of(&scene, &bricks).expect("the organ is there");
        let by = [3.0, -2.0, 6.0];
        let mut moved = of();
        moved.carry(|p| std::array::from_fn(|c| p[c] + by[c]));
        let (still, carried) = (drawn(&scene, &bricks, of(), [0.0; 3]), drawn(&scene, &bricks, moved, [0.0; 3]));
        let from_elsewhere = drawn(&scene, &bricks, of(), by.map(|v| -v));
        let differ = |a: &[u8], b: &[u8]| a.iter().zip(b).filter(|(a, b)| a.abs_diff(**b) > 24).count() as f64 / a.len() as f64;
        let (same, other) = (differ(&carried, &from_elsewhere), differ(&carried, &still));
        assert!(same < 0.003 && other > 0.02, "{same} {other}");
        let none = drawn(&scene, &bricks, Meshes::default(), [0.0; 3]);
        assert!(differ(&none, &still) > 0.02, "the mesh is seen");
    }

    #[test]
    fn what_swells_keeps_its_normals_outward_and_of_length_one() {
        let (bricks, scene) = (ball(), Scene::parse("meshes", SCENE).expect("a scene"));
        let mut meshes = Meshes::of(&scene, &bricks).expect("the organ is there");
        meshes.carry(|p| [1.2 * p[0], 1.2 * p[1], 1.2 * p[2]]);
        let view = meshes.views()[0];
        for (p, n) in view.positions.iter().zip(view.normals) {
            let (r, dot): (f32, f32) = (p.iter().map(|v| v * v).sum::<f32>().sqrt(), (0..3).map(|c| p[c] * n[c]).sum());
            assert!((r - 13.2).abs() < 0.3 && dot > 0.95 * r, "{p:?} {n:?}");
        }
    }

    #[test]
    fn a_mesh_that_is_not_there_is_said_with_its_name() {
        let mut scene = Scene::parse("meshes", SCENE).expect("a scene");
        (scene.meshes[0].organ, scene.meshes[0].file) = (None, Some("nowhere.stl".into()));
        let error = Meshes::of(&scene, &ball()).err().expect("no such file").to_string();
        assert!(error.contains("nowhere.stl") && error.contains("cannot be read"), "{error}");
    }
}
