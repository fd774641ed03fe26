//! What CT values mean to sound. Where the numbers are from: the module above.

/// Acoustic properties over HU, linear between rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Acoustic {
    /// value (HU)
    pub hu: f64,
    /// impedance [MRayl]
    pub impedance: f64,
    /// attenuation, one way [dB/cm/MHz]
    pub attenuation: f64,
    /// amplitude that comes back from fine structure, over what a perfect mirror gives
    pub scatter: f64,
}

const fn row(hu: f64, impedance: f64, attenuation: f64, scatter: f64) -> Acoustic {
    Acoustic { hu, impedance, attenuation, scatter }
}

/// Air, lung, fat, water, liver and muscle, spongy and cortical bone.
pub const TISSUES: [Acoustic; 8] = [
    row(-1000.0, 0.0004, 7.5, 0.0),
    row(-700.0, 0.18, 40.0, 0.02),
    row(-200.0, 1.35, 0.7, 0.006),
    row(-100.0, 1.39, 0.63, 0.012),
    row(0.0, 1.46, 0.05, 0.001),
    row(50.0, 1.65, 0.6, 0.01),
    row(300.0, 2.2, 4.0, 0.02),
    row(1200.0, 6.5, 10.0, 0.02),
];

/// Properties of a value; beyond the table as at its ends.
pub fn acoustic(hu: f64) -> Acoustic {
    let after = TISSUES.partition_point(|t| t.hu <= hu);
    if after == 0 || after == TISSUES.len() {
        return Acoustic { hu, ..TISSUES[after.saturating_sub(1).min(TISSUES.len() - 1)] };
    }
    let (a, b) = (TISSUES[after - 1], TISSUES[after]);
    let t = (hu - a.hu) / (b.hu - a.hu);
    let mix = |a: f64, b: f64| a + (b - a) * t;
    row(hu, mix(a.impedance, b.impedance), mix(a.attenuation, b.attenuation), mix(a.scatter, b.scatter))
}

/// Below this there is gas (HU).
pub const GAS_HU: f64 = -300.0;
/// What lies beyond the volume, as far as anybody knows (HU).
pub const AIR_HU: f64 = -1000.0;

/// What fills the gap between face and skin: water that takes nothing and returns nothing.
pub(super) fn gel() -> Acoustic {
    Acoustic { attenuation: 0.0, scatter: 0.0, ..acoustic(0.0) }
}
