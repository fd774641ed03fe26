//! The scene's organs: labels of the patient at rest, found once at the start, held by the process that draws alone.
//!
//! `maille-surface` finds them; here is what a scene says of them. An organ that comes later in the scene takes what two have. One byte a voxel, only in a scene
//! that has organs.

use crate::RenderingError;
use maille_raycast::Labels;
use maille_scene::{BoxMm, Scene};
use maille_surface::{Organ, Selection, organ};
use maille_volume::BrickSource;

/// The scene's organs, one of which may be shown alone: then everything else lets light through.
pub struct Organs {
    labels: Labels,
    colors: [[f32; 4]; 256],
    count: usize,
    alone: usize,
}

/// Labels of the scene's organs, numbered from 1; `None` in a scene without.
///
/// # Errors
/// When an organ is not there, by its name.
pub fn organs(scene: &Scene, rest: &impl BrickSource) -> Result<Option<Organs>, RenderingError> {
    if scene.organs.is_empty() {
        return Ok(None);
    }
    let grid = &rest.info().grid;
    let mut voxels = vec![0u8; grid.voxel_count()];
    for (n, said) in scene.organs.iter().enumerate() {
        let found = find(said, rest)?;
        for (label, inside) in voxels.iter_mut().zip(&found.labels) {
            if *inside != 0 {
                *label = n as u8 + 1;
            }
        }
    }
    let labels = Labels::new(grid.size, voxels).map_err(|reason| RenderingError::Organ { name: "all".into(), reason })?;
    // colours as they are where nothing is alone
    let colors = labels.colors;
    Ok(Some(Organs { labels, colors, count: scene.organs.len(), alone: 0 }))
}

impl Organs {
    /// Shows an organ alone, by its number from 1, or with 0 (or one that is none) the whole patient.
    pub fn show(&mut self, alone: usize) -> &Labels {
        let alone = if alone <= self.count { alone } else { 0 };
        if alone != self.alone {
            self.alone = alone;
            self.labels.colors = self.colors;
            self.labels.opacity = [1.0; 256];
            if alone > 0 {
                // as the transfer function has it, and nothing beside it
                self.labels.opacity = [0.0; 256];
                self.labels.opacity[alone] = 1.0;
                self.labels.colors[alone][3] = 0.0;
            }
        }
        &self.labels
    }
}

/// One organ of a scene.
pub(crate) fn find(said: &maille_scene::Organ, rest: &impl BrickSource) -> Result<Organ, RenderingError> {
    let grid = &rest.info().grid;
    let fault = |reason: String| RenderingError::Organ { name: said.name.clone(), reason };
    let seed = match said.seed_mm.or(said.seed.map(|fraction| BoxMm::of(grid).at(fraction))) {
        None => None,
        Some(mm) => {
            let index = grid.index_from_world(mm).map(f64::round);
            if !(0..3).all(|c| index[c] >= 0.0 && index[c] < grid.size[c] as f64) {
                return Err(fault(format!("its seed {mm:.1?} mm lies outside the volume")));
            }
            Some(index.map(|v| v as usize))
        }
    };
    let selection = Selection { ranges: said.hu.clone(), seed, smallest_mm3: said.islands_mm3 };
    organ(rest, &selection).map_err(|e| fault(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{compose::Composer, view::View};
    use maille_transport::Untimed;
    use maille_volume::{BrickedVolume, Grid, Rescale, Volume};

    /// Two balls of bone in air, the larger at low x.
    fn balls() -> BrickedVolume {
        let mut grid = Grid::axis_aligned([64, 40, 40], [1.0; 3]);
        grid.origin = [-32.0, -20.0, -20.0];
        let ball =
            |p: [f64; 3], x: f64, r: f64| 1000.0 / (1.0 + (2.0 * (((p[0] - x).powi(2) + p[1] * p[1] + p[2] * p[2]).sqrt() - r)).exp());
        let voxels = (0..grid.voxel_count())
            .map(|n| {
                let p = grid.world_from_index([n % 64, n / 64 % 40, n / (64 * 40)].map(|v| v as f64));
                (ball(p, -15.0, 12.0) + ball(p, 17.0, 9.0) - 1000.0) as i16
            })
            .collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    fn scene(more: &str) -> Scene {
        let text = "[rendering]\nsize = [96, 64]\nsection_size = [64, 40]\ntransfer = \"skin\"\nfrom = [0.0, -1.0, 0.0]\nALONE[effects]\nsections = true\n\
             [[organ]]\nname = \"left\"\nhu = [[-500.0, 3000.0]]\nseed_mm = [17.0, 0.0, 0.0]\n\
             [[organ]]\nname = \"right\"\nhu = [[-500.0, 3000.0]]\nseed = [0.27, 0.5, 0.5]\n";
        Scene::parse("organs", &text.replace("ALONE", more)).expect("a scene")
    }

    /// The 3D view and the coronal section of a scene.
    fn drawn(scene: &Scene, bricks: &BrickedVolume) -> [Vec<u8>; 2] {
        let view = View::new(scene, &BoxMm::of(&bricks.info().grid)).expect("a view");
        let mut composer = Composer::new(scene);
        composer.organs = organs(scene, bricks).expect("the organs are there");
        composer.draw(bricks, None, &view, None, false, None, &mut Untimed).expect("it can be drawn");
        [0, 2].map(|n| composer.pictures[n].rgb.clone())
    }

    #[test]
    fn an_organ_alone_is_seen_as_it_was_and_the_other_is_not() {
        let bricks = balls();
        let mut none = scene("");
        none.organs.clear();
        let background = drawn(&none, &bricks)[0][..3].to_vec();
        // how much of each half of the picture is not background
        let halves = |rgb: &[u8]| -> [usize; 2] {
            let mut count = [0; 2];
            for (n, pixel) in rgb.chunks_exact(3).enumerate() {
                count[usize::from(n % 96 >= 48)] += usize::from(pixel.iter().zip(&background).any(|(a, b)| a.abs_diff(*b) > 2));
            }
            count
        };
        // seen from the front the patient's left is at the right of the picture
        let [whole, section] = drawn(&none, &bricks);
        let all = halves(&whole);
        assert!(all[0] > 100 && all[1] > 100, "{all:?}");
        let [left, _] = drawn(&scene("alone = \"left\"\n"), &bricks);
        let [right, _] = drawn(&scene("alone = \"right\"\n"), &bricks);
        let (l, r) = (halves(&left), halves(&right));
        assert!((l[0] == 0) != (l[1] == 0) && (r[0] == 0) != (r[1] == 0) && (l[0] == 0) != (r[0] == 0), "{l:?} {r:?}");
        // nothing is between them: the two together are the whole, but for the rim that labels end at
        for side in 0..2 {
            let one = l[side].max(r[side]) as f64 / all[side] as f64;
            assert!((0.85..=1.001).contains(&one), "{one} of what was seen there");
        }
        // sections colour organs and hide nothing
        let [_, coloured] = drawn(&scene(""), &bricks);
        let grey = |rgb: &[u8]| rgb.chunks_exact(3).filter(|p| p[0] == p[1] && p[1] == p[2]).count();
        assert!(grey(&section) > grey(&coloured) + 200, "{} {}", grey(&section), grey(&coloured));
    }

    #[test]
    fn a_radiograph_is_there_where_it_is_asked_for_is_brighter_behind_bone_and_hides_no_needle() {
        let bricks = balls();
        let asked = Scene::parse("x-ray", &scene("").to_toml().replace("[effects]", "[effects]\nx-ray = true")).expect("a scene");
        let view = View::new(&asked, &BoxMm::of(&bricks.info().grid)).expect("a view");
        let mut composer = Composer::new(&asked);
        let mut draw = |needle: Option<&[maille_raycast::Capsule]>| {
            composer.draw(&bricks, None, &view, None, true, needle, &mut Untimed).expect("it can be drawn");
            composer.pictures[5].clone()
        };
        let plain = draw(None);
        assert_eq!([plain.width, plain.height], [64, 40]);
        let centre = |x: usize| i32::from(plain.pixel(x, 20)[0]);
        let air = i32::from(plain.pixel(1, 1)[0]);
        let brightest = (0..64).map(centre).max().expect("a row");
        assert!((brightest - air).abs() > 40, "bone {brightest}, air {air}");
        assert!(plain.rgb.chunks_exact(3).all(|p| p[0] == p[1] && p[1] == p[2]), "without colour");
        // a needle across, behind and before the balls
        let along = |y: f64| maille_raycast::Capsule { a: [-28.0, y, 0.0], b: [28.0, y, 0.0], radius: 0.4, color: [1.0; 3] };
        for y in [-18.0, 18.0] {
            let with = draw(Some(&[along(y)]));
            let changed = with.rgb.chunks_exact(3).zip(plain.rgb.chunks_exact(3)).filter(|(a, b)| a != b).count();
            assert!((20..600).contains(&changed), "{changed} pixels of a needle at {y} mm");
        }
        // not asked for: no picture and no map of empty space
        let none = Composer::new(&scene(""));
        assert!(none.pictures[5].rgb.is_empty());
    }

    #[test]
    fn what_is_shown_alone_can_be_switched_to_and_fro() {
        let bricks = balls();
        let mut organs = organs(&scene(""), &bricks).expect("they are there").expect("some");
        let seen = |labels: &Labels| (labels.opacity, labels.colors);
        let whole = seen(organs.show(0));
        for alone in [1, 2] {
            let (opacity, colors) = seen(organs.show(alone));
            assert_eq!((opacity[alone], opacity.iter().sum::<f32>()), (1.0, 1.0), "{alone} and nothing else");
            assert_eq!(colors[alone][3], 0.0, "in the transfer function's own colour");
            assert_eq!(colors[3 - alone], whole.1[3 - alone]);
        }
        assert_eq!(seen(organs.show(3)), whole, "one that is none is the whole patient");
        organs.show(2);
        assert_eq!(seen(organs.show(0)), whole);
    }

    #[test]
    fn an_organ_that_is_not_there_is_said() {
        let bricks = balls();
        for (from, to) in [("[17.0, 0.0, 0.0]", "[1.0, 0.0, 0.0]"), ("[17.0, 0.0, 0.0]", "[170.0, 0.0, 0.0]")] {
            let mut scene = scene("");
            let moved: Scene = Scene::parse("moved", &scene.to_toml().replace(from, to)).expect("a scene");
            scene.organs = moved.organs;
            let error = organs(&scene, &bricks).err().expect("no such organ").to_string();
            assert!(error.contains("left"), "{error}");
        }
    }
}
