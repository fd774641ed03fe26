//! A picture: bands of rows over the threads, tiles within a band, one kernel chosen at run time.

use crate::{
    beam,
    camera::Camera,
    frame::Frame,
    geometry::Geometry,
    labels::Labels,
    packet::{self, Area, Width},
    picture::Picture,
    raster::{Band, Solids},
    scalar::{Caster, Seen},
    settings::{Light, Mode, Settings},
    skip::Skip,
    warp::{Tile, View, Warp},
    zoom::{Again, Lens},
};
use maille_volume::BrickSource;
use rayon::prelude::*;
use thiserror::Error;

/// Rows of a band: a task.
const BAND: usize = 16;
/// Columns of a tile: rays that share bricks in the first cache.
const TILE: usize = 32;
/// Both.
pub(crate) const TILES: [usize; 2] = [TILE, BAND];

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
    /// a warp or labels made for another volume, or a warp that was never updated
    #[error("{0}")]
    Extras(String),
    /// an ultrasound fan that makes no sense (see [`Ultrasound::fault`](crate::Ultrasound::fault)), or whose warp is another volume's
    #[error("{0}")]
    Ultrasound(String),
}

/// Which code walks the rays.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernel {
    /// the fastest that this processor runs
    #[default]
    Fastest,
    /// packets in plain Rust
    Portable,
    /// packets of eight rays; [`Kernel::Portable`] where the processor has no AVX2
    Avx2,
    /// packets of sixteen rays; [`Kernel::Portable`] where the processor has no AVX-512
    Avx512,
    /// one ray at a time: the reference, without warp and labels
    Scalar,
    /// one ray at a time, looking at every sample
    ScalarWithoutSkipping,
}

/// How rays go through a warp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WarpScheme {
    /// by lattices, and one by one where those do not suffice: within the warp's tolerance
    #[default]
    Lattice,
    /// one step of the fixed point a sample [Fortmeier et al. 2015, eq. 1 and 2]: a reference, whose error nobody knows. The warp must keep its field
    /// ([`WarpOptions::keep_field`](crate::WarpOptions))
    OneStep,
}

/// What a picture may have beside volume, camera and settings.
#[derive(Clone, Copy, Debug, Default)]
pub struct Extras<'a> {
    /// which code walks the rays
    pub kernel: Kernel,
    /// a displacement field that rays go through
    pub warp: Option<&'a Warp>,
    /// how they go through it
    pub scheme: WarpScheme,
    /// colours of organs (volume modes)
    pub labels: Option<&'a Labels>,
    /// solid bodies among the voxels
    pub geometry: Option<&'a Geometry<'a>>,
    /// surfaces seen from nearer than a pixel a voxel are sampled on the smooth function ([`crate::zoom`])
    pub zoom: bool,
    /// barrel distortion k of the lens, at least 0: the ray of a point at radius r (1 at the upper edge) looks along r·(1 + k r²)/(1 + k),
    /// so that the field of view holds at the upper edge and what is further out shrinks
    pub barrel: f64,
}

/// What kernels read.
pub(crate) struct Stage<'a, S: ?Sized> {
    pub frame: &'a Frame,
    pub source: &'a S,
    pub skip: &'a Skip,
    pub labels: Option<&'a Labels>,
    /// what rays go through by one step a sample
    pub led: Option<&'a Warp>,
}

/// Where rays of a band end.
pub(crate) struct Ends<'a> {
    /// the bodies in the band
    pub band: &'a Band,
    /// its first row
    pub row: usize,
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
    render_extra(&Extras::default(), source, skip, camera, settings, picture)
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
    render_extra(&Extras { kernel, ..Extras::default() }, source, skip, camera, settings, picture)
}

/// [`render`] with everything that a picture may have.
///
/// # Errors
/// [`RenderError`]; the picture is then untouched.
pub fn render_extra<S: BrickSource + ?Sized>(
    extras: &Extras<'_>,
    source: &S,
    skip: &Skip,
    camera: &Camera,
    settings: &Settings,
    picture: &mut Picture,
) -> Result<(), RenderError> {
    check(source, skip, camera, settings, picture)?;
    check_extras(extras, source)?;
    let (width, height) = (picture.width, picture.height);
    let margin = extras.warp.map_or([0.0; 3], Warp::margin);
    let frame = Frame::new(source.info(), camera, settings, [width, height], extras.barrel as f32, margin);
    let caster = Caster { frame: &frame, source, skip, jumps: extras.kernel != Kernel::ScalarWithoutSkipping };
    let led = extras.warp.filter(|_| extras.scheme == WarpScheme::OneStep);
    let stage = Stage { frame: &frame, source, skip, labels: extras.labels, led };
    let view = extras.warp.filter(|_| led.is_none()).map(|w| View::new(w, &frame, Some(skip), [width, height], TILES));
    let solids = extras.geometry.filter(|g| !g.is_empty());
    let solids = solids.map(|g| Solids::new(g, camera, settings, [width, height], extras.barrel as f32, BAND));
    let lanes = match extras.kernel {
        Kernel::Fastest => Some(packet::widest()),
        Kernel::Portable => Some(Width::Portable),
        Kernel::Avx2 => Some(Width::Avx2),
        Kernel::Avx512 => Some(Width::Avx512),
        Kernel::Scalar | Kernel::ScalarWithoutSkipping => None,
    };
    let band = |n: usize, rgb: &mut [u8], mut depth: Option<&mut [f32]>| {
        let rows = rgb.len() / (3 * width);
        let solid = solids.as_ref().and_then(|s| s.band(n));
        let ends = solid.as_ref().map(|band| Ends { band, row: n * BAND });
        let mut lens = extras.zoom.then(|| Lens::new(&frame, source.info().grid.min_spacing(), extras.warp)).flatten();
        let zoomed = lens.is_some();
        let mut tile = view.as_ref().map(|view| Tile::new(view, TILES));
        for x0 in (0..width).step_by(TILE) {
            let columns = TILE.min(width - x0);
            if let Some(tile) = &mut tile {
                tile.begin([x0, n * BAND], [columns, rows]);
            }
            let mut put = |x: usize, y: usize, mut seen: Seen| {
                let at = (y - n * BAND) * width + x;
                let mut behind = frame.background;
                if let Some(band) = &solid
                    && band.depth[at] < f32::INFINITY
                {
                    behind = band.color[at];
                    // as for the volume: where half of the light is gone
                    seen.depth = if seen.transmittance > 0.5 { band.depth[at] } else { seen.depth };
                }
                if let Some(lens) = lens.as_mut().filter(|_| seen.transmittance == 0.0) {
                    lens.add(x, y, seen.depth, seen.color);
                }
                write_pixel(seen, behind, &mut rgb[3 * at..3 * at + 3]);
                if let Some(depth) = &mut depth {
                    depth[at] = seen.depth;
                }
            };
            match lanes {
                Some(lanes) => {
                    let (first, size) = ([x0, n * BAND], [columns, rows]);
                    let clear = match &view {
                        // so that rays which come in where the volume is cut open have a sample outside before
                        Some(view) => view.span(n * width.div_ceil(TILE) + x0 / TILE)[0] - frame.step,
                        None if led.is_some() => 0.0,
                        None => beam::span(&frame, skip, None, first, size, 0.0)[0],
                    };
                    if clear == f32::INFINITY && solid.is_none() {
                        // nothing at all
                        let nothing = Seen { color: [0.0; 3], transmittance: 1.0, depth: f32::INFINITY };
                        (0..rows).for_each(|row| (x0..x0 + columns).for_each(|x| put(x, n * BAND + row, nothing)));
                        continue;
                    }
                    let area = Area { first, size, clear };
                    // pixel by pixel where something looks at each; else a packet's pixels together
                    if solid.is_some() || zoomed {
                        packet::cast_tile(lanes, &stage, ends.as_ref(), tile.as_mut(), area, |seen| seen.each(&mut put));
                    } else {
                        packet::cast_tile(lanes, &stage, None, tile.as_mut(), area, |seen| {
                            let at = (seen.first[1] - n * BAND) * width + seen.first[0];
                            seen.write(frame.background, &mut rgb[3 * at..], depth.as_deref_mut().map(|d| &mut d[at..]), width);
                        });
                    }
                }
                None => (n * BAND..n * BAND + rows).for_each(|y| {
                    (x0..x0 + columns).for_each(|x| {
                        let end = solid.as_ref().map_or(f32::INFINITY, |band| band.depth[(y - n * BAND) * width + x]);
                        put(x, y, caster.cast(x, y, end));
                    });
                }),
            }
            if let Some(lens) = &mut lens {
                lens.look(source, |Again { x, y, color, depth: away }| {
                    let at = (y - n * BAND) * width + x;
                    write_pixel(Seen { color, transmittance: 0.0, depth: away }, frame.background, &mut rgb[3 * at..3 * at + 3]);
                    if let Some(depth) = &mut depth {
                        depth[at] = away;
                    }
                });
            }
        }
    };
    let colors = picture.rgb.par_chunks_mut(BAND * 3 * width).enumerate().with_max_len(1);
    match &mut picture.depth {
        Some(depth) => colors.zip(depth.par_chunks_mut(BAND * width)).for_each(|((n, rgb), depth)| band(n, rgb, Some(depth))),
        None => colors.for_each(|(n, rgb)| band(n, rgb, None)),
    }
    Ok(())
}

pub(crate) fn check_extras<S: BrickSource + ?Sized>(extras: &Extras<'_>, source: &S) -> Result<(), RenderError> {
    let fault = |text: &str| Err(RenderError::Extras(text.into()));
    if !(extras.barrel >= 0.0 && extras.barrel.is_finite()) {
        return fault("a barrel distortion must be 0 or more");
    }
    if extras.warp.is_some_and(|w| !w.suits(source.info())) {
        return fault("the warp was made for another volume, or never updated");
    }
    if extras.scheme == WarpScheme::OneStep && extras.warp.is_some_and(|w| w.whole().is_none()) {
        return fault("rays by one step of the fixed point ask the field itself: the warp must keep it");
    }
    if extras.labels.is_some_and(|l| l.size() != source.info().grid.size) {
        return fault("the labels are not on the volume's grid");
    }
    extras.geometry.map_or(Ok(()), Geometry::check)?;
    let reference = matches!(extras.kernel, Kernel::Scalar | Kernel::ScalarWithoutSkipping);
    if reference && (extras.warp.is_some() || extras.labels.is_some()) {
        return fault("the scalar kernel knows neither warp nor labels");
    }
    Ok(())
}

pub(crate) fn check<S: BrickSource + ?Sized>(
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
    if let Mode::Isosurface { threshold_hu: v, .. } | Mode::Both { threshold_hu: v, .. } | Mode::Xray { water_per_mm: v } = settings.mode
        && !v.is_finite()
    {
        return Err(RenderError::Settings(format!("{v} is no threshold or attenuation")));
    }
    if let Some(a) = settings.adaptive {
        let lengths = a.shortest >= 0.01 && a.shortest <= 1.0 && a.longest >= 1.0 && a.longest <= 64.0;
        if !(lengths && a.heaviest > 0.0 && a.lightest <= a.heaviest && a.gentle_opacity.is_finite()) {
            return Err(RenderError::Settings(format!("pieces of ray by {a:?}: limits out of order")));
        }
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

#[inline]
fn write_pixel(seen: Seen, behind: [f32; 3], rgb: &mut [u8]) {
    for (c, byte) in rgb.iter_mut().enumerate() {
        let v = seen.color[c] + seen.transmittance * behind[c];
        *byte = (v * 255.0 + 0.5).clamp(0.0, 255.0) as u8;
    }
}
