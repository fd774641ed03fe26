//! How a device stands to the patient: x_patient = c + s R x_device; forces go back by Rᵀ, torques by Rᵀ/s.
//!
//! With s ≠ 1 a motion of the hand is drawn larger or smaller; the force is not scaled, so the stiffness at the hand is s times the
//! tissue's, and a lever of the tool is 1/s longer in the hand: force and torque stay those of one potential, 1/s of the patient's, and a loop in the
//! hand gives what it takes. A coupling made for the device is divided by s (`HapticConfig::on_scaled_device`). Units: mm.

use crate::Kind;

/// From the device's frame to the patient's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounting {
    /// where the device's origin lies [mm]
    pub origin_mm: [f64; 3],
    /// R, row by row; a rotation
    pub rotation: [[f64; 3]; 3],
    /// s
    pub scale: f64,
}

impl Default for Mounting {
    /// The device's origin at the patient's, axes alike.
    fn default() -> Self {
        Self { origin_mm: [0.0; 3], rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], scale: 1.0 }
    }
}

/// From axes that are right, up and towards the user to the patient's, who lies before the user on the back with the head to the user's left: right → the
/// patient's feet (−S), up → anterior (−P), towards the user → the patient's right (−L).
const BEFORE_THE_USER: [[f64; 3]; 3] = [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]];

impl Mounting {
    /// A device of this kind as it stands on a table, in front of a patient that lies on the back with the head to the user's left: origin at
    /// `origin_mm`.
    pub fn in_front_of_patient(kind: Kind, origin_mm: [f64; 3]) -> Self {
        Self { origin_mm, rotation: product(BEFORE_THE_USER, kind.right_up_towards()), ..Self::default() }
    }

    /// R v
    pub fn turn(&self, v: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| (0..3).map(|j| self.rotation[i][j] * v[j]).sum())
    }

    /// Rᵀ v
    pub fn turn_back(&self, v: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| (0..3).map(|j| self.rotation[j][i] * v[j]).sum())
    }

    /// A position.
    pub fn place(&self, x: [f64; 3]) -> [f64; 3] {
        let turned = self.turn(x);
        std::array::from_fn(|i| self.origin_mm[i] + self.scale * turned[i])
    }
}

/// Whether columns have the length of a rotation's.
pub(crate) fn is_rotation(m: [[f64; 3]; 3]) -> bool {
    // NaN is in no range
    (0..3).all(|c| (0.9..=1.1).contains(&m.iter().map(|row| row[c] * row[c]).sum::<f64>()))
}

/// The quaternion (x, y, z, w) of a rotation given row by row; no numbers for what is none.
pub(crate) fn quaternion(m: [[f64; 3]; 3]) -> [f64; 4] {
    if !is_rotation(m) {
        return [f64::NAN; 4];
    }
    // the largest of the four squares is divided by: never a small one   [Shepperd 1978]
    let squares = [
        1.0 + m[0][0] - m[1][1] - m[2][2],
        1.0 - m[0][0] + m[1][1] - m[2][2],
        1.0 - m[0][0] - m[1][1] + m[2][2],
        1.0 + m[0][0] + m[1][1] + m[2][2],
    ];
    let largest = (0..4).max_by(|&a, &b| squares[a].total_cmp(&squares[b])).unwrap_or(3);
    let (xy, xz, yz) = (m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]);
    let (wx, wy, wz) = (m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]);
    let s = squares[largest];
    let q = match largest {
        0 => [s, xy, xz, wx],
        1 => [xy, s, yz, wy],
        2 => [xz, yz, s, wz],
        _ => [wx, wy, wz, s],
    };
    let length = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    q.map(|c| c / length)
}

/// The rotation of a quaternion (x, y, z, w), row by row; the identity for one that is none.
pub(crate) fn matrix(q: [f64; 4]) -> [[f64; 3]; 3] {
    let length = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    if !(length.is_finite() && length > 1e-9) {
        return Mounting::default().rotation;
    }
    let [x, y, z, w] = q.map(|c| c / length);
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// a b
pub(crate) fn product(a: [[f64; 3]; 3], b: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quaternions_and_matrices_go_into_each_other() {
        for q in [[0.0, 0.0, 0.0, 1.0], [0.5, 0.5, 0.5, 0.5], [1.0, 0.0, 0.0, 0.0], [0.1, -0.7, 0.3, -0.2], [0.0, 0.999, 0.0, 0.01]] {
            let there = matrix(q);
            let back = matrix(quaternion(there));
            for i in 0..3 {
                for j in 0..3 {
                    assert!((there[i][j] - back[i][j]).abs() < 1e-12, "{q:?}");
                }
            }
        }
        assert_eq!(matrix([f64::NAN; 4]), Mounting::default().rotation);
        for none in [f64::NAN, f64::INFINITY, 0.0] {
            assert!(quaternion([[none; 3]; 3]).iter().all(|c| c.is_nan()));
        }
    }

    #[test]
    fn the_work_of_a_force_is_the_same_in_both_frames() {
        for kind in Kind::ALL {
            in_front_is_a_rotation_without_a_scale(Mounting::in_front_of_patient(kind, [10.0, 20.0, 30.0]));
        }
    }

    /// Whatever the vendor calls its axes: a hand that goes down goes into a patient on the back, one that goes left goes to the head, and one that goes
    /// away from the user to the patient's left.
    #[test]
    fn the_hand_goes_where_it_goes_whatever_its_device_calls_the_axes() {
        // down, left, away, as libHD, libdhd and the Inverse Service have them
        for (kind, [down, left, away]) in [
            (Kind::Touch, [[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
            (Kind::ForceDimension, [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]]),
            (Kind::Inverse3, [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        ] {
            let m = Mounting::in_front_of_patient(kind, [0.0; 3]);
            let moved = [down, left, away].map(|v| m.turn(v).map(|c| c + 0.0));
            // posterior, superior, left (LPS)
            assert_eq!(moved, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], "{kind:?}");
        }
    }

    fn in_front_is_a_rotation_without_a_scale(m: Mounting) {
        let (x, f) = ([1.0, -2.0, 0.5], [0.3, 0.7, -1.1]);
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        assert!((dot(m.turn(x), f) - dot(x, m.turn_back(f))).abs() < 1e-12);
        assert_eq!(m.place([0.0; 3]), [10.0, 20.0, 30.0]);
        // a rotation, no reflection
        let columns: Vec<[f64; 3]> = (0..3).map(|j| std::array::from_fn(|i| f64::from(u8::from(i == j)))).map(|e| m.turn(e)).collect();
        let (a, b) = (columns[0], columns[1]);
        let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
        assert_eq!(cross.map(|c| c + 0.0), columns[2].map(|c| c + 0.0));
    }
}
