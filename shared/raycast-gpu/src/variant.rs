//! Shader variants: WGSL put together from pieces, so that a picture's shader holds only what the picture asks for.
//!
//! A line `#if A|B` keeps what follows, up to `#else` or `#end`, when one of its words is among the variant's; blocks may be nested. Sizes
//! that do not change while a volume is shown are constants of the source.

use maille_volume::{
    BrickLayout,
    brick::{Brick, CELL, CELLS_EDGE, EDGE, ROW, SLICE},
};
use std::fmt::Write as _;

/// Bits of a slot's number within its buffer; those above name the buffer.
pub(crate) const SLOT_BITS: u32 = 26;
/// Larger than any distance in a picture: instead of an infinity, which shaders need not know.
pub(crate) const FAR: f32 = 3.0e38;
/// A section's pixel is in the volume up to this far beyond the outermost voxels [index]: f32 has no better on 512 voxels.
const NEARLY: f32 = 1e-4;

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Shows {
    /// composition under the transfer function
    Volume,
    /// the first surface
    Isosurface,
    /// both
    Both,
    /// a radiograph
    Xray,
    /// a flat section
    Section,
    /// a part of the way to an ultrasound fan
    Ultrasound(Stage),
}

/// Passes of an ultrasound fan, in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stage {
    /// tissue of every sample
    Gather,
    /// what of the sound comes down each line
    Walk,
    /// echoes of interfaces and scatterers
    Echo,
    /// over the pulse's length
    Pulse,
    /// over the beam's width, then grey
    Beam,
    /// pixels
    Scan,
}

/// All that makes one shader another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Variant {
    /// the view
    pub shows: Shows,
    /// light
    pub shaded: bool,
    /// the light is at the eye
    pub at_eye: bool,
    /// rays or positions go through a displacement field
    pub warp: bool,
    /// places are found one by one where a lattice of it does not suffice
    pub exact: bool,
    /// colours of organs
    pub labels: bool,
    /// depth is asked for
    pub depth: bool,
    /// rays end at solid bodies
    pub ends: bool,
    /// pieces of ray by weight
    pub pieces: bool,
    /// a lens with barrel distortion
    pub barrel: bool,
    /// a thick section
    pub slab: bool,
    /// the largest value through a section instead of the mean
    pub maximum: bool,
    /// the displacement over a section
    pub overlay: bool,
    /// scatterers in an ultrasound fan
    pub speckle: bool,
}

impl Variant {
    /// Nothing but a view.
    pub fn of(shows: Shows) -> Self {
        Self {
            shows,
            shaded: false,
            at_eye: false,
            warp: false,
            exact: false,
            labels: false,
            depth: false,
            ends: false,
            pieces: false,
            barrel: false,
            slab: false,
            maximum: false,
            overlay: false,
            speckle: false,
        }
    }

    fn is(&self, stage: Stage) -> bool {
        self.shows == Shows::Ultrasound(stage)
    }

    /// Whether it looks at voxels.
    pub(crate) fn samples(&self) -> bool {
        !matches!(self.shows, Shows::Ultrasound(Stage::Walk | Stage::Pulse | Stage::Beam | Stage::Scan))
    }

    fn has(&self, word: &str) -> bool {
        match word {
            "SHADED" => self.shaded,
            "AT_EYE" => self.at_eye,
            "WARP" => self.warp,
            "EXACT" => self.exact,
            "LABELS" => self.labels,
            "DEPTH" => self.depth,
            "ENDS" => self.ends,
            "PIECES" => self.pieces,
            "BARREL" => self.barrel,
            "SLAB" => self.slab,
            "MAXIMUM" => self.maximum,
            "OVERLAY" => self.overlay,
            "ISOSURFACE" => self.shows == Shows::Isosurface,
            "XRAY" => self.shows == Shows::Xray,
            "TABLE" => matches!(self.shows, Shows::Volume | Shows::Both),
            "SURFACE" => matches!(self.shows, Shows::Isosurface | Shows::Both),
            "RAYS" => !matches!(self.shows, Shows::Section | Shows::Ultrasound(_)),
            "SPECKLE" => self.speckle,
            "GATHER" => self.is(Stage::Gather),
            "WALK" => self.is(Stage::Walk),
            "ECHO" => self.is(Stage::Echo),
            "PULSE" => self.is(Stage::Pulse),
            "BEAM" => self.is(Stage::Beam),
            "SCAN" => self.is(Stage::Scan),
            other => unreachable!("{other} is no word of a variant"),
        }
    }

    /// The WGSL of this variant for volumes of a layout whose voxels lie in as many buffers.
    pub fn source(&self, layout: &BrickLayout, buffers: usize) -> String {
        let mut pieces = vec![];
        if self.has("RAYS") {
            pieces.extend([include_str!("frame.wgsl"), include_str!("skip.wgsl")]);
        }
        if self.samples() {
            pieces.push(include_str!("voxels.wgsl"));
        }
        if self.shaded || self.is(Stage::Echo) {
            pieces.push(include_str!("gradient.wgsl"));
        }
        if self.warp {
            pieces.push(include_str!("warp.wgsl"));
        }
        if self.labels {
            pieces.push(include_str!("labels.wgsl"));
        }
        match self.shows {
            Shows::Xray => pieces.push(include_str!("scalar.wgsl")),
            Shows::Section => pieces.push(include_str!("section.wgsl")),
            Shows::Ultrasound(_) => pieces.push(include_str!("ultrasound.wgsl")),
            Shows::Volume | Shows::Isosurface | Shows::Both => pieces.extend([include_str!("shade.wgsl"), include_str!("scalar.wgsl")]),
        }
        let mut out = constants(layout);
        if self.samples() {
            words(&mut out, buffers);
        }
        if matches!(self.shows, Shows::Ultrasound(_)) {
            echoes(&mut out);
        }
        if self.is(Stage::Gather) {
            tissue(&mut out);
        }
        for piece in pieces {
            self.keep(piece, &mut out);
        }
        out
    }

    fn keep(&self, piece: &str, out: &mut String) {
        // whether each open block is kept
        let mut open: Vec<bool> = Vec::new();
        for line in piece.lines() {
            let line_of = line.trim_start();
            if let Some(condition) = line_of.strip_prefix("#if ") {
                open.push(condition.split('|').any(|word| self.has(word.trim())));
            } else if line_of == "#else" {
                let last = open.last_mut().expect("#else follows an #if");
                *last = !*last;
            } else if line_of == "#end" {
                open.pop().expect("#end follows an #if");
            } else if open.iter().all(|&kept| kept) {
                out.push_str(line);
                out.push('\n');
            }
        }
        assert!(open.is_empty(), "every #if has its #end");
    }
}

fn constants(layout: &BrickLayout) -> String {
    use maille_raycast::twin::{GENTLE, LAST_PIECE, REFINEMENTS, TINY, ZERO_GRADIENT};
    let mut out = String::new();
    let mut put = |text: String| writeln!(out, "{text}").expect("a string takes all");
    for (axis, c) in ["X", "Y", "Z"].into_iter().zip(0..) {
        put(format!("const SIZE_{axis}: i32 = {};", layout.size[c]));
        put(format!("const LAST_CELL_{axis}: i32 = {};", layout.size[c].saturating_sub(2)));
        put(format!("const BRICKS_{axis}: i32 = {};", layout.counts[c]));
        put(format!("const CELLS_{axis}: i32 = {};", layout.counts[c] * CELLS_EDGE));
    }
    put(format!("const EDGE: i32 = {EDGE};\nconst CELL: i32 = {CELL};\nconst ROW: u32 = {ROW}u;\nconst SLICE: u32 = {SLICE}u;"));
    put(format!("const HALVES: u32 = {}u;", size_of::<Brick>() / 2));
    put(format!("const SLOT_BITS: u32 = {SLOT_BITS}u;\nconst SLOT_MASK: u32 = {}u;", (1u32 << SLOT_BITS) - 1));
    put(format!("const GENTLE: u32 = {GENTLE}u;\nconst REFINEMENTS: i32 = {REFINEMENTS};"));
    put(format!("const TINY: f32 = {TINY:e};\nconst LAST_PIECE: f32 = {LAST_PIECE:e};\nconst ZERO_GRADIENT: f32 = {ZERO_GRADIENT:e};"));
    let (looks, shortest, folded) = maille_raycast::twin::SETTLE;
    put(format!("const LOOKS: i32 = {looks};\nconst SHORTEST: f32 = {shortest:e};\nconst FOLDED: f32 = {folded:e};"));
    put(format!("const FAR: f32 = {FAR:e};\nconst NEARLY: f32 = {NEARLY:e};"));
    out
}

/// What an ultrasound fan goes by.
fn echoes(out: &mut String) {
    use maille_raycast::ultrasound::acoustic;
    let mut put = |text: String| writeln!(out, "{text}").expect("a string takes all");
    let (air, gas, faint, least_pass, least_echo) = maille_raycast::twin::ECHO;
    put(format!("const AIR_HU: f32 = {air:e};\nconst GAS_HU: f32 = {gas:e};\nconst FAINT: f32 = {faint:e};"));
    put(format!("const LEAST_PASS: f32 = {least_pass:e};\nconst LEAST_ECHO: f32 = {least_echo:e};"));
    put(format!("const GEL: f32 = {:e};\nconst WEIGHTS: u32 = {}u;", acoustic(0.0).impedance, crate::ultrasound::ROW));
}

/// What values mean to sound, as straight pieces over HU.
fn tissue(out: &mut String) {
    use maille_raycast::ultrasound::TISSUES;
    let mut put = |text: String| writeln!(out, "{text}").expect("a string takes all");
    let vector = |v: [f64; 3]| format!("vec3<f32>({:e}, {:e}, {:e})", v[0], v[1], v[2]);
    let row = |n: usize| [TISSUES[n].impedance, TISSUES[n].attenuation, TISSUES[n].scatter];
    put(format!("fn acoustic(hu: f32) -> vec3<f32> {{\n    var v = {};", vector(row(0))));
    for n in 1..TISSUES.len() {
        let (from, wide) = (TISSUES[n - 1].hu, TISSUES[n].hu - TISSUES[n - 1].hu);
        let rise = std::array::from_fn(|c| row(n)[c] - row(n - 1)[c]);
        put(format!("    v += {} * clamp((hu - ({from:e})) / {wide:e}, 0.0, 1.0);", vector(rise)));
    }
    put("    return v;\n}".into());
}

/// Bindings of the voxels' buffers, and the function that reads a word of one of them.
fn words(out: &mut String, buffers: usize) {
    let mut put = |text: String| writeln!(out, "{text}").expect("a string takes all");
    for n in 0..buffers {
        put(format!("@group(0) @binding({}) var<storage, read> voxels{n}: array<u32>;", VOXELS_BINDING as usize + n));
    }
    if buffers == 1 {
        put("fn word(chunk: u32, n: u32) -> u32 {\n    return voxels0[n];\n}".into());
        return;
    }
    put("fn word(chunk: u32, n: u32) -> u32 {\n    switch chunk {".into());
    for n in 0..buffers - 1 {
        put(format!("        case {n}u: {{ return voxels{n}[n]; }}"));
    }
    put(format!("        default: {{ return voxels{}[n]; }}\n    }}\n}}", buffers - 1));
}

/// Number of the first binding of voxels.
pub(crate) const VOXELS_BINDING: u32 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shader_holds_only_what_its_picture_asks_for() {
        let layout = BrickLayout::new([40, 30, 20]);
        let plain = Variant::of(Shows::Volume).source(&layout, 1);
        for absent in [
            "lattice",
            "bent",
            "offset_at",
            "exact",
            "label",
            "solid",
            "depths",
            "frame.shading",
            "fn gradient",
            "refine",
            "attenuation",
            "switch",
        ] {
            assert!(!code(&plain).contains(absent), "{absent} in a plain picture");
        }
        let warped = Variant { warp: true, shaded: true, ..Variant::of(Shows::Both) }.source(&layout, 3);
        for present in ["lattice", "offset_at", "fn gradient", "refine", "switch", "voxels2"] {
            assert!(code(&warped).contains(present), "{present} missing");
        }
        assert!(!code(&warped).contains("first_node"), "a smooth field's lattice suffices");
        let section = Variant { maximum: true, ..Variant::of(Shows::Section) }.source(&layout, 1);
        for absent in ["Ray", "table", "lattice", "label", "distances", "atan2"] {
            assert!(!code(&section).contains(absent), "{absent} in a section");
        }
        assert!(!code(&Variant::of(Shows::Xray).source(&layout, 1)).contains("table"));
    }

    #[test]
    fn only_shaders_of_ultrasound_hold_ultrasound_and_each_only_its_own_pass() {
        let layout = BrickLayout::new([40, 30, 20]);
        let all = [Shows::Volume, Shows::Isosurface, Shows::Both, Shows::Xray, Shows::Section];
        for shows in all {
            let full = Variant { shaded: true, warp: true, exact: true, labels: true, ..Variant::of(shows) }.source(&layout, 2);
            for absent in ["fan", "acoustic", "scatterer", "GAS_HU", "greys", "echoes", "hash"] {
                assert!(!full.contains(absent), "{absent} in {shows:?}");
            }
        }
        let stages = [Stage::Gather, Stage::Walk, Stage::Echo, Stage::Pulse, Stage::Beam, Stage::Scan];
        let sources = stages.map(|s| code(&Variant { speckle: true, ..Variant::of(Shows::Ultrasound(s)) }.source(&layout, 2)));
        for (stage, own) in stages.into_iter().zip(["acoustic(", "log2_less(", "scatterer(", "blurred[", "per_octave *", "colors["]) {
            for (other, source) in stages.iter().zip(&sources) {
                let shared = own == "blurred[" && *other == Stage::Beam;
                assert!(shared || source.contains(own) == (stage == *other), "{own} of {stage:?} in {other:?}");
            }
        }
        for (source, voxels) in sources.iter().zip([true, false, true, false, false, false]) {
            assert_eq!(source.contains("slots"), voxels);
            assert!(!source.contains("lattice") && !source.contains("Ray"));
        }
        let silent = Variant::of(Shows::Ultrasound(Stage::Echo)).source(&layout, 1);
        assert!(!silent.contains("hash"), "nobody asked for scatterers");
    }

    /// Without comments and the frame's one set of numbers.
    fn code(source: &str) -> String {
        let lines = source.lines().filter(|l| !l.trim_start().starts_with("//"));
        lines.filter(|l| !l.trim_end().ends_with("f32,") && !l.starts_with("const")).collect::<Vec<_>>().join("\n")
    }
}
