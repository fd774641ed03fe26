//! Why a run could not start or go on: one sentence each, with what to do.

use maille_scene::SceneError;
use maille_store::StoreError;
use maille_transport::TransportError;
use maille_volume::io::ReadError;
use std::{io, path::PathBuf};

/// Why a run could not start or go on.
#[derive(Debug, thiserror::Error)]
pub enum SupervisorError {
    /// a fault in the scene, with its line
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// the patient cannot breathe as the scene asks
    #[error(transparent)]
    Breathing(#[from] maille_breathing::BreathingError),
    /// the volume cannot be read
    #[error(transparent)]
    Volume(#[from] ReadError),
    /// shared memory has no room
    #[error(
        "this scene needs {need_mib} MiB in /dev/shm and {free_mib} MiB are free; enlarge it (`sudo mount -o remount,size={size_mib}M /dev/shm`, \
         in a container `--shm-size={size_mib}m`), give back what dead runs left (`maille clean`), or take a smaller volume"
    )]
    Space {
        /// what the run needs [MiB]
        need_mib: u64,
        /// what is free [MiB]
        free_mib: u64,
        /// size of the file system that would do [MiB]
        size_mib: u64,
    },
    /// iceoryx2 or a segment failed
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// the brick store failed
    #[error(transparent)]
    Store(#[from] StoreError),
    /// a system call or file failed
    #[error("{what}: {source}")]
    Io {
        /// what was tried
        what: String,
        /// why it failed
        source: io::Error,
    },
    /// the report cannot be written
    #[error("the report {} cannot be written: {source}", path.display())]
    Report {
        /// where it should go
        path: PathBuf,
        /// why it cannot
        source: io::Error,
    },
    /// a service died again and again
    #[error("{0}")]
    Unstable(String),
    /// a service may not start here
    #[error("{0}")]
    Refused(String),
}

impl SupervisorError {
    /// For `map_err`: a failed call and what it was for.
    pub(crate) fn io<E: Into<io::Error>>(what: impl Into<String>) -> impl FnOnce(E) -> Self {
        let what = what.into();
        move |source| Self::Io { what, source: source.into() }
    }
}
