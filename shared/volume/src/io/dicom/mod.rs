//! DICOM: one file, or a directory that holds a series.
//!
//! Frames are ordered by where they lie along the slice normal, n = row × column, never by name or instance number.
//! Spacing along n is the distance of neighbours; unlike thickness it cannot be wrong about the geometry.
//! [DICOM PS3.3, C.7.6.2]
//!
//! A tilted gantry or uneven spacing is resampled onto a rectangular grid, with a notice ([`stack`]). Missing slices,
//! several slices at one place, and planes that are not parallel are refused.
//!
//! Not here: writing; segmentations, structure sets and other objects without an image; palettes of colours; the
//! compressions that `dicom-pixeldata` does not decode without C libraries (JPEG-LS, JPEG 2000).

mod object;
mod pixels;
mod scan;
mod stack;

pub(crate) use object::looks_like;

use super::{
    Notice, ReadError, Reading,
    error::{Fault, Parsed},
};
use object::Object;
use std::{collections::BTreeMap, fs, path::Path};

/// Reads one file.
pub(crate) fn read_one(path: &Path) -> Parsed<Reading> {
    let (object, data_set) = Object::open(path)?;
    let mut first = Some(data_set);
    stack::assemble(vec![object], &mut |object| match first.take() {
        Some(data_set) => object.decode(&data_set.bytes),
        None => object.decode(&object::data_set(&object.path)?.bytes),
    })
}

/// Reads the one series in a directory, or the one asked for.
pub(crate) fn read_directory(path: &Path, wanted: Option<&str>) -> Result<Reading, ReadError> {
    let io = |source| ReadError::Io { path: path.to_path_buf(), source };
    let mut files = Vec::new();
    for entry in fs::read_dir(path).map_err(io)? {
        let file = entry.map_err(io)?.path();
        if file.is_file() {
            files.push(file);
        }
    }
    // The order in which a directory lists its files is no one's choice; messages should not depend on it.
    files.sort();
    let mut series: BTreeMap<String, Vec<Object>> = BTreeMap::new();
    let mut unreadable = Vec::new();
    for file in files {
        let mut head = Vec::new();
        let opened = fs::File::open(&file).and_then(|f| std::io::Read::read_to_end(&mut std::io::Read::take(f, 512), &mut head));
        if opened.is_err() || !looks_like(&head) {
            continue;
        }
        match Object::open(&file) {
            Ok((object, _)) => series.entry(object.series.clone()).or_default().push(object),
            Err(Fault::NotAVolume(_)) => {}
            Err(fault) => unreadable.push(fault.at(&file)),
        }
    }
    let chosen = match wanted {
        None if series.len() > 1 => {
            let describe = |(uid, objects): (&String, &Vec<Object>)| {
                let count: usize = objects.iter().map(|o| o.planes.len()).sum();
                let label = &objects[0].label;
                format!("{uid} ({label}{}{count} frames)", if label.is_empty() { "" } else { ", " })
            };
            return Err(ReadError::ManySeries { path: path.to_path_buf(), series: series.iter().map(describe).collect() });
        }
        None => series.pop_first(),
        Some(wanted) => {
            let mut matching: Vec<String> = series.keys().filter(|uid| uid.ends_with(wanted)).cloned().collect();
            if matching.iter().any(|uid| uid == wanted) {
                matching = vec![wanted.to_string()];
            }
            if matching.len() != 1 {
                let known: Vec<&str> = series.keys().map(String::as_str).collect();
                return Err(ReadError::Unsupported {
                    path: path.to_path_buf(),
                    fault: format!("{} of its series end in {wanted:?}", matching.len()),
                    advice: format!(
                        "choose one of {}",
                        if known.is_empty() { "none: no series is readable".into() } else { known.join(", ") }
                    ),
                });
            }
            series.remove_entry(&matching[0])
        }
    };
    let Some((_, objects)) = chosen else {
        return Err(unreadable.into_iter().next().unwrap_or_else(|| ReadError::NotAVolume {
            path: path.to_path_buf(),
            fault: "it is a directory without any DICOM image directly in it".into(),
        }));
    };
    // The fault of one slice names that slice.
    let mut decode = |object: &Object| {
        let decode = || object.decode(&object::data_set(&object.path)?.bytes);
        decode().map_err(|fault| Fault::Named(Box::new(fault.at(&object.path))))
    };
    let mut reading = stack::assemble(objects, &mut decode).map_err(|fault| fault.at(path))?;
    // a damaged file may be the slice that is missing at an end, where nothing else would tell
    if wanted.is_none()
        && let Some(at) = unreadable.iter().position(|e| matches!(e, ReadError::Damaged { .. }))
    {
        return Err(unreadable.swap_remove(at));
    }
    if !unreadable.is_empty() {
        reading.notices.push(Notice(format!(
            "{} other DICOM files in the directory are left out; the first: {}",
            unreadable.len(),
            unreadable[0]
        )));
    }
    Ok(reading)
}
