//! A model as bytes: the same in a file and in a read-only region of shared memory, used where it lies.
//!
//! `MAILLE-MOTION/1\n` · u64 length of the description (little endian) · description (JSON) · the fields' nodes, each at a multiple of 64 bytes from
//! the beginning. A region's body is aligned to 64 bytes, so that [`MotionModel::view`] copies nothing; bytes that are not aligned
//! (a file read into any buffer) are copied. Nodes are little endian: on other machines `view` refuses.
//!
//! What is read is checked before it is used: sizes, places, measures. Not here: files, regions.

use super::packed::{Measures, Nodes, PackedField, Precision};
use super::{Kind, MotionModel};
use crate::MotionError;
use bytemuck::Pod;
use maille_volume::Grid;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// First bytes of a model; its version is raised with any change of layout or meaning.
const MAGIC: &[u8; 16] = b"MAILLE-MOTION/1\n";
const ALIGN: usize = 64;

/// Geometry and places are text, so that every bit of an `f64` comes back.
#[derive(Serialize, Deserialize)]
struct Description {
    size: [usize; 3],
    /// spacing, origin, direction
    geometry: Vec<String>,
    kind: String,
    places: Vec<String>,
    fields: Vec<Measures>,
}

fn text(numbers: impl IntoIterator<Item = f64>) -> Vec<String> {
    numbers.into_iter().map(|v| format!("{v:?}")).collect()
}

fn numbers(text: &[String]) -> Result<Vec<f64>, MotionError> {
    text.iter().map(|v| v.parse()).collect::<Result<_, _>>().map_err(|_| MotionError::Bytes("a number of the description is none".into()))
}

/// A kind as its name and numbers: key frames first, ends last.
fn kind_text(kind: &Kind) -> (&'static str, Vec<String>) {
    match kind {
        Kind::FullCycle { tau, ei, ee } => ("full-cycle", text(tau.iter().copied().chain([*ei, *ee]))),
        Kind::HalfCycle { tau } => ("half-cycle", text(tau.iter().copied())),
        Kind::Surrogate { ends, .. } => ("surrogate", text(*ends)),
    }
}

fn kind_of(name: &str, places: &[f64], fields: usize) -> Option<Kind> {
    match (name, places) {
        ("full-cycle", [tau @ .., ei, ee]) => Some(Kind::FullCycle { tau: tau.to_vec(), ei: *ei, ee: *ee }),
        ("half-cycle", tau) => Some(Kind::HalfCycle { tau: tau.to_vec() }),
        ("surrogate", [out, full]) => Some(Kind::Surrogate { signals: fields.checked_sub(1)?, ends: [*out, *full] }),
        _ => None,
    }
}

fn up(n: usize) -> usize {
    n.next_multiple_of(ALIGN)
}

impl MotionModel<'_> {
    /// The model as bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        let grid = &self.grid;
        let (kind, places) = kind_text(&self.kind);
        let description = Description {
            size: grid.size,
            geometry: text(grid.spacing.into_iter().chain(grid.origin).chain(grid.direction)),
            kind: kind.into(),
            places,
            fields: self.fields.iter().map(|f| f.measures).collect(),
        };
        let described = serde_json::to_vec(&description).expect("numbers and lists become JSON");
        let mut bytes = Vec::with_capacity(up(24 + described.len()) + self.fields.iter().map(|f| up(f.size_bytes())).sum::<usize>());
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&(described.len() as u64).to_le_bytes());
        bytes.extend_from_slice(&described);
        for field in &self.fields {
            bytes.resize(up(bytes.len()), 0);
            bytes.extend_from_slice(field.bytes());
        }
        bytes
    }
}

impl<'a> MotionModel<'a> {
    /// The model in these bytes, in place where their alignment allows it.
    ///
    /// # Errors
    /// [`MotionError::Bytes`] when they are cut off, damaged or of another version.
    pub fn view(bytes: &'a [u8]) -> Result<Self, MotionError> {
        let fail = |fault: &str| MotionError::Bytes(fault.into());
        if cfg!(target_endian = "big") {
            return Err(fail("nodes are little endian, this machine is not"));
        }
        let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| fail("another magic number or version"))?;
        let length = rest.get(..8).and_then(|l| l.try_into().ok()).map(u64::from_le_bytes).ok_or_else(|| fail("cut off"))?;
        let described = usize::try_from(length).ok().and_then(|l| rest.get(8..8usize.checked_add(l)?)).ok_or_else(|| fail("cut off"))?;
        let description: Description = serde_json::from_slice(described).map_err(|fault| MotionError::Bytes(fault.to_string()))?;
        let Description { size, geometry, kind, places, fields } = description;
        let geometry: [f64; 15] = numbers(&geometry)?.try_into().map_err(|_| fail("its geometry is not fifteen numbers"))?;
        let grid = Grid {
            size,
            spacing: std::array::from_fn(|c| geometry[c]),
            origin: std::array::from_fn(|c| geometry[3 + c]),
            direction: std::array::from_fn(|c| geometry[6 + c]),
        };
        if let Some(fault) = grid.fault() {
            return Err(MotionError::Bytes(fault));
        }
        let kind = kind_of(&kind, &numbers(&places)?, fields.len()).ok_or_else(|| fail("no kind of model that is known"))?.check()?;
        if size.iter().any(|&s| s < 2) || fields.len() != kind.field_count() {
            return Err(fail("fields and description disagree"));
        }
        let (mut at, mut packed) = (24 + described.len(), Vec::with_capacity(fields.len()));
        for measures in fields {
            if ![measures.scale, measures.error_mm, measures.longest_mm, measures.contraction].iter().all(|m| m.is_finite() && *m >= 0.0) {
                return Err(fail("a field's measures are not finite"));
            }
            at = up(at);
            let end = at.checked_add(grid.voxel_count() * measures.precision.node_bytes()).ok_or_else(|| fail("cut off"))?;
            let nodes = bytes.get(at..end).ok_or_else(|| fail("cut off"))?;
            at = end;
            packed.push(PackedField {
                nodes: match measures.precision {
                    Precision::F32 => Nodes::F32(in_place(nodes)),
                    Precision::F16 => Nodes::F16(in_place(nodes)),
                    Precision::I16 => Nodes::I16(in_place(nodes)),
                },
                measures,
            });
        }
        Ok(Self::new(grid, kind, packed))
    }

    /// Whether the nodes lie in somebody else's bytes.
    pub fn is_in_place(&self) -> bool {
        self.fields.iter().all(|f| match &f.nodes {
            Nodes::F32(v) => matches!(v, Cow::Borrowed(_)),
            Nodes::F16(v) => matches!(v, Cow::Borrowed(_)),
            Nodes::I16(v) => matches!(v, Cow::Borrowed(_)),
        })
    }
}

fn in_place<T: Pod>(bytes: &[u8]) -> Cow<'_, [T]> {
    bytemuck::try_cast_slice(bytes)
        .map_or_else(|_| Cow::Owned(bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()), Cow::Borrowed)
}
