//! The numbers of one fan: where its lines go, what a sample of theirs weighs, how echoes become grey. Worked out once, for the CPU and for its twin.

use super::{Probe, Ultrasound};
use maille_volume::Grid;

/// Most lines on either side over which the beam is smoothed.
pub const MOST_LINES: usize = 24;
/// Least edge of a cell of scatterers [mm]; f32 has no better places in a large volume.
const LEAST_CELL_MM: f64 = 0.02;

/// Numbers of one fan over one grid.
#[derive(Clone, Debug)]
pub struct Plan {
    /// lines of the fan, first to the left
    pub lines: usize,
    /// samples a line
    pub samples: usize,
    /// half the length over which an interface is looked for [samples]
    pub half: usize,
    /// of each line, the place on the probe's face [index] and the way to the next sample [index]; samples lie in the middle of their steps
    pub ways: Vec<[[f64; 3]; 2]>,
    /// unit vectors of the lines [LPS]
    pub directions: Vec<[f64; 3]>,
    /// places from the face on among which the skin must be for gel to fill the gap
    pub gel: usize,
    /// index ↦ cells of scatterers
    pub per_cell: [f64; 3],
    /// natural logarithm of what a sample lets through there and back: this times that of 1 − ρ²,
    pub pass: f64,
    /// and this times the attenuation
    pub loss: f64,
    /// weights of the pulse by distance in samples, over the power of all
    pub pulse: Vec<f32>,
    /// weights of the beam of each sample by distance in lines; 0 beyond its reach
    pub beam: Vec<[f32; MOST_LINES + 1]>,
    /// distance in lines up to which they count
    pub reach: Vec<usize>,
    /// grey of an echo as large as a perfect mirror's, sample by sample
    pub grey: Vec<f64>,
    /// and what it changes by a factor of ten
    pub per_decade: f64,
    /// whether there is back-scatter
    pub speckle: bool,
}

impl Plan {
    /// Of a fan, which has no [fault](Ultrasound::fault); `None` otherwise.
    pub fn new(settings: &Ultrasound, grid: &Grid) -> Option<Self> {
        if settings.fault().is_some() {
            return None;
        }
        let (p, step) = (&settings.probe, settings.step_mm);
        let [along, across] = p.axes()?;
        let (lines, samples) = (settings.lines, (p.depth_mm / step) as usize);
        let half = ((0.5 * settings.interface_mm / step).round() as usize).max(1);
        let line_rad = p.angle_deg.to_radians() / (lines - 1) as f64;
        let to_index = grid.index_from_world_matrix();
        let directions: Vec<[f64; 3]> = (0..lines)
            .map(|line| {
                let (sin, cos) = ((line as f64 / (lines - 1) as f64 - 0.5) * p.angle_deg.to_radians()).sin_cos();
                std::array::from_fn(|c| cos * along[c] + sin * across[c])
            })
            .collect();
        let way = |direction: &[f64; 3]| {
            let face = std::array::from_fn(|c| p.face[c] + p.radius_mm * (direction[c] - along[c]));
            [grid.index_from_world(face), (to_index * nalgebra::Vector3::from(*direction) * step).into()]
        };
        let ways = directions.iter().map(way).collect();
        let depth = |n: usize| (n as f64 + 0.5) * step;
        let (mut beam, mut reach) = (Vec::with_capacity(samples), Vec::with_capacity(samples));
        for n in 0..samples {
            let apart = line_rad * (p.radius_mm + depth(n));
            let sigma = ((settings.beam[0] + settings.beam[1] * depth(n)).max(1e-3) / apart) as f32;
            let lines = ((2.0 * sigma) as usize).min(MOST_LINES);
            let weight = |far: usize| if far <= lines { (-0.5 * (far as f32 / sigma).powi(2)).exp() } else { 0.0 };
            beam.push(std::array::from_fn(|far| if far == 0 { 1.0 } else { weight(far) }));
            reach.push(lines);
        }
        let gain = |n: usize| settings.gain[0] + 2.0 * settings.gain[1] * p.frequency_mhz * depth(n) / 10.0;
        let cell = (0.5 * step).max(LEAST_CELL_MM);
        Some(Self {
            lines,
            samples,
            half,
            ways,
            directions,
            gel: (0..samples + half).take_while(|&n| n as f64 * step <= settings.gel_mm).count(),
            per_cell: grid.spacing.map(|mm| mm / cell),
            pass: 0.5 / half as f64,
            loss: -2.0 * p.frequency_mhz * step / 10.0 / 20.0 * std::f64::consts::LN_10,
            pulse: pulse((settings.pulse_mm / step) as f32),
            beam,
            reach,
            grey: (0..samples).map(|n| 1.0 + gain(n) / settings.range_db).collect(),
            per_decade: 20.0 / settings.range_db,
            speckle: settings.speckle,
        })
    }

    /// Where sample `n` of a line lies in the world [index].
    #[inline]
    pub fn place(&self, line: usize, n: usize) -> [f64; 3] {
        let [face, step] = &self.ways[line];
        std::array::from_fn(|c| face[c] + (n as f64 + 0.5) * step[c])
    }
}

/// Weights of a Gaussian mean of numbers that are independent, whose power it keeps.
fn pulse(sigma: f32) -> Vec<f32> {
    let reach = (2.5 * sigma).ceil() as usize;
    let weights: Vec<f32> = (0..=reach).map(|n| if n == 0 { 1.0 } else { (-0.5 * (n as f32 / sigma).powi(2)).exp() }).collect();
    let rms = (2.0 * weights[1..].iter().map(|w| w * w).sum::<f32>() + 1.0).sqrt();
    weights.into_iter().map(|w| w / rms).collect()
}

/// Pixels of a picture ↔ millimetres: the fan fills the picture, its axis in the middle, the probe above.
#[derive(Clone, Copy, Debug)]
pub struct Scan {
    /// edge of a pixel [mm]
    pub mm_per_pixel: f64,
    /// the first column's place across, from the fan's axis [mm]
    pub left: f64,
    /// the first row's distance from the centre of the face's curvature, along the axis [mm]
    pub top: f64,
    /// curvature of the face [mm]
    pub radius_mm: f64,
    /// samples a millimetre
    pub per_mm: f64,
    /// lines a radian
    pub per_radian: f64,
    /// number of the line on the axis
    pub middle: f64,
    /// number of the last sample
    pub last: f64,
}

impl Scan {
    /// Of a picture of this size.
    pub fn new(settings: &Ultrasound, plan: &Plan, [width, height]: [usize; 2]) -> Self {
        let p: &Probe = &settings.probe;
        let half = (p.angle_deg / 2.0).to_radians();
        let (far, side) = (p.radius_mm + p.depth_mm, half.min(std::f64::consts::FRAC_PI_2).sin());
        let top = p.radius_mm * half.cos();
        let mm = (2.0 * far * side / width as f64).max((far - top) / height as f64);
        let last_line = (plan.lines - 1) as f64;
        Self {
            mm_per_pixel: mm,
            left: -0.5 * mm * (width as f64 - 1.0),
            // what is left over lies below
            top: top + 0.5 * mm,
            radius_mm: p.radius_mm,
            per_mm: 1.0 / settings.step_mm,
            per_radian: last_line / p.angle_deg.to_radians(),
            middle: 0.5 * last_line,
            last: (plan.samples - 1) as f64,
        }
    }

    /// Line and sample that a pixel shows, counted from the first ones; `None` beside the fan.
    #[inline]
    pub fn at(&self, column: usize, row: usize) -> Option<[f64; 2]> {
        let [x, y] = [self.left + column as f64 * self.mm_per_pixel, self.top + row as f64 * self.mm_per_pixel];
        let line = x.atan2(y) * self.per_radian + self.middle;
        let sample = (x.hypot(y) - self.radius_mm) * self.per_mm - 0.5;
        ((0.0..=2.0 * self.middle).contains(&line) && (0.0..=self.last).contains(&sample)).then_some([line, sample])
    }
}
