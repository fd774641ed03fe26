//! Mapping of an analytic displacement against the exact resampling: error in HU, and the order at which it falls with the spacing.

use maille_chainmail::{Admission, ChainMail, DisplacementBrick, Tissue};
use maille_mapper::{MapOptions, Mapping, Sampling, remap, tetrahedra::Split};
use maille_volume::{BrickId, BrickSource, BrickedVolume, Grid, Rescale, Volume, brick::EDGE};
use std::f64::consts::TAU;

/// Edge of the patient [mm].
const SIZE: f64 = 48.0;
/// Half the range of values [HU]: large, so that rounding to whole numbers hides nothing.
const AMPLITUDE: f64 = 12_000.0;

/// A smooth volume: waves of 22 to 28 mm.
fn hu(x: [f64; 3]) -> f64 {
    AMPLITUDE * (TAU * x[0] / 24.0).sin() * (TAU * x[1] / 28.0 + 0.4).cos() * (TAU * x[2] / 22.0 + 1.0).cos()
}

/// A smooth displacement [mm] that ends inside the patient: link limits of about 0.2 and below.
fn bump(x: [f64; 3]) -> [f64; 3] {
    let r2 = x.iter().map(|v| ((v - SIZE / 2.0) / 20.0).powi(2)).sum::<f64>();
    let w = if r2 < 1.0 { (1.0 - r2).powi(3) } else { 0.0 };
    [2.0 * w, -1.5 * w, 1.2 * w]
}

/// The same translation everywhere: nothing to invert, only values to interpolate.
fn translation(_: [f64; 3]) -> [f64; 3] {
    [0.37, -0.61, 0.23]
}

type Field = fn([f64; 3]) -> [f64; 3];

/// RMS error over the moved voxels, in parts of the HU range; `n` voxels along an edge of the patient.
fn error(field: Field, n: usize, mapping: Mapping, sampling: Sampling) -> f64 {
    let h = SIZE / n as f64;
    let grid = Grid::axis_aligned([n + 1; 3], [h; 3]);
    let position = |at: [usize; 3]| at.map(|v| v as f64 * h);
    let at = |m: usize| [m % (n + 1), m / (n + 1) % (n + 1), m / ((n + 1) * (n + 1))];
    let voxels = (0..grid.voxel_count()).map(|m| hu(position(at(m))).round() as i16).collect();
    let rest = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
    let tissue = Tissue {
        offset: 0.2,
        density_scaling: false,
        threshold_hu: None,
        bone_hu: None,
        movement_limit_mm: None,
        admission: Admission::Scaled,
    };
    let mut mail = ChainMail::new(rest.info(), tissue);
    for id in 0..rest.layout().count() as BrickId {
        let first = rest.layout().first_voxel(id);
        let mut brick: DisplacementBrick = bytemuck::Zeroable::zeroed();
        for m in 0..EDGE * EDGE * EDGE {
            let u = field(position([first[0] + m % EDGE, first[1] + m / EDGE % EDGE, first[2] + m / (EDGE * EDGE)]));
            (0..3).for_each(|c| brick.u[c][m] = u[c] as f32);
        }
        mail.restore_brick(id, &brick);
    }
    let mut deformed = rest.clone();
    // the inversion to a ten-thousandth of a voxel, so that interpolation is what is measured
    let options = MapOptions { tolerance: 1e-4, sampling, mapping, ..MapOptions::default() };
    let report = remap(&rest, &mail, &mail.displaced_region(), &mut deformed, &options);
    // five tetrahedra do not meet those of the next cell face to face: a few voxels fall between
    let allowed = if mapping == Mapping::Tetrahedra(Split::Five) { report.voxels / 1000 } else { 0 };
    assert!(report.failures <= allowed, "{mapping:?}: {report:?}");
    let (mut sum, mut count) = (0.0, 0);
    for m in 0..(n + 1) * (n + 1) * (n + 1) {
        let voxel = at(m);
        let x = position(voxel);
        // away from the border, where the translation looks beyond the grid
        if x.iter().any(|v| *v < 2.0 || *v > SIZE - 2.0) || field(x) == [0.0; 3] {
            continue;
        }
        // X + u(X) = x by the fixed point in f64: contracts by less than 0.6
        let mut rest_at = x;
        for _ in 0..80 {
            let u = field(rest_at);
            rest_at = std::array::from_fn(|c| x[c] - u[c]);
        }
        sum += (f64::from(deformed.voxel(voxel[0], voxel[1], voxel[2])) - hu(rest_at)).powi(2);
        count += 1;
    }
    (sum / f64::from(count)).sqrt() / (2.0 * AMPLITUDE)
}

#[test]
fn mapping_a_smooth_volume_is_right_to_one_percent_and_converges_at_second_order() {
    let schemes = [
        ("inversion, trilinear", Mapping::Inverse, Sampling::Linear),
        ("inversion by Newton, trilinear", Mapping::Newton, Sampling::Linear),
        ("inversion, tricubic", Mapping::Inverse, Sampling::Cubic),
        ("twelve tetrahedra", Mapping::Tetrahedra(Split::Twelve), Sampling::Linear),
        ("five tetrahedra", Mapping::Tetrahedra(Split::Five), Sampling::Linear),
    ];
    println!("RMS error in % of the HU range at 2, 1 and 0.5 mm; waves of 22 to 28 mm");
    let mut at_1_mm = Vec::new();
    for (name, mapping, sampling) in schemes {
        // the thesis's search takes too long at the finest
        let sizes: &[usize] = if matches!(mapping, Mapping::Tetrahedra(_)) { &[24, 48] } else { &[24, 48, 96] };
        let errors: Vec<f64> = sizes.iter().map(|&n| error(bump, n, mapping, sampling)).collect();
        println!("{name:32} {:.4?}", errors.iter().map(|e| 100.0 * e).collect::<Vec<_>>());
        assert!(errors[1] <= 0.01, "{name}: {errors:?}");
        // displacement and value are interpolated linearly: h²
        for pair in errors.windows(2) {
            let order = (pair[0] / pair[1]).log2();
            assert!(order > 1.65, "{name}: order {order}");
        }
        at_1_mm.push(errors[1]);
    }
    // sharper sampling pays, and the kernel is no worse than the tetrahedra
    assert!(at_1_mm[2] < 0.5 * at_1_mm[0] && at_1_mm[0] < 1.05 * at_1_mm[3].min(at_1_mm[4]), "{at_1_mm:?}");
}

#[test]
fn sampling_converges_at_second_order_when_trilinear_and_at_third_when_tricubic() {
    // a translation by the same share of a voxel at each spacing
    let fields: [Field; 3] = [|x| translation(x).map(|v| 2.0 * v), translation, |x| translation(x).map(|v| 0.5 * v)];
    for (sampling, least) in [(Sampling::Linear, 1.8), (Sampling::Cubic, 2.8)] {
        let errors: [f64; 3] = std::array::from_fn(|n| error(fields[n], 24 << n, Mapping::Inverse, sampling));
        println!("{sampling:?}: {errors:?}");
        // values are whole numbers: an error of 0.3 HU RMS at least
        let rounding = 0.5 / (2.0 * AMPLITUDE);
        for pair in errors.windows(2).filter(|p| p[1] > 2.0 * rounding) {
            let order = (pair[0] / pair[1]).log2();
            assert!(order > least, "{sampling:?}: order {order}, {errors:?}");
        }
        assert!(sampling == Sampling::Linear || errors[2] < 2.0 * rounding, "{errors:?}");
    }
}
