//! A picture: bands of rows over the threads, tiles within a band, one kernel chosen at run time.

use crate::{
    camera::Camera,
    frame::Frame,
    picture::Picture,
    scalar::{Caster, Seen},
    settings::{Light, Mode, Settings},
    skip::Skip,
};
use maille_volume::BrickSource;
use rayon::prelude::*;
use thiserror::Error;

/// Rows of a band: a task.
const BAND: usize = 16;
/// Columns of a tile: rays that share bricks in the first cache.
const TILE: usize = 32;

/// Why no picture was made.
#[derive(Debug, Error, Clone, PartialEq)]
pub enum RenderError {
    /// see [`Camera::fault`]
    #[error("{0}")]
    Camera(String),
    /// step, transfer function, light or threshold out of range
    #[error("{0}")]
    Settings(String),
    /// the picture's memory is not that of its size, or it has no pixel
    #[error("a picture of {width}×{height} pixels has {bytes} bytes of colour")]
    Picture {
        /// pixels across
        width: usize,
        /// pixels down
        height: usize,
        /// bytes it has
        bytes: usize,
    },
    /// [`Skip::update`] was not called with these settings and this source
    #[error("the map of empty space belongs to other settings or another volume: update it first")]
    StaleSkip,
}

/// Which code walks the rays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernel {
    /// the fastest that this processor runs
    #[default]
    Fastest,
    /// one ray at a time: the reference
    Scalar,
    /// one ray at a time, looking at every sample
    ScalarWithoutSkipping,
}

/// Renders a picture on the current rayon pool.
///
/// # Errors
/// [`RenderError`]; the picture is then untouched.
pub fn render(
    source: &(impl BrickSource + ?Sized),
    skip: &Skip,
    camera: &Camera,
    settings: &Settings,
    picture: &mut Picture,
) -> Result<(), RenderError> {
    render_with(Kernel::Fastest, source, skip, camera, settings, picture)
}

/// [`render`] with a kernel of one's choice; for tests and measurements.
///
/// # Errors
/// [`RenderError`]; the picture is then untouched.
pub fn render_with<S: BrickSource + ?Sized>(
    kernel: Kernel,
    source: &S,
    skip: &Skip,
    camera: &Camera,
    settings: &Settings,
    picture: &mut Picture,
) -> Result<(), RenderError> {
    check(source, skip, camera, settings, picture)?;
    let (width, height) = (picture.width, picture.height);
    let frame = Frame::new(source.info(), camera, settings, width, height);
    let caster = Caster { frame: &frame, source, skip: (kernel != Kernel::ScalarWithoutSkipping).then_some(skip) };
    let vector = kernel == Kernel::Fastest && packets_run_here();
    let band = |n: usize, rgb: &mut [u8], mut depth: Option<&mut [f32]>| {
        let rows = rgb.len() / (3 * width);
        for x0 in (0..width).step_by(TILE) {
            let columns = TILE.min(width - x0);
            let put = |x: usize, y: usize, seen: Seen| {
                let at = (y - n * BAND) * width + x;
                write_pixel(&frame, seen, &mut rgb[3 * at..3 * at + 3]);
                if let Some(depth) = &mut depth {
                    depth[at] = seen.depth;
                }
            };
            cast_tile(&caster, skip, vector, [x0, n * BAND], [columns, rows], put);
        }
    };
    let colors = picture.rgb.par_chunks_mut(BAND * 3 * width).enumerate().with_max_len(1);
    match &mut picture.depth {
        Some(depth) => colors.zip(depth.par_chunks_mut(BAND * width)).for_each(|((n, rgb), depth)| band(n, rgb, Some(depth))),
        None => colors.for_each(|(n, rgb)| band(n, rgb, None)),
    }
    Ok(())
}

fn check<S: BrickSource + ?Sized>(
    source: &S,
    skip: &Skip,
    camera: &Camera,
    settings: &Settings,
    picture: &Picture,
) -> Result<(), RenderError> {
    let Picture { width, height, .. } = *picture;
    let pixels = width * height;
    if pixels == 0 || picture.rgb.len() != 3 * pixels || picture.depth.as_ref().is_some_and(|d| d.len() != pixels) {
        return Err(RenderError::Picture { width, height, bytes: picture.rgb.len() });
    }
    if let Some(fault) = camera.fault() {
        return Err(RenderError::Camera(fault));
    }
    if let Some(fault) = settings.transfer.fault() {
        return Err(RenderError::Settings(format!("the transfer function has {fault}")));
    }
    let step = settings.step.millimetres(source.info());
    if !(step.is_finite() && step > 0.0) {
        return Err(RenderError::Settings(format!("a step of {step} mm is not positive and finite")));
    }
    if !(0.5..=1.0).contains(&settings.opacity_end) {
        return Err(RenderError::Settings(format!("rays that end at an opacity of {}: it must be 0.5 to 1", settings.opacity_end)));
    }
    if let Mode::Isosurface { threshold_hu: v, .. } | Mode::Xray { water_per_mm: v } = settings.mode
        && !v.is_finite()
    {
        return Err(RenderError::Settings(format!("{v} is no threshold or attenuation")));
    }
    if let Some(Light::AtEye { half_distance_mm: d }) = settings.shading.map(|s| s.light)
        && (d <= 0.0 || d.is_nan())
    {
        return Err(RenderError::Settings(format!("a light of half distance {d} mm: it must be positive")));
    }
    if !skip.suits(source, settings) {
        return Err(RenderError::StaleSkip);
    }
    Ok(())
}

/// Casts the rays of a tile and hands each pixel on.
fn cast_tile<S: BrickSource + ?Sized>(
    caster: &Caster<'_, S>,
    skip: &Skip,
    vector: bool,
    first: [usize; 2],
    size: [usize; 2],
    mut put: impl FnMut(usize, usize, Seen),
) {
    #[cfg(target_arch = "x86_64")]
    if vector {
        return crate::packet::cast_tile(caster.frame, caster.source, skip, first, size, put);
    }
    let _ = (skip, vector);
    for y in first[1]..first[1] + size[1] {
        for x in first[0]..first[0] + size[0] {
            put(x, y, caster.cast(x, y));
        }
    }
}

/// Whether the packet kernel runs on this processor.
fn packets_run_here() -> bool {
    #[cfg(target_arch = "x86_64")]
    return crate::packet::available();
    #[cfg(not(target_arch = "x86_64"))]
    false
}

#[inline]
fn write_pixel(frame: &Frame, seen: Seen, rgb: &mut [u8]) {
    for (c, byte) in rgb.iter_mut().enumerate() {
        let v = seen.color[c] + seen.transmittance * frame.background[c];
        *byte = (v * 255.0 + 0.5).clamp(0.0, 255.0) as u8;
    }
}
