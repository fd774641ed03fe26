//! Fewer triangles: quadric edge collapse [Garland & Heckbert 1997] with probabilistic quadrics [Trettner & Kobbelt 2020], by the `alum` crate.
//!
//! Collapses that would change the topology are refused there, so that a closed manifold stays one of its genus, and no part of it vanishes. Where
//! the parts' simplest forms are together more triangles than asked for, whole parts are left out, those of least area first, and counted; the largest
//! stays. Normals are taken anew from the triangles, by their area; every one is finite and of length one, also where triangles fold onto each other.
//! Smoothing is no step of its own: the window of the continuous function that the mesh is made from smooths
//! before there are triangles, and knows where the voxels were.
//!
//! Cost: some 3 µs a triangle, one thread. Not here: levels of detail.

use crate::{Mesh, mesh::norm};
use alum::{Adaptor, F64Adaptor, Handle, HasDecimation, HasIterators, HasTopology, PolyMeshF64, QuadricDecimater, QuadricType};

/// Why a mesh cannot be thinned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the mesh cannot be thinned: {reason}; write it whole")]
pub struct DecimateError {
    /// what the library says
    pub reason: String,
}

impl From<alum::Error> for DecimateError {
    fn from(error: alum::Error) -> Self {
        Self { reason: format!("{error:?}") }
    }
}

/// A mesh of fewer triangles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Thinned {
    /// the mesh
    pub mesh: Mesh,
    /// parts that the wanted number of triangles had no room for
    pub parts_left_out: usize,
}

/// The mesh with about `triangles` triangles; itself if it has no more.
///
/// # Errors
/// When an edge has more than two triangles, as it may in a mesh that was read from elsewhere.
pub fn decimate(mesh: &Mesh, triangles: usize) -> Result<Thinned, DecimateError> {
    if mesh.triangles.len() <= triangles {
        return Ok(Thinned { mesh: mesh.clone(), parts_left_out: 0 });
    }
    let mut half_edges = PolyMeshF64::with_capacity(mesh.positions.len(), mesh.triangles.len() * 3 / 2, mesh.triangles.len());
    // about the middle of the mesh, so that quadrics lose no digits far from the origin
    let count = mesh.positions.len() as f64;
    let middle: [f64; 3] = std::array::from_fn(|c| mesh.positions.iter().map(|p| f64::from(p[c])).sum::<f64>() / count);
    let points: Vec<_> = mesh.positions.iter().map(|p| F64Adaptor::vector(std::array::from_fn(|c| f64::from(p[c]) - middle[c]))).collect();
    let vertices: Vec<_> = half_edges.add_vertices(&points)?.collect();
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|v| vertices[v as usize]);
        half_edges.add_tri_face(a, b, c)?;
    }
    let mut decimater = QuadricDecimater::new(&half_edges, QuadricType::ProbabilisticTriangle)?;
    half_edges.decimate_to_face_count(&mut decimater, triangles)?;
    half_edges.garbage_collection()?;
    let points = half_edges.points();
    let points = points.try_borrow()?;
    let mut out = Mesh::default();
    for v in half_edges.vertices() {
        out.positions.push(std::array::from_fn(|c| (F64Adaptor::vector_coord(&points[v], c) + middle[c]) as f32));
    }
    for f in half_edges.faces() {
        let mut corners = half_edges.fv_ccw_iter(f).map(|v| v.index());
        out.triangles.push(std::array::from_fn(|_| corners.next().expect("a triangle has three corners")));
    }
    let parts_left_out = leave_out_smallest(&mut out, triangles);
    out.normals = normals(&out);
    Ok(Thinned { mesh: out, parts_left_out })
}

/// Normals of the vertices from their triangles, by area; where these cancel, that of the largest one; where none has an area, any.
fn normals(mesh: &Mesh) -> Vec<[f32; 3]> {
    let mut sums = vec![[0f64; 3]; mesh.positions.len()];
    let mut largest = sums.clone();
    let mut whole = vec![0f64; mesh.positions.len()];
    for t in &mesh.triangles {
        let area = mesh.doubled_area_vector(t);
        let size = norm(area);
        for v in t.map(|v| v as usize) {
            (0..3).for_each(|c| sums[v][c] += area[c]);
            whole[v] += size;
            if size > norm(largest[v]) {
                largest[v] = area;
            }
        }
    }
    let normal = |(n, sum): (usize, &[f64; 3])| {
        // what is left where triangles cancel is their rounding
        let chosen = if norm(*sum) > 1e-6 * whole[n] { *sum } else { largest[n] };
        let length = norm(chosen);
        if length > 0.0 { chosen.map(|v| (v / length) as f32) } else { [0.0, 0.0, 1.0] }
    };
    sums.iter().enumerate().map(normal).collect()
}

/// Takes parts out, the least area first, until no more triangles are left than wanted, or one part; tells how many. Normals are not looked at.
fn leave_out_smallest(mesh: &mut Mesh, wanted: usize) -> usize {
    if mesh.triangles.len() <= wanted {
        return 0;
    }
    // a forest of vertices, each tree a part
    let mut forest: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    fn root(forest: &mut [u32], mut v: u32) -> u32 {
        while forest[v as usize] != v {
            forest[v as usize] = forest[forest[v as usize] as usize];
            v = forest[v as usize];
        }
        v
    }
    for &[a, b, c] in &mesh.triangles {
        for (a, b) in [(a, b), (b, c)] {
            let (a, b) = (root(&mut forest, a), root(&mut forest, b));
            forest[a.max(b) as usize] = a.min(b);
        }
    }
    let part_of: Vec<u32> = (0..mesh.positions.len() as u32).map(|v| root(&mut forest, v)).collect();
    let mut area = vec![0f64; part_of.len()];
    let mut count = vec![0usize; part_of.len()];
    for t in &mesh.triangles {
        let part = part_of[t[0] as usize] as usize;
        area[part] += norm(mesh.doubled_area_vector(t));
        count[part] += 1;
    }
    let mut parts: Vec<usize> = (0..part_of.len()).filter(|&part| count[part] > 0).collect();
    parts.sort_by(|&a, &b| area[a].total_cmp(&area[b]).then(a.cmp(&b)));
    let mut left = mesh.triangles.len();
    let mut gone = vec![false; part_of.len()];
    let mut left_out = 0;
    for &part in &parts[..parts.len() - 1] {
        if left <= wanted {
            break;
        }
        left -= count[part];
        gone[part] = true;
        left_out += 1;
    }
    let stays = |v: u32| !gone[part_of[v as usize] as usize];
    mesh.triangles.retain(|t| stays(t[0]));
    // vertices closer together, in their order
    let mut number = vec![0u32; part_of.len()];
    let mut positions = Vec::with_capacity(mesh.positions.len());
    for (v, p) in mesh.positions.iter().enumerate() {
        number[v] = positions.len() as u32;
        if stays(v as u32) {
            positions.push(*p);
        }
    }
    mesh.positions = positions;
    mesh.triangles.iter_mut().for_each(|t| *t = t.map(|v| number[v as usize]));
    left_out
}
