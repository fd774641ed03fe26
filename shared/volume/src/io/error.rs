//! Why a file was refused: one sentence that names the file, the fault, and what to do.

use std::{
    io,
    path::{Path, PathBuf},
};
use thiserror::Error;

/// Why a file could not be read as a volume.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ReadError {
    /// the operating system refused
    #[error("cannot read {}: {source}; check the path and its permissions", path.display())]
    Io {
        /// the file
        path: PathBuf,
        /// what the system said
        source: io::Error,
    },
    /// the content is none of the formats
    #[error("{} is not a volume maille reads: {fault}; give an NRRD, MetaImage, NIfTI or DICOM file, or a directory of DICOM slices", path.display())]
    NotAVolume {
        /// the file
        path: PathBuf,
        /// what it seems to be
        fault: String,
    },
    /// the content contradicts itself or its length
    #[error("{} is damaged: {fault}; fetch or export the file again", path.display())]
    Damaged {
        /// the file
        path: PathBuf,
        /// what contradicts what
        fault: String,
    },
    /// a valid file that asks for something this program does not do right
    #[error("{} cannot be read: {fault}; {advice}", path.display())]
    Unsupported {
        /// the file
        path: PathBuf,
        /// what it asks for
        fault: String,
        /// what to do instead
        advice: String,
    },
    /// several DICOM series lie in one directory
    #[error("{} holds {} DICOM series; choose one with --series: {}", path.display(), series.len(), series.join(", "))]
    ManySeries {
        /// the directory
        path: PathBuf,
        /// SeriesInstanceUID and what is known of it, one string a series
        series: Vec<String>,
    },
}

/// Why a volume could not be written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum WriteError {
    /// the operating system refused
    #[error("cannot write {}: {source}; check the directory, its permissions and the free space", path.display())]
    Io {
        /// the file
        path: PathBuf,
        /// what the system said
        source: io::Error,
    },
    /// the extension names no format
    #[error("cannot write {}: its extension names no format; end the name in .nrrd, .mha, .mhd, .nii or .nii.gz", path.display())]
    Extension {
        /// the file
        path: PathBuf,
    },
    /// the format cannot hold the image
    #[error("cannot write {}: {fault}; {advice}", path.display())]
    Unsupported {
        /// the file
        path: PathBuf,
        /// what does not fit
        fault: String,
        /// what to do instead
        advice: String,
    },
}

/// A fault found while parsing, before the file's name is put to it.
#[derive(Debug)]
pub(crate) enum Fault {
    Io(io::Error),
    Damaged(String),
    Unsupported(String, String),
    NotAVolume(String),
    /// a fault that already names a file (a data file beside the header)
    Named(Box<ReadError>),
}

/// Result of a parser.
pub(crate) type Parsed<T> = Result<T, Fault>;

impl Fault {
    pub(crate) fn damaged(fault: impl Into<String>) -> Self {
        Self::Damaged(fault.into())
    }

    pub(crate) fn unsupported(fault: impl Into<String>, advice: impl Into<String>) -> Self {
        Self::Unsupported(fault.into(), advice.into())
    }

    /// Puts the file's name to the fault.
    pub(crate) fn at(self, path: &Path) -> ReadError {
        let path = path.to_path_buf();
        match self {
            Self::Io(source) => ReadError::Io { path, source },
            Self::Damaged(fault) => ReadError::Damaged { path, fault },
            Self::Unsupported(fault, advice) => ReadError::Unsupported { path, fault, advice },
            Self::NotAVolume(fault) => ReadError::NotAVolume { path, fault },
            Self::Named(error) => *error,
        }
    }
}

impl From<io::Error> for Fault {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}
