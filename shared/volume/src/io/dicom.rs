//! DICOM.
use super::{
    ReadError, Reading,
    error::{Fault, Parsed},
};
use std::path::Path;

pub(crate) fn looks_like(head: &[u8]) -> bool {
    head.len() > 132 && &head[128..132] == b"DICM"
}
pub(crate) fn read_one(_path: &Path) -> Parsed<Reading> {
    Err(Fault::NotAVolume("DICOM reading comes".into()))
}
pub(crate) fn read_directory(path: &Path, _series: Option<&str>) -> Result<Reading, ReadError> {
    read_one(path).map_err(|f| f.at(path))
}
