//! The probe, how its fan is sampled and shown, and what of that is refused.

use crate::geometry::dot;

/// A probe with a curved face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probe {
    /// middle of the face [mm, LPS]
    pub face: [f64; 3],
    /// where it looks
    pub direction: [f64; 3],
    /// the picture's right; its part across `direction` counts
    pub across: [f64; 3],
    /// curvature of the face [mm]
    pub radius_mm: f64,
    /// opening of the fan [degrees], above 0 and below 180
    pub angle_deg: f64,
    /// how deep it looks [mm]
    pub depth_mm: f64,
    /// frequency [MHz]
    pub frequency_mhz: f64,
}

impl Probe {
    /// A probe for the abdomen: a face 60 mm long, of a curvature of 60 mm, 3.5 MHz.
    pub fn convex(face: [f64; 3], direction: [f64; 3], across: [f64; 3]) -> Self {
        Self { face, direction, across, radius_mm: 60.0, angle_deg: 1f64.to_degrees(), depth_mm: 120.0, frequency_mhz: 3.5 }
    }

    /// Unit vectors along and across; `None` when they are none, or a number makes no sense.
    pub(super) fn axes(&self) -> Option<[[f64; 3]; 2]> {
        let unit = |v: [f64; 3]| {
            let length = dot(v, v).sqrt();
            (length > 1e-9 && length.is_finite()).then(|| v.map(|c| c / length))
        };
        let along = unit(self.direction)?;
        let part = dot(self.across, along);
        let across = unit(std::array::from_fn(|c| self.across[c] - part * along[c]))?;
        let numbers = [self.radius_mm, self.angle_deg, self.depth_mm, self.frequency_mhz];
        let sound = numbers.iter().all(|v| v.is_finite() && *v > 0.0) && self.angle_deg < 180.0 && self.face.iter().all(|v| v.is_finite());
        sound.then_some([along, across])
    }
}

/// How a fan is sampled and shown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ultrasound {
    /// the probe
    pub probe: Probe,
    /// lines of the fan
    pub lines: usize,
    /// distance of samples along a line [mm]
    pub step_mm: f64,
    /// length over which an interface is looked for [mm]: about what CT smears one over
    pub interface_mm: f64,
    /// air between face and skin that gel fills [mm]
    pub gel_mm: f64,
    /// length of the pulse, as a standard deviation [mm]
    pub pulse_mm: f64,
    /// half width of the beam at the face [mm], and its growth a millimetre of depth
    pub beam: [f64; 2],
    /// amplification [dB], and what it grows with depth [dB/cm/MHz, one way]
    pub gain: [f64; 2],
    /// from black to white [dB]
    pub range_db: f64,
    /// whether there is back-scatter; interfaces alone otherwise
    pub speckle: bool,
}

impl Ultrasound {
    /// Usual settings of a probe.
    pub fn new(probe: Probe) -> Self {
        Self {
            probe,
            lines: 192,
            step_mm: 0.25,
            interface_mm: 1.5,
            gel_mm: 12.0,
            pulse_mm: 0.3,
            beam: [0.5, 0.006],
            gain: [12.0, 0.5],
            range_db: 60.0,
            speckle: true,
        }
    }

    /// Why it cannot be drawn, if so.
    pub fn fault(&self) -> Option<String> {
        if self.probe.axes().is_none() {
            return Some(format!("an ultrasound probe that makes no sense: {:?}", self.probe));
        }
        let samples = self.probe.depth_mm / self.step_mm;
        let positive = [self.step_mm, self.interface_mm, self.pulse_mm, self.beam[0], self.range_db];
        let sound = positive.iter().all(|v| v.is_finite() && *v > 0.0) && self.gain.iter().chain(&self.beam).all(|v| v.is_finite());
        // neither an interface nor a pulse is looked for over more than a line may have
        let long = self.interface_mm / self.step_mm > 16384.0 || self.pulse_mm / self.step_mm > 1024.0;
        (!sound || long || !(2..=4096).contains(&self.lines) || !(1.0..=16384.0).contains(&samples) || self.gel_mm.is_nan())
            .then(|| format!("ultrasound settings out of range: {self:?}"))
    }
}
