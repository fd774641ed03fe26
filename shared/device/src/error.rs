//! Why a device cannot be used, each as one sentence that says what to do.

use thiserror::Error;

/// See the module.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum DeviceError {
    #[error("{library} was not found ({reason}); install {package}, or give the path of the library")]
    LibraryMissing { library: &'static str, package: &'static str, reason: String },
    #[error("{path} cannot be opened as a library ({reason}); give the path of {library}, which comes with {package}")]
    LibraryUnusable { path: String, library: &'static str, package: &'static str, reason: String },
    #[error("{library} has no function {function}: it is too old or another library")]
    FunctionMissing { library: String, function: &'static str },
    #[error("{device} is not there: {reason}")]
    NotThere { device: &'static str, reason: String },
    #[error("device.id = `{id}` is no device of libdhd, which numbers them; write \"0\" for the first, \"1\" for the second")]
    NoNumber { id: String },
    #[error("{device} stopped answering: {reason}")]
    Lost { device: &'static str, reason: String },
    #[error("the thread of the device could not start: {0}")]
    Thread(#[from] std::io::Error),
}
