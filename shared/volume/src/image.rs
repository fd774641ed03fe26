//! An image as a file holds it: any pixel type, any number of components, before it becomes a [`Volume`](crate::Volume).

use crate::{grid::Grid, volume::Rescale};

/// Pixels in the file's own type, components interleaved, i fastest.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)] // the names are the types
pub enum Pixels {
    U8(Vec<u8>),
    I8(Vec<i8>),
    U16(Vec<u16>),
    I16(Vec<i16>),
    U32(Vec<u32>),
    I32(Vec<i32>),
    U64(Vec<u64>),
    I64(Vec<i64>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

macro_rules! each {
    ($self:expr, $v:ident => $e:expr) => {
        match $self {
            Pixels::U8($v) => $e,
            Pixels::I8($v) => $e,
            Pixels::U16($v) => $e,
            Pixels::I16($v) => $e,
            Pixels::U32($v) => $e,
            Pixels::I32($v) => $e,
            Pixels::U64($v) => $e,
            Pixels::I64($v) => $e,
            Pixels::F32($v) => $e,
            Pixels::F64($v) => $e,
        }
    };
}

impl Pixels {
    /// Number of numbers (voxels × components × frames).
    pub fn len(&self) -> usize {
        each!(self, v => v.len())
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether the type is an integer type.
    pub fn is_integer(&self) -> bool {
        !matches!(self, Self::F32(_) | Self::F64(_))
    }

    /// Name of the type as `maille info` prints it: `int16`, `uint8`, `float32` …
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::U8(_) => "uint8",
            Self::I8(_) => "int8",
            Self::U16(_) => "uint16",
            Self::I16(_) => "int16",
            Self::U32(_) => "uint32",
            Self::I32(_) => "int32",
            Self::U64(_) => "uint64",
            Self::I64(_) => "int64",
            Self::F32(_) => "float32",
            Self::F64(_) => "float64",
        }
    }

    /// The numbers as `f64`, in order.
    pub fn iter_f64(&self) -> Box<dyn Iterator<Item = f64> + '_> {
        #[allow(clippy::unnecessary_cast)] // one arm of the macro is f64 already
        {
            each!(self, v => Box::new(v.iter().map(|&x| x as f64)))
        }
    }

    /// Smallest and largest finite number, `None` when there is none.
    pub fn finite_range(&self) -> Option<(f64, f64)> {
        self.iter_f64().filter(|v| v.is_finite()).fold(None, |r, v| match r {
            None => Some((v, v)),
            Some((a, b)) => Some((a.min(v), b.max(v))),
        })
    }
}

/// An image: grid, components, frames and pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// where the voxels are
    pub grid: Grid,
    /// numbers a voxel: 1 for a scalar, 3 for a displacement or RGB
    pub components: usize,
    /// number of volumes in the file (4-D files), frame slowest; 1 otherwise
    pub frames: usize,
    /// file number → value
    pub rescale: Rescale,
    /// `voxel_count · components · frames` numbers; component fastest, then i, j, k, frame
    pub pixels: Pixels,
}
