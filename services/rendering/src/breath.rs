//! The warp of a frame: where the patient who breathes lies at the frame's simulation time.
//!
//! The mapped fields are summed up where they lie, for the moment, and the ray caster's lattice is inverted from that sum, warm from the last frame's. The lattice is as
//! coarse as costs a frame least at the ends of usual breathing, found once at the start (`maille_raycast::warp::pitch`); where it does not suffice, as with a
//! registration's fields, samples are found one by one in the sum itself. How far from its place anything may be drawn goes to the report for every frame.

use maille_breathing::Patient;
use maille_contract::ControlBlock;
use maille_motion::{Breath, Collapsed, MotionAt};
use maille_raycast::{
    Warp, WarpOptions, WarpReport,
    warp::pitch::{PITCHES_MM, Tried, cheapest},
};
use maille_volume::VolumeInfo;

/// The deepest of usual breath: a lattice that begins with it has room for all that follows.
const DEEPEST: Breath = Breath { level: 1.0, rate: 0.0, phase: 0.0 };
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
    /// what a picture's own lattice may add [mm]: half of the warp's tolerance
    view_mm: f32,
    /// whether sections or rays ask the field itself
    keep_field: bool,
    /// lattices that were tried, coarsest first
    tried: Vec<Tried>,
}

impl<'a> Breather<'a> {
    /// Finds a lattice for pictures within the tolerance [mm].
    pub fn new(patient: Patient<'a>, info: &VolumeInfo, tolerance_mm: f64, keep_field: bool) -> Self {
        let extent = |c: usize| info.grid.size[c] as f64 * info.grid.spacing[c];
        let nodes = |pitch: f32| (0..3).map(|c| extent(c) / f64::from(pitch) + 4.0).product::<f64>();
        // a picture's own lattice takes half of what it is given: a third of the whole, as the patient's share is the dearer
        let within_mm = 0.66 * tolerance_mm as f32;
        let options = |pitch_mm| WarpOptions { tolerance_mm: within_mm, pitch_mm, keep_field, ..WarpOptions::default() };
        let collapsed = Collapsed::new(patient.model(), tolerance_mm as f32);
        let warp = Warp::new(info, options(PITCHES_MM[0]));
        let (report, view_mm) = (WarpReport::default(), 0.5 * within_mm);
        let mut breather = Self { patient, info: info.clone(), collapsed, warp, report, view_mm, keep_field, tried: Vec::new() };
        // between nodes closer than the fields' own there is nothing to be found but their kinks
        let finest = breather.patient.model().grid().min_spacing() as f32;
        let tried = |&pitch: &f32| nodes(pitch) <= MOST_NODES && (pitch >= finest || pitch >= PITCHES_MM[0]);
        for pitch in PITCHES_MM.into_iter().filter(tried) {
            breather.warp = Warp::new(info, options(pitch));
            // both ends of a breath
            let usual = [DEEPEST, Breath::EXPIRED, Breath { level: 0.5, rate: -0.8, phase: 0.25 }];
            let found = Tried::of(pitch, usual.map(|breath| breather.bend(breath)));
            breather.tried.push(found);
            let best = cheapest(&breather.tried, within_mm);
            if breather.tried.iter().any(|tried| tried.pitch_mm == best && found.is_last(tried)) {
                break;
            }
        }
        breather.warp = Warp::new(info, options(cheapest(&breather.tried, within_mm)));
        breather.bend(DEEPEST);
        breather
    }

    /// Another tolerance [mm], no finer than the one that it was made for.
    pub fn set_tolerance(&mut self, tolerance_mm: f64) {
        let within_mm = 0.66 * tolerance_mm as f32;
        self.view_mm = 0.5 * within_mm;
        let pitch_mm = cheapest(&self.tried, within_mm);
        self.warp =
            Warp::new(&self.info, WarpOptions { tolerance_mm: within_mm, pitch_mm, keep_field: self.keep_field, ..WarpOptions::default() });
        self.collapsed = Collapsed::new(self.patient.model(), tolerance_mm as f32);
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
        self.collapsed.collapse(model, &weights);
        let (longest_mm, contraction) = self.collapsed.bounds(model);
        self.warp.update_field(&self.info, model.grid(), self.collapsed.nodes(), longest_mm, contraction)
    }

    /// The patient at a simulation time, to be asked at many points.
    pub fn moment(&self, time_ns: u64) -> MotionAt<'_> {
        self.patient.at(time_ns)
    }

    /// Where a point of the patient at rest is at a simulation time [mm].
    pub fn to_world(&self, time_ns: u64, reference: [f64; 3]) -> [f64; 3] {
        self.patient.at(time_ns).to_world(reference)
    }

    /// What the last frame's warp is worth: how far from its place anything is drawn [mm], and nodes without a rest position.
    pub fn report(&self) -> (f64, u64) {
        (drawn_off_mm(&self.report, self.view_mm).into(), self.report.unsettled as u64)
    }
}

/// How far from where it is anything is drawn [mm]: what is shown at x is X, whose place is X + u(X). That is the residual itself, at its worst in the
/// middle of the lattice's cells or, in rough ones, where a sample counts as found, and what the picture's own lattice adds; whatever the contraction, by which the report bounds the error in X.
fn drawn_off_mm(report: &WarpReport, view_mm: f32) -> f32 {
    report.error_mm * (1.0 - report.contraction.clamp(0.01, 0.95)) + view_mm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{compose::Composer, view::View};
    use maille_breathing::{Regions, Signal};
    use maille_contract::{
        FrameHeader, MotionHeader, Role, Stamp,
        breath::{MOTION_KIND, MOTION_REGION},
    };
    use maille_motion::{MotionModel, Precision, model::sampled};
    use maille_scene::{BoxMm, Scene};
    use maille_store::{Reader, StoreKeeper, StoreSizes};
    use maille_transport::{ControlMap, Domain, Untimed};
    use maille_volume::{Grid, Rescale, Volume};

    const SCENE: &str = "[volume]\nphantom = \"torso\"\n[breathing]\nsignal = \"console\"\n[effects]\nbreathing = true\n\
                         [rendering]\nmode = \"isosurface\"\nsize = [160, 120]\nfrom = [0.0, -1.0, 0.0]\ndistance = 1.4\n";

    fn drawn(scene: &Scene, reader: &Reader, warp: Option<&Warp>, eye_mm: f64) -> Vec<u8> {
        let mut scene = scene.clone();
        let box_mm = BoxMm::of(&reader.info().grid);
        let view = scene.rendering.view(&box_mm);
        let lifted = |p: [f64; 3]| Some([p[0], p[1], p[2] + eye_mm]);
        (scene.rendering.eye, scene.rendering.target) = (lifted(view.eye), lifted(view.target));
        let mut composer = Composer::new(&scene);
        composer.draw(&reader.snapshot(), warp, &View::new(&scene, &box_mm).unwrap(), None, false, None, &mut Untimed).unwrap();
        let mut pixels = vec![0; composer.bytes()];
        composer.write(&mut pixels, FrameHeader::default());
        pixels
    }

    #[test]
    fn a_patient_carried_as_a_whole_is_the_patient_seen_from_elsewhere() {
        let grid = Grid::axis_aligned([64; 3], [1.0; 3]);
        let solid = |n: usize| {
            let [x, y, z] = [n % 64, n / 64 % 64, n / 4096].map(|c| c as f64 - 31.5);
            x * x + y * y + z * z < 400.0 || (x.abs() < 4.0 && y.abs() < 4.0)
        };
        let voxels = (0..grid.voxel_count()).map(|n| if solid(n) { 60 } else { -1000 }).collect();
        let volume = Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels);
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let mut keeper = StoreKeeper::create(&domain, &volume, StoreSizes::for_volume(64, 16, 3, false), |_| {}).unwrap();
        // everything up by 8 mm at level 1
        let nodes = Grid { origin: [-20.0; 3], ..Grid::axis_aligned([9; 3], [13.0; 3]) };
        let model = MotionModel::of_signals(&[sampled(&nodes, |_| [0.0, 0.0, 8.0])], Precision::I16).unwrap().to_bytes();
        let header = MotionHeader { bytes: model.len() as u64, storage_error_mm: 0.0 };
        keeper.add_region(&domain, MOTION_REGION, MOTION_KIND, &header, model.len(), |to| to.copy_from_slice(&model)).unwrap();

        let scene = Scene::parse("test", SCENE).unwrap();
        let reader = Reader::open(&domain, Role::Rendering).unwrap();
        let mut regions = Regions::open(&domain, &scene).unwrap().unwrap();
        let mut breather = Breather::new(regions.patient().unwrap(), reader.info(), 0.1, false);
        // as the page leads it: fully in, from some time on
        let page = Signal::open(&domain, &scene).unwrap().unwrap();
        let stamp = Stamp { time_ns: 1_000_000_000, sequence: 1, incarnation: 1 };
        control.breath.store(&page.command(stamp, false, Some(1.0)).unwrap());
        assert!(breather.listen(&control));

        let still = drawn(&scene, &reader, None, 0.0);
        let before = drawn(&scene, &reader, Some(breather.go(500_000_000)), 0.0);
        let moved = drawn(&scene, &reader, Some(breather.go(20_000_000_000)), 0.0);
        let seen_from_below = drawn(&scene, &reader, None, -8.0);
        let differ = |a: &[u8], b: &[u8]| a.iter().zip(b).filter(|(a, b)| a.abs_diff(**b) > 24).count() as f64 / a.len() as f64;
        let (off_mm, unsettled) = breather.report();
        // the lattice is exact; what is left is the share of the tolerance that a picture may take
        assert!(unsettled == 0 && off_mm < 0.033 + 1e-3, "{off_mm} {unsettled}");
        assert!(differ(&before, &still) < 0.001, "before the command nothing moves: {}", differ(&before, &still));
        // what samples along a ray begin at differs; edges of a pixel
        let (same, other) = (differ(&moved, &seen_from_below), differ(&moved, &still));
        assert!(same < 0.005 && other > 0.02 && other > 10.0 * same, "{same} {other}");
        drop(breather);
        drop((regions, reader, keeper, control));
        domain.remove().unwrap();
    }
}
