//! NRRD ("nearly raw raster data"), attached (`.nrrd`) and detached (`.nhdr`).
//!
//! Axes are sorted into at most one of components, three of space, and one of frames, by `space directions` where a
//! space is given and by `kinds` otherwise; `space` is converted to LPS. [teem, definition of NRRD format]
//!
//! `line skip` acts before decompression, `byte skip` after it; −1 takes the last bytes. Bytes left over after the
//! voxels are a fault: they show that header and data do not belong together.
//!
//! Not here: `block` voxels, the `zrl` encoding, measurement frames (vectors are taken as LPS, as ITK does).

use super::{
    Notice, Reading,
    error::{Fault, Parsed},
    geometry::{complete_steps, grid_from_steps},
    payload::{self, Kind, Packing},
};
use crate::{Image, Pixels, Rescale};
use std::{
    collections::HashMap,
    fs::File,
    io::{self, BufRead, BufReader, Read, Seek, Write},
    path::{Path, PathBuf},
};

/// No header line or list is longer than this many bytes in all.
const HEADER_LIMIT: u64 = 1 << 20;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Encoding {
    Packed(Packing),
    Text,
    Hex,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Role {
    Space,
    Components,
    Frames,
}

/// Reads a file that begins with `NRRD`.
pub(crate) fn read(path: &Path) -> Parsed<Reading> {
    let mut reader = BufReader::new(File::open(path)?);
    let (fields, list) = read_header(&mut reader)?;
    let mut notices = Vec::new();
    let need = |name: &str| fields.get(name).map(String::as_str).ok_or_else(|| Fault::damaged(format!("its header has no `{name}`")));

    let kind = parse_type(need("type")?)?;
    let sizes = sizes(need("dimension")?, need("sizes")?)?;
    let encoding = parse_encoding(need("encoding")?)?;
    let big_endian = match (fields.get("endian").map(|e| e.to_ascii_lowercase()), kind.size_bytes(), encoding) {
        (Some(e), ..) if e == "little" => false,
        (Some(e), ..) if e == "big" => true,
        (Some(e), ..) => return Err(Fault::damaged(format!("its `endian` is {e:?}, neither little nor big"))),
        (None, 1, _) | (None, _, Encoding::Text) => false,
        (None, ..) => return Err(Fault::damaged("its header has no `endian`, and its voxels have several bytes")),
    };
    let expected = payload::expected_bytes(&sizes, kind)?;

    // Geometry before data: a header that makes no sense should not cost the time to decompress.
    let axes = Axes::parse(&fields, &sizes, &mut notices)?;
    let line_skip = skip_field(&fields, &["line skip", "lineskip"], 0)?;
    let byte_skip = skip_field(&fields, &["byte skip", "byteskip"], -1)?;

    let pixels = match fields.get("data file").or_else(|| fields.get("datafile")) {
        None => read_data(&mut reader, encoding, line_skip, byte_skip, expected, kind, big_endian)?,
        Some(value) => {
            let files = data_files(path, value, &list)?;
            let count = files.len();
            if !expected.is_multiple_of(count * kind.size_bytes()) {
                return Err(Fault::damaged(format!("its {count} data files do not divide its voxels evenly")));
            }
            let mut all: Option<Pixels> = None;
            for file in files {
                let part = read_data_file(&file, encoding, line_skip, byte_skip, expected / count, kind, big_endian)?;
                match &mut all {
                    None => all = Some(part),
                    Some(all) => append(all, part),
                }
            }
            all.ok_or_else(|| Fault::damaged("its list of data files is empty"))?
        }
    };
    let image = axes.assemble(pixels, &sizes)?;
    Ok(Reading { image, notices, stored_type: None })
}

fn read_data_file(
    file: &Path,
    encoding: Encoding,
    line_skip: i64,
    byte_skip: i64,
    expected: usize,
    kind: Kind,
    big_endian: bool,
) -> Parsed<Pixels> {
    let open = || -> Parsed<Pixels> {
        let mut reader = BufReader::new(File::open(file)?);
        read_data(&mut reader, encoding, line_skip, byte_skip, expected, kind, big_endian)
    };
    open().map_err(|fault| Fault::Named(Box::new(fault.at(file))))
}

fn read_data<R: BufRead + Seek>(
    reader: &mut R,
    encoding: Encoding,
    line_skip: i64,
    byte_skip: i64,
    expected: usize,
    kind: Kind,
    big_endian: bool,
) -> Parsed<Pixels> {
    for _ in 0..line_skip {
        if reader.skip_until(b'\n')? == 0 {
            return Err(Fault::damaged(format!("it has fewer than the {line_skip} lines its `line skip` passes over")));
        }
    }
    let count = expected / kind.size_bytes();
    let text_bytes = |reader: &mut R, most: usize| -> Parsed<Vec<u8>> {
        payload::skip(reader, byte_skip.max(0) as u64)?;
        let mut text = Vec::new();
        reader.by_ref().take(most as u64).read_to_end(&mut text)?;
        Ok(text)
    };
    match encoding {
        // No number needs more than 64 characters with its separator.
        Encoding::Text => payload::parse_text(&text_bytes(reader, count.saturating_mul(64).saturating_add(4096))?, kind, count),
        Encoding::Hex => {
            let text = text_bytes(reader, expected.saturating_mul(3).saturating_add(4096))?;
            let mut digits = text.iter().filter(|b| !b.is_ascii_whitespace()).map(|b| (*b as char).to_digit(16));
            let mut bytes = Vec::new();
            while let Some(high) = digits.next() {
                match (high, digits.next().flatten()) {
                    (Some(high), Some(low)) => bytes.push((high * 16 + low) as u8),
                    _ => return Err(Fault::damaged("its hexadecimal data hold something else, or an odd number of digits")),
                }
            }
            if bytes.len() != expected {
                return Err(Fault::damaged(format!("its header calls for {expected} bytes of voxels, {} are there", bytes.len())));
            }
            Ok(payload::decode(bytes, kind, big_endian))
        }
        Encoding::Packed(packing) => {
            let mut stream = payload::unpack(reader, packing);
            let bytes = if byte_skip == -1 {
                payload::take_last(&mut *stream, expected)?
            } else {
                payload::skip(&mut *stream, byte_skip as u64)?;
                payload::take_exactly(&mut *stream, expected, true)?
            };
            Ok(payload::decode(bytes, kind, big_endian))
        }
    }
}

fn append(all: &mut Pixels, part: Pixels) {
    macro_rules! same {
        ($($v:ident),*) => {
            match (all, part) {
                $((Pixels::$v(a), Pixels::$v(b)) => a.extend(b),)*
                _ => unreachable!("parts are decoded with one type"),
            }
        };
    }
    same!(U8, I8, U16, I16, U32, I32, U64, I64, F32, F64);
}

/// Fields by lower-case name, and the lines of a `LIST`.
fn read_header(reader: &mut impl BufRead) -> Parsed<(HashMap<String, String>, Vec<String>)> {
    let mut fields = HashMap::new();
    let mut list = Vec::new();
    let mut limited = reader.take(HEADER_LIMIT);
    let mut first = true;
    let mut in_list = false;
    loop {
        let mut line = Vec::new();
        if limited.read_until(b'\n', &mut line)? == 0 {
            if limited.limit() == 0 {
                return Err(Fault::damaged("its header has no end within the first MiB"));
            }
            break;
        }
        let line = String::from_utf8_lossy(&line);
        let line = line.trim_end_matches(['\n', '\r']);
        if first {
            if !line.starts_with("NRRD000") {
                return Err(Fault::damaged(format!(
                    "its first line {:?} is not that of an NRRD file",
                    line.chars().take(24).collect::<String>()
                )));
            }
            first = false;
            continue;
        }
        if in_list {
            if !line.is_empty() {
                list.push(line.to_string());
            }
            continue;
        }
        if line.is_empty() {
            break;
        }
        if line.starts_with('#') {
            continue;
        }
        // `key:=value` is free text of the writer and means nothing here, even where the key is the name of a field.
        let Some((name, value)) = line.split_once(':') else {
            return Err(Fault::damaged(format!(
                "its header line {:?} is neither a field nor a comment",
                line.chars().take(60).collect::<String>()
            )));
        };
        if value.starts_with('=') {
            continue;
        }
        let (name, value) = (name.trim().to_ascii_lowercase(), value.trim().to_string());
        in_list = matches!(name.as_str(), "data file" | "datafile") && value.starts_with("LIST");
        if fields.insert(name.clone(), value).is_some() {
            return Err(Fault::damaged(format!("its header states `{name}` twice")));
        }
    }
    Ok((fields, list))
}

fn parse_type(name: &str) -> Parsed<Kind> {
    Ok(match name.to_ascii_lowercase().as_str() {
        "signed char" | "int8" | "int8_t" => Kind::I8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => Kind::U8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => Kind::I16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => Kind::U16,
        "int" | "signed int" | "int32" | "int32_t" => Kind::I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => Kind::U32,
        "longlong" | "long long" | "long long int" | "signed long long" | "signed long long int" | "int64" | "int64_t" => Kind::I64,
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => Kind::U64,
        "float" => Kind::F32,
        "double" => Kind::F64,
        "block" => return Err(Fault::unsupported("its voxels are opaque blocks", "store it with a numeric type")),
        other => return Err(Fault::damaged(format!("its `type` {other:?} is none of the format's"))),
    })
}

fn parse_encoding(name: &str) -> Parsed<Encoding> {
    Ok(match name.to_ascii_lowercase().as_str() {
        "raw" => Encoding::Packed(Packing::Raw),
        "gz" | "gzip" => Encoding::Packed(Packing::Gzip),
        "bz2" | "bzip2" => Encoding::Packed(Packing::Bzip2),
        "txt" | "text" | "ascii" => Encoding::Text,
        "hex" => Encoding::Hex,
        other => {
            return Err(Fault::unsupported(format!("its encoding {other:?} is not known"), "store it as raw, gzip, bzip2, ascii or hex"));
        }
    })
}

fn sizes(dimension: &str, sizes: &str) -> Parsed<Vec<usize>> {
    let dimension: usize = dimension.parse().map_err(|_| Fault::damaged(format!("its `dimension` {dimension:?} is no number")))?;
    let sizes: Option<Vec<usize>> = sizes.split_whitespace().map(|s| s.parse().ok()).collect();
    match sizes {
        Some(s) if s.len() == dimension && (1..=16).contains(&dimension) => Ok(s),
        _ => Err(Fault::damaged(format!("its `sizes` are not {dimension} whole numbers"))),
    }
}

fn skip_field(fields: &HashMap<String, String>, names: &[&str], least: i64) -> Parsed<i64> {
    match names.iter().find_map(|n| fields.get(*n)) {
        None => Ok(0),
        Some(v) => v
            .parse()
            .ok()
            .filter(|&n: &i64| n >= least)
            .ok_or_else(|| Fault::damaged(format!("its `{}` of {v:?} means nothing; it must be at least {least}", names[0]))),
    }
}

/// The data files a detached header names.
fn data_files(header: &Path, value: &str, list: &[String]) -> Parsed<Vec<PathBuf>> {
    let folder = header.parent().unwrap_or(Path::new("."));
    if value.starts_with("LIST") {
        return Ok(list.iter().map(|name| folder.join(name.trim())).collect());
    }
    let words: Vec<&str> = value.split_whitespace().collect();
    if let [pattern, first, last, step, ..] = words[..]
        && pattern.contains('%')
    {
        let numbers: Option<Vec<i64>> = [first, last, step].iter().map(|w| w.parse().ok()).collect();
        let Some([first, last, step]) = numbers.and_then(|n| <[i64; 3]>::try_from(n).ok()) else {
            return Err(Fault::damaged(format!("its `data file` {value:?} is no pattern with three numbers")));
        };
        let count = if step == 0 { 0 } else { (i128::from(last) - i128::from(first)) / i128::from(step) + 1 };
        if !(1..=100_000).contains(&count) {
            return Err(Fault::damaged(format!("its `data file` {value:?} names no series of files")));
        }
        return (0..count as i64).map(|n| numbered(pattern, first + n * step).map(|name| folder.join(name))).collect();
    }
    Ok(vec![folder.join(value)])
}

/// Puts a number into a C pattern: `%d`, `%3d` or `%03d`.
pub(crate) fn numbered(pattern: &str, number: i64) -> Parsed<String> {
    let bad = || Fault::damaged(format!("its file name pattern {pattern:?} is not of the form name%03d.raw"));
    let (before, rest) = pattern.split_once('%').ok_or_else(bad)?;
    let end = rest.find('d').ok_or_else(bad)?;
    let (format, after) = (&rest[..end], &rest[end + 1..]);
    let width: usize = if format.is_empty() { 0 } else { format.parse().map_err(|_| bad())? };
    if width > 20 || after.contains('%') {
        return Err(bad());
    }
    Ok(if format.starts_with('0') { format!("{before}{number:0width$}{after}") } else { format!("{before}{number:width$}{after}") })
}

/// What each axis is, and the grid.
struct Axes {
    roles: Vec<Role>,
    /// one step an axis of space [mm, LPS]
    steps: Vec<[f64; 3]>,
    origin: [f64; 3],
}

impl Axes {
    fn parse(fields: &HashMap<String, String>, sizes: &[usize], notices: &mut Vec<Notice>) -> Parsed<Self> {
        let n = sizes.len();
        let kinds: Vec<String> = match fields.get("kinds") {
            None => vec![String::new(); n],
            Some(k) => k.split_whitespace().map(str::to_ascii_lowercase).collect(),
        };
        if kinds.len() != n {
            return Err(Fault::damaged(format!("it has {n} axes and {} `kinds`", kinds.len())));
        }
        let space = fields.get("space").map(|s| s.to_ascii_lowercase());
        let flips = match &space {
            Some(name) => space_signs(name, notices)?,
            None => [1.0; 3],
        };
        let unit_mm = space_unit(fields, notices);
        let directions = match fields.get("space directions") {
            Some(text) => Some(
                vectors(text)
                    .filter(|v| v.len() == n)
                    .ok_or_else(|| Fault::damaged(format!("its `space directions` are not {n} vectors or `none`")))?,
            ),
            None => None,
        };

        let mut roles = roles(&kinds, directions.as_deref());
        // More than three axes of space: the last is a series of volumes.
        if roles.iter().filter(|r| **r == Role::Space).count() == 4 {
            let last = roles.iter().rposition(|r| *r == Role::Space).expect("there are four");
            roles[last] = Role::Frames;
        }
        for (role, most, what) in [(Role::Space, 3, "space"), (Role::Components, 1, "components"), (Role::Frames, 1, "frames")] {
            let count = roles.iter().filter(|r| **r == role).count();
            if count > most {
                return Err(Fault::unsupported(format!("{count} of its axes are {what}; {most} can be read"), "store it with fewer axes"));
            }
        }

        let space_axes: Vec<usize> = (0..n).filter(|&a| roles[a] == Role::Space).collect();
        let mut steps = Vec::new();
        let mut origin = [0.0; 3];
        if let Some(directions) = directions {
            for &axis in &space_axes {
                let v = directions[axis].as_ref().expect("an axis of space has a direction");
                if v.len() > 4 || v.iter().any(|x| !x.is_finite()) {
                    return Err(Fault::damaged(format!("the space direction {v:?} of axis {axis} is not a vector in space")));
                }
                steps.push(std::array::from_fn(|c| v.get(c).map_or(0.0, |x| x * flips[c] * unit_mm)));
            }
            if let Some(text) = fields.get("space origin") {
                let v = vectors(text).and_then(|v| v.into_iter().next().flatten()).filter(|v| v.iter().all(|x| x.is_finite()));
                let v = v.ok_or_else(|| Fault::damaged(format!("its `space origin` {text:?} is not a vector")))?;
                origin = std::array::from_fn(|c| v.get(c).map_or(0.0, |x| x * flips[c] * unit_mm));
            }
            let vectors_in_ras = roles.contains(&Role::Components) && flips != [1.0; 3];
            if vectors_in_ras && kinds.iter().any(|k| k.contains("vector")) {
                notices.push(Notice("its vectors are taken as LPS though its space is not, as ITK does".into()));
            }
        } else {
            let spacings = numbers(fields, "spacings", n)?;
            let minima = numbers(fields, "axis mins", n)?.or(numbers(fields, "axismins", n)?);
            let maxima = numbers(fields, "axis maxs", n)?.or(numbers(fields, "axismaxs", n)?);
            let node: Vec<bool> = fields
                .get("centers")
                .or_else(|| fields.get("centerings"))
                .map(|c| c.split_whitespace().map(|w| w.eq_ignore_ascii_case("node")).collect())
                .unwrap_or_default();
            for (c, &axis) in space_axes.iter().enumerate() {
                let given = spacings.as_ref().map(|s| s[axis]).filter(|s| s.is_finite());
                let range = minima.as_ref().zip(maxima.as_ref()).map(|(a, b)| (a[axis], b[axis])).filter(|(a, b)| (b - a).is_finite());
                let is_node = node.get(axis).copied().unwrap_or(false);
                let between = if is_node { sizes[axis].saturating_sub(1).max(1) } else { sizes[axis] };
                let spacing = given.or(range.map(|(a, b)| (b - a) / between as f64)).unwrap_or(1.0);
                let mut step = [0.0; 3];
                step[c] = spacing * flips[c] * unit_mm;
                steps.push(step);
                if let Some((min, _)) = range {
                    origin[c] = (if is_node { min } else { min + spacing / 2.0 }) * flips[c] * unit_mm;
                }
            }
            if given_space_without_directions(&space) {
                notices.push(Notice("its header names a space but no directions; its axes are taken along the space's own".into()));
            }
        }
        Ok(Self { roles, steps, origin })
    }

    fn assemble(self, pixels: Pixels, sizes: &[usize]) -> Parsed<Image> {
        let roles = &self.roles;
        let axis_of = |role: Role| (0..sizes.len()).filter(move |&a| roles[a] == role);
        let order: Vec<usize> = axis_of(Role::Components).chain(axis_of(Role::Space)).chain(axis_of(Role::Frames)).collect();
        let space: Vec<usize> = axis_of(Role::Space).map(|a| sizes[a]).collect();
        let size = std::array::from_fn(|c| space.get(c).copied().unwrap_or(1));
        let grid = grid_from_steps(size, complete_steps(&self.steps)?, self.origin)?;
        let components = axis_of(Role::Components).map(|a| sizes[a]).next().unwrap_or(1);
        let frames = axis_of(Role::Frames).map(|a| sizes[a]).next().unwrap_or(1);
        Ok(Image { grid, components, frames, rescale: Rescale::IDENTITY, pixels: payload::permute(pixels, sizes, &order) })
    }
}

fn given_space_without_directions(space: &Option<String>) -> bool {
    space.as_ref().is_some_and(|s| !s.starts_with("3d-"))
}

/// Signs that take the space's axes to LPS.
fn space_signs(name: &str, notices: &mut Vec<Notice>) -> Parsed<[f64; 3]> {
    let base = name.trim_end_matches("-time");
    Ok(match base {
        "left-posterior-superior" | "lps" | "lpst" => [1.0, 1.0, 1.0],
        "right-anterior-superior" | "ras" | "rast" => [-1.0, -1.0, 1.0],
        "left-anterior-superior" | "las" | "last" => [1.0, -1.0, 1.0],
        "scanner-xyz" | "3d-right-handed" | "3d-left-handed" => {
            notices.push(Notice(format!("its space {name:?} is not tied to the patient; its axes are taken as LPS")));
            [1.0; 3]
        }
        _ => return Err(Fault::unsupported(format!("its space {name:?} is not known"), "store it in left-posterior-superior")),
    })
}

/// Millimetres a unit of space.
fn space_unit(fields: &HashMap<String, String>, notices: &mut Vec<Notice>) -> f64 {
    let text = match fields.get("space units").or_else(|| fields.get("units")) {
        None => return 1.0,
        Some(text) => text.to_ascii_lowercase(),
    };
    let mut units: Vec<&str> = text.split(['"', ' ', '\t']).filter(|u| !u.is_empty()).take(3).collect();
    units.dedup();
    match units[..] {
        ["mm" | "millimeter" | "millimeters"] => 1.0,
        ["cm"] => 10.0,
        ["m"] => 1000.0,
        ["um" | "µm" | "micron" | "microns"] => 1e-3,
        _ => {
            notices.push(Notice(format!("its units of space {text} are taken as millimetres")));
            1.0
        }
    }
}

/// Sorts axes by direction where there is one, by kind otherwise.
fn roles(kinds: &[String], directions: Option<&[Option<Vec<f64>>]>) -> Vec<Role> {
    let is_space = |axis: usize| match directions {
        Some(d) => match &d[axis] {
            None => false,
            // (0, 0, 0, t) is an axis of time in a space with time.
            Some(v) => v.iter().take(3).any(|x| *x != 0.0) || v.len() <= 3,
        },
        None => matches!(kinds[axis].as_str(), "" | "domain" | "space" | "???" | "none"),
    };
    let last_space = (0..kinds.len()).rev().find(|&a| is_space(a));
    (0..kinds.len())
        .map(|axis| match kinds[axis].as_str() {
            _ if is_space(axis) => Role::Space,
            "time" => Role::Frames,
            "list" | "" | "???" | "none" | "domain" | "space" if last_space.is_some_and(|l| axis > l) => Role::Frames,
            _ => Role::Components,
        })
        .collect()
}

/// `(1,0,0) none (0,1,0)` → vectors; `None` when it is not that.
fn vectors(text: &str) -> Option<Vec<Option<Vec<f64>>>> {
    let mut found = Vec::new();
    let mut rest = text.trim();
    while !rest.is_empty() {
        if let Some(after) = rest.strip_prefix("none") {
            found.push(None);
            rest = after.trim_start();
        } else {
            let (inside, after) = rest.strip_prefix('(')?.split_once(')')?;
            found.push(Some(inside.split(',').map(|x| x.trim().parse().ok()).collect::<Option<Vec<f64>>>()?));
            rest = after.trim_start();
        }
    }
    Some(found)
}

fn numbers(fields: &HashMap<String, String>, name: &str, count: usize) -> Parsed<Option<Vec<f64>>> {
    let Some(text) = fields.get(name) else { return Ok(None) };
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(|w| w.parse().ok()).collect();
    match numbers {
        Some(n) if n.len() == count => Ok(Some(n)),
        _ => Err(Fault::damaged(format!("its `{name}` are not {count} numbers"))),
    }
}

/// Writes an attached NRRD, in LPS, little-endian.
pub(crate) fn write(out: &mut dyn Write, image: &Image, compress: bool) -> io::Result<()> {
    let type_name = match Kind::of(&image.pixels) {
        Kind::U8 => "unsigned char",
        Kind::I8 => "signed char",
        Kind::U16 => "unsigned short",
        Kind::I16 => "short",
        Kind::U32 => "unsigned int",
        Kind::I32 => "int",
        Kind::U64 => "unsigned long long",
        Kind::I64 => "long long",
        Kind::F32 => "float",
        Kind::F64 => "double",
    };
    let grid = &image.grid;
    let mut sizes: Vec<String> = grid.size.iter().map(usize::to_string).collect();
    let mut kinds = vec!["domain"; 3];
    let mut directions: Vec<String> = (0..3)
        .map(|c| {
            let step: Vec<String> = (0..3).map(|r| format!("{}", grid.direction[3 * r + c] * grid.spacing[c])).collect();
            format!("({})", step.join(","))
        })
        .collect();
    if image.components > 1 {
        sizes.insert(0, image.components.to_string());
        kinds.insert(0, "vector");
        directions.insert(0, "none".into());
    }
    if image.frames > 1 {
        // ITK takes an axis of kind `time` as one of space; `list` it reads as components, which loses nothing.
        sizes.push(image.frames.to_string());
        kinds.push("list");
        directions.push("none".into());
    }
    let origin = grid.origin;
    write!(
        out,
        "NRRD0004\n# Complete NRRD file format specification at:\n# http://teem.sourceforge.net/nrrd/format.html\n\
         type: {type_name}\ndimension: {}\nspace: left-posterior-superior\nsizes: {}\nspace directions: {}\nkinds: {}\n\
         endian: little\nencoding: {}\nspace origin: ({},{},{})\n\n",
        sizes.len(),
        sizes.join(" "),
        directions.join(" "),
        kinds.join(" "),
        if compress { "gzip" } else { "raw" },
        origin[0],
        origin[1],
        origin[2],
    )?;
    if compress {
        let mut packed = flate2::write::GzEncoder::new(out, flate2::Compression::fast());
        payload::encode(&image.pixels, &mut packed)?;
        packed.finish()?;
        return Ok(());
    }
    payload::encode(&image.pixels, out)
}
