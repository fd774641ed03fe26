//! The warp of a frame: where the patient who breathes lies at the frame's simulation time.
//!
//! The mapped fields are summed up where they lie, for the moment, and the ray caster's lattice is inverted from that sum, warm from the last frame's. The lattice is as
//! coarse as the scene's tolerance allows at the ends of usual breathing, found once at the start; every frame's bound on the error of what is
//! shown goes to the report.

use maille_breathing::Patient;
use maille_contract::ControlBlock;
use maille_motion::{Breath, Collapsed};
use maille_raycast::{Warp, WarpOptions, WarpReport};
use maille_volume::VolumeInfo;

/// Distances of the lattice's nodes that are tried, coarsest first [mm].
const PITCHES_MM: [f32; 8] = [16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.5];
/// No finer lattice than this [nodes]: 64 MiB.
const MOST_NODES: f64 = 4e6;

/// Draws a patient who breathes.
pub(crate) struct Breather<'a> {
    patient: Patient<'a>,
    info: VolumeInfo,
    /// u of the moment
    collapsed: Collapsed,
    warp: Warp,
    report: WarpReport,
}

impl<'a> Breather<'a> {
    /// Finds a lattice for pictures within the tolerance [mm].
    pub fn new(patient: Patient<'a>, info: &VolumeInfo, tolerance_mm: f64) -> Self {
        let extent = |c: usize| info.grid.size[c] as f64 * info.grid.spacing[c];
        let nodes = |pitch: f32| (0..3).map(|c| extent(c) / f64::from(pitch) + 4.0).product::<f64>();
        // the way between knots takes half of what it is given: a third of the whole, as the lattice's share is the dearer
        let options = |pitch_mm| WarpOptions { tolerance_mm: 0.66 * tolerance_mm as f32, pitch_mm, ..WarpOptions::default() };
        let collapsed = Collapsed::new(patient.model(), tolerance_mm as f32);
        let warp = Warp::new(info, options(PITCHES_MM[0]));
        let mut breather = Self { patient, info: info.clone(), collapsed, warp, report: WarpReport::default() };
        // between nodes closer than the fields' own there is nothing to be found but their kinks
        let finest = breather.patient.model().grid().min_spacing() as f32;
        let tried = |&pitch: &f32| nodes(pitch) <= MOST_NODES && (pitch >= finest || pitch >= PITCHES_MM[0]);
        for pitch in PITCHES_MM.into_iter().filter(tried) {
            breather.warp = Warp::new(info, options(pitch));
            // both ends of a breath; deepest first, so that the lattice has room for all that follows
            let usual = [Breath { level: 1.0, rate: 0.0, phase: 0.0 }, Breath::EXPIRED, Breath { level: 0.5, rate: -0.8, phase: 0.25 }];
            let worst = usual.map(|breath| breather.bend(breath)).into_iter().fold(0.0f32, |worst, found| worst.max(found.error_mm));
            if f64::from(worst) <= tolerance_mm {
                break;
            }
        }
        breather
    }

    /// Takes the page's last word; false when it made no sense.
    pub fn listen(&mut self, control: &ControlBlock) -> bool {
        self.patient.listen(control)
    }

    /// Goes to a simulation time.
    pub fn go(&mut self, time_ns: u64) -> &Warp {
        self.report = self.bend(self.patient.breath(time_ns));
        &self.warp
    }

    fn bend(&mut self, breath: Breath) -> WarpReport {
        let model = self.patient.model();
        let weights = model.weights(&breath);
        let (longest_mm, contraction) = model.bounds(&weights);
        self.collapsed.collapse(model, &weights);
        self.warp.update_field(&self.info, model.grid(), &self.collapsed.displacement(), longest_mm, contraction)
    }

    /// What the last frame's warp is worth.
    pub fn report(&self) -> &WarpReport {
        &self.report
    }
}
