//! The numbers of a frame as shaders read them: raycast's frame, packed.

use bytemuck::{Pod, Zeroable};
use maille_raycast::{Mode, Settings, twin::Numbers};

/// As `Frame` in `frame.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(crate) struct Packed {
    eye: [f32; 3],
    step: f32,
    forward: [f32; 3],
    aspect: f32,
    right: [f32; 3],
    barrel: f32,
    down: [f32; 3],
    opaque: f32,
    per_mm: [f32; 3],
    value_scale: f32,
    margin: [f32; 3],
    value_offset: f32,
    last: [f32; 3],
    threshold: f32,
    light: [f32; 3],
    falloff: f32,
    surface: [f32; 3],
    water: f32,
    background: [f32; 3],
    shade_from: f32,
    lens: [f32; 4],
    shading: [f32; 3],
    power: u32,
    pieces: [f32; 4],
    size: [u32; 2],
    entries: u32,
    unused: u32,
}

const _: () = assert!(size_of::<Packed>() == 14 * 16);

impl Packed {
    pub fn new(n: &Numbers, settings: &Settings, size: [usize; 2]) -> Self {
        let (surface, water) = match settings.mode {
            Mode::Isosurface { color, .. } | Mode::Both { color, .. } => (color, 0.0),
            Mode::Xray { water_per_mm } => ([0.0; 3], water_per_mm as f32),
            Mode::Volume => ([0.0; 3], 0.0),
        };
        let s = settings.shading;
        Self {
            eye: n.eye,
            step: n.step,
            forward: n.view[0],
            aspect: n.aspect,
            right: n.view[1],
            barrel: n.barrel,
            down: n.view[2],
            opaque: n.opaque,
            per_mm: n.per_mm,
            value_scale: n.value[0],
            margin: n.margin,
            value_offset: n.value[1],
            last: n.last,
            threshold: n.threshold,
            light: n.light,
            falloff: n.falloff,
            surface,
            water,
            background: settings.background,
            shade_from: n.pieces.shade_from,
            lens: n.lens,
            shading: s.map_or([0.0; 3], |s| [s.ambient * s.ambient_light, s.diffuse, s.specular]),
            power: s.map_or(0, |s| s.power),
            pieces: [n.pieces.heaviest, n.pieces.lightest, n.pieces.shortest, n.pieces.longest].map(|v| v.min(f32::MAX)),
            size: size.map(|v| v as u32),
            entries: n.table.len() as u32,
            unused: 0,
        }
    }
}
