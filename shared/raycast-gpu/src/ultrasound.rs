//! Ultrasound on the device: the twin of `maille_raycast::ultrasound`, in six passes over one set of buffers.
//!
//! *Gather* finds each sample's tissue (and where it lies at rest), *walk* goes down each line, *echo* asks gradients and scatterers,
//! *pulse* and *beam* smooth, *scan* draws the picture. Numbers, weights and tables are the reference's own (`twin::fan`); scatterers are the
//! same hash of whole numbers, computed here. What a device's `pow`, `exp` and `atan2` would decide is tabulated, or has a series of its own.
//!
//! Cost: 40 bytes of the device's memory a sample, kept between frames until [`Renderer::forget_ultrasound`].

use crate::{
    buffers::{Mirror, Scratch},
    device::GpuError,
    render::{FrameReport, Pass, Renderer},
    variant::{Shows, Stage, Variant},
};
use bytemuck::{Pod, Zeroable};
use maille_raycast::{Picture, RenderError, Ultrasound, Warp, twin};
use maille_volume::{BrickSource, VolumeInfo};

/// Most bytes of one buffer of samples; a larger fan is the CPU's.
const MOST_BYTES: u64 = 256 << 20;
/// Larger than any number of a fan that shows something.
const HUGE: f64 = 1e30;

/// As `Fan` in `ultrasound.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Packed {
    last: [f32; 3],
    slope: f32,
    per_mm: [f32; 3],
    intercept: f32,
    per_cell: [f32; 3],
    loss: f32,
    lines: u32,
    samples: u32,
    interface: u32,
    gel: u32,
    pulse_weights: u32,
    through: f32,
    per_octave: f32,
    last_sample: f32,
    size: [u32; 2],
    left: f32,
    top: f32,
    top_less_radius: f32,
    radius: f32,
    mm_per_pixel: f32,
    samples_per_mm: f32,
    per_radian: f32,
    middle: f32,
    unused: [f32; 2],
}

const _: () = assert!(size_of::<Packed>() == 8 * 16);

/// A number as shaders may have it: finite, whatever a probe far away or a range of nothing makes of it.
fn number(v: f64) -> f32 {
    if v.is_nan() { 0.0 } else { v.clamp(-HUGE, HUGE) as f32 }
}

impl Packed {
    fn new(info: &VolumeInfo, plan: &twin::Fan, scan: &twin::Scan, [width, height]: [usize; 2]) -> Self {
        let (grid, rescale) = (&info.grid, info.rescale);
        Self {
            last: grid.size.map(|s| (s - 1) as f32),
            slope: rescale.slope as f32,
            per_mm: grid.spacing.map(|mm| (1.0 / mm) as f32),
            intercept: rescale.intercept as f32,
            per_cell: plan.per_cell.map(number),
            loss: number(plan.loss * std::f64::consts::LOG2_E),
            lines: plan.lines as u32,
            samples: plan.samples as u32,
            interface: plan.half as u32,
            gel: plan.gel as u32,
            pulse_weights: plan.pulse.len() as u32,
            through: plan.pass as f32,
            per_octave: number(plan.per_decade * std::f64::consts::LOG10_2),
            last_sample: scan.last as f32,
            size: [width as u32, height as u32],
            left: number(scan.left),
            top: number(scan.top),
            top_less_radius: number(scan.top - scan.radius_mm),
            radius: number(scan.radius_mm),
            mm_per_pixel: number(scan.mm_per_pixel),
            samples_per_mm: number(scan.per_mm),
            per_radian: number(scan.per_radian),
            middle: scan.middle as f32,
            unused: [0.0; 2],
        }
    }
}

/// Numbers of a row of weights: grey, reach, and the beam's.
pub(crate) const ROW: usize = twin::MOST_LINES + 3;

/// What a fan has on the device.
#[derive(Default)]
pub(crate) struct Fan {
    pub numbers: Mirror,
    /// of lines
    pub ways: Mirror,
    /// of samples, then of the pulse
    pub weights: Mirror,
    /// tissue of every sample, then its echo
    pub tissues: Scratch,
    /// where it lies at rest, then its echo as the pulse sees it
    pub places: Scratch,
    /// what comes back before it is known from where, then grey
    pub greys: Scratch,
}

impl Renderer {
    /// Draws a fan and waits.
    ///
    /// # Errors
    /// [`GpuError`]; the picture is then untouched. What the reference refuses is refused in its words ([`RenderError::Ultrasound`]).
    pub fn ultrasound<S: BrickSource + ?Sized>(
        &mut self,
        source: &S,
        settings: &Ultrasound,
        warp: Option<&Warp>,
        picture: &mut Picture,
    ) -> Result<FrameReport, GpuError> {
        let size = [picture.width, picture.height];
        let (plan, scan) = twin::fan(source, settings, warp, size)?;
        if size.contains(&0) {
            return Ok(FrameReport::default());
        }
        if picture.rgb.len() != 3 * size[0] * size[1] {
            return Err(RenderError::Picture { width: size[0], height: size[1], bytes: picture.rgb.len() }.into());
        }
        let (lines, samples, count) = (plan.lines, plan.samples, plan.samples + plan.half);
        let bytes = (16 * lines * count) as u64;
        if bytes > MOST_BYTES {
            let mib = MOST_BYTES >> 20;
            return Err(GpuError::Unsupported(format!("an ultrasound fan of {lines}×{samples} samples has more than {mib} MiB of them")));
        }
        let stage = |stage| Variant::of(Shows::Ultrasound(stage));
        let speckled = |at| Variant { speckle: plan.speckle, ..stage(at) };
        let gather = Variant { warp: warp.is_some(), exact: warp.is_some_and(|warp| twin::exact(warp).is_some()), ..stage(Stage::Gather) };
        let passes = [
            Pass::over(gather, [count, lines]),
            Pass { variant: stage(Stage::Walk), groups: [lines.div_ceil(64) as u32, 1] },
            Pass::over(speckled(Stage::Echo), [samples, lines]),
            Pass::over(speckled(Stage::Pulse), [samples, lines]),
            Pass::over(stage(Stage::Beam), [samples, lines]),
            Pass::over(stage(Stage::Scan), size),
        ];
        let packed = Packed::new(source.info(), &plan, &scan, size);
        let ways: Vec<[f32; 4]> = plan.ways.as_flattened().iter().map(|v| [number(v[0]), number(v[1]), number(v[2]), 0.0]).collect();
        let mut weights = Vec::with_capacity(samples * ROW + plan.pulse.len());
        for ((grey, reach), beam) in plan.grey.iter().zip(&plan.reach).zip(&plan.beam) {
            weights.extend([number(*grey), *reach as f32]);
            weights.extend(beam);
        }
        weights.extend(&plan.pulse);
        let (submission, report) = self.frame(&passes, source, size, |parts, traffic| {
            let (device, queue, storage) = (&parts.gpu.device, &parts.gpu.queue, wgpu::BufferUsages::STORAGE);
            let fan = &mut *parts.fan;
            traffic.other += fan.numbers.follow(device, queue, wgpu::BufferUsages::UNIFORM, bytemuck::bytes_of(&packed));
            traffic.other += fan.ways.follow(device, queue, storage, bytemuck::cast_slice(&ways));
            traffic.other += fan.weights.follow(device, queue, storage, bytemuck::cast_slice(&weights));
            fan.tissues.room(device, bytes);
            fan.places.room(device, bytes);
            fan.greys.room(device, (8 * lines * samples) as u64);
            if let Some(warp) = warp {
                parts.lattice.follow(parts.gpu, warp, traffic);
            }
        })?;
        self.collect(submission, false, picture)?;
        if let Some(depth) = &mut picture.depth {
            depth.fill(f32::INFINITY);
        }
        Ok(report)
    }

    /// Gives back what fans have on the device, until the next one.
    pub fn forget_ultrasound(&mut self) {
        self.fan = Fan::default();
    }
}
