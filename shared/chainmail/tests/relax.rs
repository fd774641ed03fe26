//! Relaxation keeps what a push promised and ends at rest.

mod common;

use common::{Random, volume, voxels};
use maille_chainmail::{ChainMail, Motion, Pin, Tissue};
use maille_volume::BrickSource;

#[test]
fn links_hold_while_tissue_relaxes_and_it_ends_exactly_at_rest() {
    let mut random = Random(11);
    let size = [40, 33, 24];
    let rest = volume(size, [0.9, 1.1, 3.0], |_, _, _| random.within(-200.0, 500.0) as i16);
    let tissue = Tissue { bone_hu: Some(450.0), ..Tissue::default() };
    let mut mail = ChainMail::new(rest.info(), tissue);
    for n in 0..20 {
        let voxel = [5 + n, 10 + n / 2, 8 + n / 3];
        let motion = Motion::By([0, 1, 2].map(|_| random.within(-4.0, 4.0) as f32));
        mail.push(&rest, &[Pin { voxel, motion }]);
    }
    let energy = |mail: &ChainMail| -> f64 {
        let u = |v| mail.displacement(v).map(f64::from);
        voxels(size).map(|v| u(v).iter().map(|x| x * x).sum::<f64>()).sum()
    };
    let (mut last, mut steps) = (energy(&mail), 0);
    assert!(last > 1.0, "something is displaced");
    loop {
        let region = mail.relax(0.93, 1e-3);
        if region.is_empty() {
            break;
        }
        let now = energy(&mail);
        assert!(now < last, "step {steps}: {now} after {last}");
        last = now;
        steps += 1;
        for v in voxels(size) {
            for axis in 0..3 {
                let mut next = v;
                next[axis] += 1;
                if next[axis] < size[axis] {
                    let (a, b, w) = (mail.displacement(v), mail.displacement(next), mail.link(&rest, v, axis));
                    for c in 0..3 {
                        // 1e-6 mm: a few ulp of displacements of some millimetres
                        assert!((a[c] - b[c]).abs() <= w + 1e-6, "{v:?} axis {axis}: {} over {w}", (a[c] - b[c]).abs());
                    }
                }
            }
        }
    }
    assert!(steps > 10 && steps < 500, "{steps}");
    assert!(voxels(size).all(|v| mail.displacement(v).map(f32::to_bits) == [0; 3]), "rest is +0");
}
