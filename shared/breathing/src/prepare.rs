//! Before a run: the model is read or made and brought to the scene's resolution, the trace is read and tried.

use crate::{BreathingError, EFFECT, RecordedReport, Signal};
use maille_contract::{
    MotionHeader,
    breath::{MOTION_KIND, MOTION_REGION, TRACE_KIND, TRACE_REGION},
};
use maille_motion::model::sampled;
use maille_motion::resample::grid_of_size;
use maille_motion::{Kind, MotionModel, Precision};
use maille_scene::{PhantomKind, Scene, VolumeSource};
use maille_store::{Region, StoreKeeper};
use maille_transport::Domain;
use maille_volume::Grid;
use std::path::Path;

/// What the regions of a run will hold.
pub struct Prepared {
    model: Vec<u8>,
    header: MotionHeader,
    trace: Option<String>,
    /// what was made of the recorded trace that leads it: gaps, rows left out
    pub recorded: Option<RecordedReport>,
    /// nodes along the axes of the fields
    pub size: [usize; 3],
    /// number of fields
    pub fields: usize,
    /// longest displacement at usual breathing [mm]
    pub longest_mm: f64,
    /// largest difference that nodes so far apart make, at usual breathing [mm]
    pub spacing_error_mm: f64,
    /// bound on the error from how vectors are stored, at usual breathing [mm]
    pub storage_error_mm: f64,
}

/// Makes ready what the scene's patient needs to breathe; `None` when it does not.
///
/// # Errors
/// When a file cannot be used, or nothing says how this patient breathes.
pub fn prepare(scene: &Scene, volume: &Grid) -> Result<Option<Prepared>, BreathingError> {
    if !scene.has_effect(EFFECT) {
        return Ok(None);
    }
    let trace = match &scene.breathing.signal {
        // a trace in another encoding is still numbers
        maille_scene::Signal::Recorded(file) => Some(String::from_utf8_lossy(&read(file)?).into_owned()),
        _ => None,
    };
    // tried here, so that a trace that cannot be played is told before anything starts
    let recorded = Signal::new(&scene.breathing, trace.as_deref())?.recorded().copied();
    let (spacing, precision) =
        (scene.breathing.field_spacing_mm, if scene.breathing.precision_bits > 16 { Precision::F32 } else { Precision::I16 });
    let (model, spacing_error_mm) = match (&scene.breathing.model, scene.volume.source()) {
        (Some(file), _) => {
            let bytes = read(file)?;
            let fail = |fault| BreathingError::Model { path: file.clone(), fault };
            let given = MotionModel::view(&bytes).map_err(fail)?;
            if let &Kind::Surrogate { signals, .. } = given.kind()
                && signals > 2
            {
                // nothing in a run measures the others, and held at any one value they would move the patient by what they are not
                let advice =
                    "a run knows the depth of breath and its rate of change: fit it with these two (`maille motion eval` takes them all)";
                return Err(BreathingError::Scene(format!("{}: a surrogate model of {signals} signals; {advice}", file.display())));
            }
            lies_on(&given, volume).map_err(|fault| BreathingError::Elsewhere { path: file.clone(), fault })?;
            given.remade(spacing, precision).map_err(fail)?
        }
        (None, VolumeSource::Phantom { kind: PhantomKind::Torso, .. }) => made_torso(volume, spacing, precision)?,
        (None, _) => {
            let advice = "give [breathing] model = \"FILE\" or --motion FILE; `maille motion fit` writes one from a 4D CT";
            return Err(BreathingError::Scene(format!("nothing says how this patient breathes; {advice}")));
        }
    };
    let storage_error_mm = f64::from(model.usual_storage_error_mm());
    let bytes = model.to_bytes();
    Ok(Some(Prepared {
        header: MotionHeader { bytes: bytes.len() as u64, storage_error_mm },
        model: bytes,
        trace,
        recorded,
        size: model.grid().size,
        fields: model.fields().len(),
        longest_mm: f64::from(model.usual_longest_mm()),
        spacing_error_mm: f64::from(spacing_error_mm),
        storage_error_mm,
    }))
}

impl Prepared {
    /// Name, meaning and bytes of each segment that it will fill.
    pub fn segments(&self) -> Vec<(&'static str, &'static str, u64)> {
        let model = Region::<MotionHeader>::segment_bytes(self.model.len()) as u64;
        let mut all = vec![("region-motion", "fields of breathing", model)];
        if let Some(trace) = &self.trace {
            all.push(("region-breath", "the recorded trace", Region::<[u64; 0]>::segment_bytes(trace.len()) as u64));
        }
        all
    }

    /// Fills the regions of a run.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn publish(&self, keeper: &mut StoreKeeper, domain: &Domain) -> Result<(), BreathingError> {
        let fill = |from: &[u8]| {
            let from = from.to_vec();
            move |to: &mut [u8]| to.copy_from_slice(&from)
        };
        keeper.add_region(domain, MOTION_REGION, MOTION_KIND, &self.header, self.model.len(), fill(&self.model))?;
        if let Some(trace) = &self.trace {
            keeper.add_region::<[u64; 0]>(domain, TRACE_REGION, TRACE_KIND, &[], trace.len(), fill(trace.as_bytes()))?;
        }
        Ok(())
    }
}

fn read(path: &Path) -> Result<Vec<u8>, BreathingError> {
    std::fs::read(path).map_err(|source| BreathingError::File { path: path.to_path_buf(), source })
}

/// How far the fields of the made torso reach beyond it [mm]: further than it moves.
const MARGIN_MM: f64 = 24.0;

/// The made torso's motion on nodes so far apart; the error is looked for in the middle of cells, where it is largest.
fn made_torso(volume: &Grid, spacing_mm: f64, precision: Precision) -> Result<(MotionModel<'static>, f32), BreathingError> {
    // beyond its last nodes a field goes on as a constant, with a kink there: out of what can be seen or felt
    let beyond = volume.spacing.map(|s| (MARGIN_MM / s).ceil());
    let wide = Grid {
        size: std::array::from_fn(|c| volume.size[c] + 2 * beyond[c] as usize),
        origin: volume.world_from_index(beyond.map(|b| -b)),
        ..volume.clone()
    };
    let nodes = |c: usize| ((wide.size[c] - 1) as f64 * wide.spacing[c] / spacing_mm).ceil() as usize + 1;
    let grid = grid_of_size(&wide, std::array::from_fn(nodes));
    let fields = [0, 1].map(|k| sampled(&grid, |at| maille_phantom::breathing::torso(at)[k]));
    let model = MotionModel::of_signals(&fields, precision)?;
    let full = model.weights(&maille_motion::Breath { level: 1.0, rate: 0.0, phase: 0.0 });
    let at = maille_motion::MotionAt::new(&model, full);
    let cells = grid.size.map(|s| s - 1);
    let error = (0..cells.iter().product::<usize>())
        .step_by(3)
        .map(|n| {
            let middle = [n % cells[0], n / cells[0] % cells[1], n / (cells[0] * cells[1])].map(|i| i as f64 + 0.5);
            let x = grid.world_from_index(middle);
            let (told, true_u) = (at.displacement_mm(x), maille_phantom::breathing::torso(x)[0]);
            (0..3).map(|c| (told[c] - true_u[c]).powi(2)).sum::<f64>().sqrt()
        })
        .fold(0.0, f64::max);
    Ok((model, error as f32))
}

/// Whether a model moves the place where the volume lies: its box must hold the volume's middle.
fn lies_on(model: &MotionModel<'_>, volume: &Grid) -> Result<(), String> {
    let (middle, grid) = (volume.center(), model.grid());
    if grid.contains_index(grid.index_from_world(middle)) {
        return Ok(());
    }
    let text = |p: [f64; 3]| format!("({:.1}, {:.1}, {:.1})", p[0], p[1], p[2]);
    Err(format!("the middle of the volume, {} mm, is outside its box about {} mm", text(middle), text(grid.center())))
}
