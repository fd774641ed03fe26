//! Before anything is read or computed: no file that is to be written may be one that is to be read, or be written twice.
//!
//! Files are compared as the system sees them: by device and inode where they exist, so that links, `..` and other names of one file do not hide it, and
//! else by their folder's inode and their name. What is read with a file counts as read: the voxels beside a header (`.mhd`, `.nhdr`, `.hdr`), and in a
//! folder, which is a DICOM series, every file in it. What is written with a file counts as written: the voxels beside a `.mhd`.
//!
//! A new file is tried out under a temporary name, so that a place that cannot be written is told before anybody waits for what should go there.
//! Not here: two runs at one time, and file systems that do not tell large letters from small ones.

use std::{
    ffi::OsString,
    fs, io,
    io::Read as _,
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
};

/// Why outputs were refused: one sentence each.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// an output is an input
    #[error("{} is {what}; name another file to write", output.display())]
    Input {
        /// what should be written
        output: PathBuf,
        /// what it is to the command
        what: String,
    },
    /// two outputs are one file
    #[error("{} is to be written twice: give each output a file of its own", output.display())]
    Twice {
        /// which
        output: PathBuf,
    },
    /// it cannot be written at all
    #[error("{} cannot be written: {source}", output.display())]
    Unwritable {
        /// which
        output: PathBuf,
        /// why
        source: io::Error,
    },
}

/// Refuses outputs that would take an input's place, or each other's, or that cannot be written. Inputs that are not there are left to their reader.
///
/// # Errors
/// One sentence with the first such output.
pub fn check_outputs<'i, 'o>(
    inputs: impl IntoIterator<Item = &'i Path>,
    outputs: impl IntoIterator<Item = &'o Path>,
) -> Result<(), OutputError> {
    let inputs: Vec<(&Path, Vec<Told>)> = inputs.into_iter().map(|path| (path, read_with(path))).collect();
    let mut written: Vec<File> = Vec::new();
    for output in outputs {
        for file in written_with(output) {
            let Some(found) = File::of(&file) else {
                // its folder is not there, or it has no name: what the system says of it
                let source = fs::metadata(folder_of(&file)).err().unwrap_or_else(|| io::ErrorKind::NotADirectory.into());
                return Err(OutputError::Unwritable { output: file, source });
            };
            for (input, told) in &inputs {
                if let Some(told) = told.iter().find(|t| t.is(&found, &file)) {
                    let what = match told {
                        Told::Itself(_) => "a file that is to be read".to_owned(),
                        Told::With(_) | Told::Within(_) => format!("a file that is to be read with {}", input.display()),
                    };
                    return Err(OutputError::Input { output: file, what });
                }
            }
            // a pipe or a device may take both
            let special = fs::metadata(&file).is_ok_and(|there| !there.is_file());
            if written.contains(&found) && !special {
                return Err(OutputError::Twice { output: file });
            }
            written.push(found);
            try_out(&file).map_err(|source| OutputError::Unwritable { output: file, source })?;
        }
    }
    Ok(())
}

/// A file as the system tells it from others.
#[derive(Debug, PartialEq)]
enum File {
    /// device and inode
    There(u64, u64),
    /// device and inode of the folder, and the name
    New(u64, u64, OsString),
}

impl File {
    fn of(path: &Path) -> Option<Self> {
        if let Ok(there) = fs::metadata(path) {
            return Some(Self::There(there.dev(), there.ino()));
        }
        let folder = fs::metadata(folder_of(path)).ok().filter(fs::Metadata::is_dir)?;
        Some(Self::New(folder.dev(), folder.ino(), path.file_name()?.to_owned()))
    }
}

/// A file that is read.
enum Told {
    Itself(File),
    With(File),
    /// whatever lies in this folder
    Within(File),
}

impl Told {
    fn is(&self, found: &File, path: &Path) -> bool {
        match self {
            Self::Itself(file) | Self::With(file) => file == found,
            // a new name takes nothing's place
            Self::Within(folder) => matches!(found, File::There(..)) && File::of(folder_of(path)).as_ref() == Some(folder),
        }
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// All that is read when a path is.
fn read_with(path: &Path) -> Vec<Told> {
    let Ok(metadata) = fs::metadata(path) else { return Vec::new() };
    let Some(file) = File::of(path) else { return Vec::new() };
    if metadata.is_dir() {
        return vec![Told::Within(file)];
    }
    let mut all = vec![Told::Itself(file)];
    let beside = ["hdr", "img", "img.gz"].map(|ending| path.with_extension(ending));
    if path.extension().is_some_and(|e| e == "hdr" || e == "img") {
        all.extend(beside.iter().filter_map(|file| File::of(file)).map(Told::With));
    }
    let mut head = Vec::new();
    let head_read = fs::File::open(path).and_then(|file| file.take(1 << 16).read_to_end(&mut head));
    if head_read.is_err() {
        return all;
    }
    let text = String::from_utf8_lossy(&head);
    let mut lines = text.lines();
    let named = lines.by_ref().find_map(|line| {
        let (key, value) = line.split_once(['=', ':'])?;
        let key = key.trim().to_ascii_lowercase();
        ["elementdatafile", "data file", "datafile"].contains(&key.as_str()).then(|| value.trim())
    });
    let folder = folder_of(path);
    match named {
        None => {}
        Some(value) if value.eq_ignore_ascii_case("local") => {}
        Some(value) if value.starts_with("LIST") => {
            all.extend(lines.filter_map(|name| File::of(&folder.join(name.trim()))).map(Told::With));
        }
        // a series by its pattern: any file beside it may be one of them
        Some(value) if value.contains('%') => all.extend(File::of(folder).map(Told::Within)),
        Some(value) => all.extend(File::of(&folder.join(value)).map(Told::With)),
    }
    all
}

/// All that is written when a path is.
fn written_with(path: &Path) -> Vec<PathBuf> {
    let mut all = vec![path.to_path_buf()];
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mhd")) {
        all.extend(["raw", "zraw"].map(|ending| path.with_extension(ending)));
    }
    all
}

/// Whether a file can come to be; a pipe or a device is as it is.
fn try_out(path: &Path) -> io::Result<()> {
    if let Ok(there) = fs::metadata(path) {
        return if there.is_dir() { Err(io::ErrorKind::IsADirectory.into()) } else { Ok(()) };
    }
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}", std::process::id()));
    let trial = path.with_file_name(name);
    fs::File::create(&trial)?;
    fs::remove_file(&trial)
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Scratch(PathBuf);
    impl Drop for Scratch {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    fn says(inputs: &[&Path], outputs: &[&Path]) -> String {
        check_outputs(inputs.iter().copied(), outputs.iter().copied()).map_or_else(|fault| fault.to_string(), |()| "fine".into())
    }

    #[test]
    fn an_input_is_an_input_under_every_name() {
        let scratch = Scratch(std::env::temp_dir().join(format!("maille_outputs_{}", std::process::id())));
        fs::create_dir_all(scratch.0.join("series")).unwrap();
        let at = |name: &str| scratch.0.join(name);
        fs::write(at("a.mha"), "ObjectType = Image\nElementDataFile = LOCAL\n").unwrap();
        fs::write(at("b.mhd"), "ObjectType = Image\nElementDataFile = voxels.raw\n").unwrap();
        fs::write(at("c.nhdr"), "NRRD0004\ndata file: LIST\none\ntwo\n").unwrap();
        for name in ["voxels.raw", "two", "pair.hdr", "pair.img", "series/1"] {
            fs::write(at(name), "1").unwrap();
        }
        fs::hard_link(at("a.mha"), at("hard.mha")).unwrap();
        std::os::unix::fs::symlink("a.mha", at("soft.mha")).unwrap();
        std::os::unix::fs::symlink("series", at("other")).unwrap();

        let read = "a file that is to be read";
        for name in ["a.mha", "series/../a.mha", "hard.mha", "soft.mha"] {
            let said = says(&[&at("b.mhd"), &at("a.mha")], &[&at("new.nrrd"), &at(name)]);
            assert!(said.contains(name) && said.contains(&format!("{read};")), "{name}: {said}");
        }
        for (input, output) in
            [("b.mhd", "voxels.raw"), ("c.nhdr", "two"), ("pair.hdr", "pair.img"), ("pair.img", "pair.hdr"), ("series", "other/1")]
        {
            let said = says(&[&at(input)], &[&at(output)]);
            assert!(said.contains(&format!("{read} with")) && said.contains(input), "{input}, {output}: {said}");
        }
        // a header that would be written with its voxels onto those of another
        assert!(says(&[&at("b.mhd")], &[&at("voxels.mhd")]).contains("voxels.raw is a file that is to be read with"));
        assert!(says(&[], &[&at("v.nrrd"), &at("other/../v.nrrd")]).contains("v.nrrd is to be written twice"));
        assert!(says(&[], &[&at("soft.mha"), &at("hard.mha")]).contains("hard.mha is to be written twice"));
        assert!(says(&[], &[&at("nowhere/v.nrrd")]).contains("nowhere/v.nrrd cannot be written: No such file"));
        assert!(says(&[], &[&at("series")]).contains("series cannot be written: is a directory"));
        assert!(says(&[], &[&at("a.mha/v.nrrd")]).contains("cannot be written"));
        // what takes nobody's place
        let inputs = [at("a.mha"), at("series"), at("not_there.mha")];
        assert_eq!(
            says(&inputs.each_ref().map(PathBuf::as_path), &[&at("series/2.nrrd"), &at("x.mhd"), &at("b.mhd"), Path::new("/dev/null")]),
            "fine"
        );
        assert_eq!(fs::read_dir(&scratch.0).unwrap().count(), 11, "nothing is left of what was tried");
    }
}
