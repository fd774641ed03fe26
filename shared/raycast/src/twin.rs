//! What the twin on a GPU reads: the numbers of a frame, tables and maps, as this crate's own kernels have them.
//!
//! One place works them out, so that twins cannot drift apart: [`frame`] checks as [`render_extra`](crate::render_extra) does and
//! gives plain numbers; maps are borrowed where they lie. Not a second interface for those who want pictures.

use crate::{
    Camera, Extras, Geometry, Labels, Picture, Plane, RenderError, Section, Settings, Skip, Ultrasound, Warp,
    frame::Frame,
    raster::Solids,
    render::{check, check_extras},
    settings::Adaptive,
    ultrasound,
};
use maille_volume::BrickSource;

pub use crate::ultrasound::{MOST_LINES, Plan as Fan, Scan};
pub use crate::warp::Exact;
pub use crate::{frame::REFINEMENTS, frame::TINY, scalar::ZERO_GRADIENT, skip::GENTLE, walk::LAST_PIECE};

/// Numbers of one frame; lengths in mm or continuous indices, as in the reference's own frame.
#[derive(Clone, Debug)]
pub struct Numbers {
    /// eye [index]
    pub eye: [f32; 3],
    /// view in the grid's axes: forward, right and down (times the tangents)
    pub view: [[f32; 3]; 3],
    /// index steps per millimetre
    pub per_mm: [f32; 3],
    /// pixel ↦ units of right and down: scale x, y and shift x, y
    pub lens: [f32; 4],
    /// width over height
    pub aspect: f32,
    /// barrel distortion
    pub barrel: f32,
    /// distance between samples [mm]
    pub step: f32,
    /// light left at which a ray stops
    pub opaque: f32,
    /// pieces of ray by weight
    pub pieces: Adaptive,
    /// index of the last voxel
    pub last: [f32; 3],
    /// how far beyond the volume rays begin and end [index]
    pub margin: [f32; 3],
    /// stored value ↦ what the mode looks at: scale and offset
    pub value: [f32; 2],
    /// the surface's value, in what the mode looks at
    pub threshold: f32,
    /// r, g, b, log₂ of what one step lets through
    pub table: Vec<[f32; 4]>,
    /// direction to the headlight in the grid's axes
    pub light: [f32; 3],
    /// 1 / half distance² of a light at the eye [1/mm²]
    pub falloff: f32,
    /// whether the light is there
    pub at_eye: bool,
}

/// Numbers of a frame, after the same checks as [`render_extra`](crate::render_extra)'s.
///
/// # Errors
/// [`RenderError`].
pub fn frame<S: BrickSource + ?Sized>(
    extras: &Extras<'_>,
    source: &S,
    skip: &Skip,
    camera: &Camera,
    settings: &Settings,
    picture: &Picture,
) -> Result<Numbers, RenderError> {
    check(source, skip, camera, settings, picture)?;
    check_extras(extras, source)?;
    let margin = extras.warp.map_or([0.0; 3], Warp::margin);
    let f = Frame::new(source.info(), camera, settings, [picture.width, picture.height], extras.barrel as f32, margin);
    Ok(Numbers {
        eye: f.eye,
        view: [f.forward, f.right, f.down],
        per_mm: f.per_mm,
        lens: [f.scale[0], f.scale[1], f.shift[0], f.shift[1]],
        aspect: f.aspect,
        barrel: f.barrel,
        step: f.step,
        opaque: f.opaque,
        pieces: f.adaptive,
        last: f.last,
        margin: f.margin,
        value: [f.value_scale, f.value_offset],
        threshold: f.threshold,
        table: f.table.entries,
        light: f.light,
        falloff: f.falloff,
        at_eye: f.at_eye,
    })
}

/// Distances of the map of empty space (with [`GENTLE`]), i fastest and three bytes more than there are cells; cells along each axis.
pub fn distances(skip: &Skip) -> (&[u8], [usize; 3]) {
    skip.distances()
}

/// Labels of all voxels, i fastest, and a number that differs wherever they may.
pub fn label_voxels(labels: &Labels) -> (&[u8], u64) {
    labels.voxels()
}

/// The lattice of a warp, as rays read it.
#[derive(Clone, Copy, Debug)]
pub struct Lattice<'a> {
    /// of node 0 [index]
    pub origin: [f32; 3],
    /// nodes per index step
    pub per_pitch: [f32; 3],
    /// nodes along each axis
    pub counts: [usize; 3],
    /// v [index] of each node, i fastest; the fourth number is none
    pub nodes: &'a [[f32; 4]],
    /// of the volume [mm]
    pub spacing: [f32; 3],
}

/// The lattice of a warp.
pub fn lattice(warp: &Warp) -> Lattice<'_> {
    warp.lattice()
}

/// What rays ask where a warp's lattice does not suffice, and how far from where it leads they may then be [index]; none where it does everywhere.
pub fn exact(warp: &Warp) -> Option<(Exact<'_>, [f32; 3])> {
    warp.exact().map(|exact| (exact, warp.astray()))
}

/// Looks at a field, the shortest part of a step, and the determinant below which there is no step of Newton's.
pub const SETTLE: (usize, f32, f32) = (crate::warp::LOOKS, crate::warp::SHORTEST, crate::warp::FOLDED);

/// Whether a warp and labels belong to a source: sections leave out those that do not.
pub fn suits<S: BrickSource + ?Sized>(warp: &Warp, source: &S) -> bool {
    warp.suits(source.info())
}

/// The nearest solid bodies of a picture: colour and distance from the eye [mm] of each pixel (infinite where none is); `None`
/// without any in sight. The geometry must have been checked ([`frame`] does).
pub fn solids(geometry: &Geometry<'_>, camera: &Camera, settings: &Settings, size: [usize; 2], barrel: f64) -> Option<Vec<[f32; 4]>> {
    let solids = Solids::new(geometry, camera, settings, size, barrel as f32, size[1]);
    let band = solids.band(0)?;
    Some(band.color.iter().zip(&band.depth).map(|(&[r, g, b], &d)| [r, g, b, d]).collect())
}

/// Draws the outlines of a geometry over a section, as [`section_with`](crate::section_with) does; one with a fault is left out.
pub fn outlines(geometry: &Geometry<'_>, section: &Section, picture: &mut Picture) {
    if !geometry.is_empty() && geometry.check().is_ok() {
        crate::outline::outlines(geometry, section, picture);
    }
}

/// As many planes as a slab is made of.
pub fn planes(section: &Section, min_spacing: f64) -> usize {
    section.planes(min_spacing)
}

/// Unit vectors of a section: right, down, normal [LPS].
pub fn section_axes(plane: Plane) -> [[f64; 3]; 3] {
    let [right, down] = plane.axes();
    [right, down, crate::geometry::cross(right, down)]
}

/// Numbers of a fan and of its picture, after the same checks as [`ultrasound`](crate::ultrasound())'s.
///
/// # Errors
/// [`RenderError::Ultrasound`], in its words.
pub fn fan<S: BrickSource + ?Sized>(
    source: &S,
    settings: &Ultrasound,
    warp: Option<&Warp>,
    size: [usize; 2],
) -> Result<(Fan, Scan), RenderError> {
    let plan = ultrasound::planned(source, settings, warp).map_err(RenderError::Ultrasound)?;
    let scan = Scan::new(settings, &plan, size);
    Ok((plan, scan))
}

/// What decides along a line: values of air and below which there is gas (HU), interfaces too faint for a direction, the least that one lets through, the
/// least echo.
pub const ECHO: (f64, f64, f64, f64, f32) =
    (ultrasound::AIR_HU, ultrasound::GAS_HU, ultrasound::FAINT, ultrasound::LEAST_PASS, ultrasound::LEAST_ECHO);
