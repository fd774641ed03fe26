//! Where the real CTs are, for tests that want them.
//!
//! The folder is `MAILLE_DATA`, or else `../shared/data` beside the repository. It is never part of the repository, so
//! a test that finds nothing there says so and returns; on CI (environment variable `CI` set) it panics instead, so that
//! a missing folder cannot turn the whole of the real-data tests into nothing.

use std::path::{Path, PathBuf};

/// The folder of real data, if there is one; does not complain when there is none.
pub fn data_dir() -> Option<PathBuf> {
    let dir = match std::env::var_os("MAILLE_DATA") {
        Some(dir) => PathBuf::from(dir),
        None => Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")).to_path_buf(),
    };
    dir.is_dir().then_some(dir)
}

/// A file or folder of the real data; `None`, with a loud line, when it is not there.
///
/// ```no_run
/// let Some(head) = maille_testkit::real_data("ct_head_invesalius/cranium_lps.nrrd") else { return };
/// ```
///
/// # Panics
/// When the data is missing and the environment variable `CI` is set: there the tests must run, not skip.
pub fn real_data(relative: &str) -> Option<PathBuf> {
    let path = data_dir().map(|dir| dir.join(relative)).filter(|path| path.exists());
    if path.is_none() {
        let sentence = format!("real data {relative:?} is not there; set MAILLE_DATA to the folder that holds it");
        assert!(std::env::var_os("CI").is_none(), "{sentence}, or unset CI to skip such tests");
        eprintln!("SKIPPED: {sentence}");
    }
    path
}
