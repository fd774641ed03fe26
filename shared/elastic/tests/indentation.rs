//! ChainMail against elastic tissue under a sphere; the whole table is printed by the example `indentation`.

use maille_chainmail::Metric;
use maille_elastic::{
    Stopping,
    indentation::{Indentation, Setting},
};

const SETTING: Setting = Setting { offset: 0.2, metric: Metric::Cubic, shear: 1.0, sweeps: 0, anchor: 0.0 };

#[test]
fn displacements_of_a_mail_are_within_15_percent_of_the_push_of_elastic_ones() {
    for layer in [None, Some((6, 4.0))] {
        let scene = Indentation { size: [33, 33, 21], radius: 40.0, depth: 0.9, poisson: 0.4, layer };
        let truth = scene.elastic(Stopping { tolerance: 1e-6, iterations: 1000 }).unwrap().displacement;
        let volume = scene.volume();
        let bound = scene.sideways(&truth);
        let errors = [0.3, 0.16].map(|offset| {
            let setting = Setting { offset, ..SETTING };
            let mut mail = scene.mail(&volume, &setting);
            scene.press(&volume, &mut mail, &setting);
            let map = scene.error_map(&scene.displacements(&mail), &truth);
            // the same question: nothing was refused
            assert!(scene.refused(&map) < 1e-6, "{}", scene.refused(&map));
            scene.errors(&map, &truth)
        });
        println!("{layer:?}: bound {bound:?}, offset 0.3 {:?}, 0.16 {:?}", errors[0], errors[1]);
        for [all, moving] in errors {
            assert!(all.count > 10_000 && moving.count > 1_000, "{all:?} {moving:?}");
            // no straight answer is better than the truth's sideways part allows
            assert!(bound[1].mean <= moving.mean && bound[0].mean <= all.mean);
        }
        // over everything, and over what elastic tissue moves at all
        let best = errors.iter().map(|e| e[1].mean).fold(f64::INFINITY, f64::min);
        assert!(errors.iter().any(|e| e[0].mean <= 0.15) && best <= 0.15, "{errors:?}");
        // a dent that does not spread at all would be no answer
        let still = vec![[0.0; 3]; truth.len()];
        let nothing = scene.errors(&scene.error_map(&still, &truth), &truth);
        assert!(best < nothing[1].mean, "{best} {nothing:?}");
    }
}

#[test]
fn the_volume_of_a_mail_has_the_stiffness_of_the_block() {
    let scene = Indentation { size: [17, 17, 15], radius: 4.0, depth: 1.0, poisson: 0.3, layer: Some((5, 4.0)) };
    let volume = scene.volume();
    let mail = scene.mail(&volume, &SETTING);
    let (upper, lower) = (mail.limits(&volume, [8, 8, 12]).0, mail.limits(&volume, [8, 8, 5]).0);
    // CT values are whole numbers
    assert!((upper - 0.2).abs() < 1e-6 && (upper / lower - 4.0).abs() < 0.01, "{upper} {lower}");
    assert_eq!(mail.limits(&volume, [0, 8, 5]).1, 0.0);
    assert!(mail.limits(&volume, [8, 8, 15]).0.is_infinite());
    // the sphere's deepest point and its rim
    let contact = scene.contact();
    let deepest = contact.iter().map(|c| c.1).fold(0.0, f64::max);
    let shallowest = contact.iter().map(|c| c.1).fold(1.0, f64::min);
    assert!(deepest == 1.0 && shallowest > 0.4 && contact.len() == 13, "{contact:?}");
}
