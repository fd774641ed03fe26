//! MetaImage: `.mha` (one file) and `.mhd` (header beside `.raw` or `.zraw`).
//!
//! The rows of `TransformMatrix` are the directions of the index axes: as ITK reads it, the matrix is the transpose of
//! the direction cosines printed row-major. Offset and spacing are millimetres, LPS.
//!
//! Not here: scenes, other object types, `AnatomicalOrientation` (it repeats what the matrix says; ITK ignores it too).

use super::{
    Notice, Reading,
    error::{Fault, Parsed},
    geometry::grid_from_parts,
    nrrd::numbered,
    payload::{self, Kind, Packing},
};
use crate::{Image, Rescale};
use std::{
    collections::HashMap,
    fs::File,
    io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};

/// No header is longer than this.
const HEADER_LIMIT: u64 = 1 << 20;

/// Whether text begins like a MetaImage header.
pub(crate) fn looks_like(head: &[u8]) -> bool {
    let first = head.split(|b| *b == b'\n').next().unwrap_or_default();
    let key = first.split(|b| *b == b'=').next().unwrap_or_default().trim_ascii();
    first.contains(&b'=') && [&b"ObjectType"[..], b"NDims", b"Comment", b"ObjectSubType"].contains(&key)
}

/// Reads a MetaImage header and its data.
pub(crate) fn read(path: &Path) -> Parsed<Reading> {
    let mut reader = BufReader::new(File::open(path)?);
    let Header { fields, list } = Header::read(&mut reader)?;
    let mut notices = Vec::new();
    let get = |names: &[&str]| names.iter().find_map(|n| fields.get(*n)).map(String::as_str);
    let need = |name: &str| get(&[name]).ok_or_else(|| Fault::damaged(format!("its header has no `{name}`")));

    let dimension: usize = need("NDims")?
        .parse()
        .ok()
        .filter(|n| (1..=5).contains(n))
        .ok_or_else(|| Fault::unsupported("its `NDims` is not between 1 and 5", "store it as a volume of three dimensions"))?;
    let floats = |names: &[&str], count: usize| -> Parsed<Option<Vec<f64>>> {
        let Some(text) = get(names) else { return Ok(None) };
        let v: Option<Vec<f64>> = text.split_whitespace().map(|w| w.parse().ok().filter(|x: &f64| x.is_finite())).collect();
        match v {
            Some(v) if v.len() == count => Ok(Some(v)),
            _ => Err(Fault::damaged(format!("its `{}` is not {count} numbers", names[0]))),
        }
    };
    let sizes: Vec<usize> = match need("DimSize")?.split_whitespace().map(|w| w.parse().ok()).collect::<Option<Vec<usize>>>() {
        Some(s) if s.len() == dimension => s,
        _ => return Err(Fault::damaged(format!("its `DimSize` is not {dimension} whole numbers"))),
    };
    let components: usize = match get(&["ElementNumberOfChannels"]) {
        None => 1,
        Some(c) => c.parse().ok().filter(|c| *c >= 1).ok_or_else(|| Fault::damaged("its `ElementNumberOfChannels` is no number"))?,
    };
    let kind = parse_type(need("ElementType")?)?;
    let frames: usize = sizes.iter().skip(3).try_fold(1usize, |n, &s| n.checked_mul(s)).unwrap_or(usize::MAX);
    let all: Vec<usize> = sizes.iter().copied().chain([components]).collect();
    let expected = payload::expected_bytes(&all, kind)?;

    let grid = {
        let three = |v: Option<Vec<f64>>, rest: f64| -> [f64; 3] {
            std::array::from_fn(|c| v.as_ref().and_then(|v| v.get(c).copied()).unwrap_or(rest))
        };
        let spacing = three(floats(&["ElementSpacing", "ElementSize"], dimension)?, 1.0);
        let origin = three(floats(&["Offset", "Position", "Origin"], dimension)?, 0.0);
        let matrix = floats(&["TransformMatrix", "Rotation", "Orientation"], dimension * dimension)?;
        let mut direction = crate::grid::IDENTITY;
        if let Some(m) = matrix {
            for (axis, row) in m.chunks(dimension).take(3).enumerate() {
                for r in 0..dimension.min(3) {
                    direction[3 * r + axis] = row[r];
                }
            }
        }
        let size = std::array::from_fn(|c| sizes.get(c).copied().unwrap_or(1));
        grid_from_parts(size, spacing, direction, origin)?
    };

    let flag = |names: &[&str]| get(names).is_some_and(|v| v.starts_with(['T', 't', '1']));
    let text = get(&["BinaryData"]).is_some_and(|v| v.starts_with(['F', 'f', '0']));
    let big_endian = flag(&["BinaryDataByteOrderMSB", "ElementByteOrderMSB"]);
    let compressed = flag(&["CompressedData"]);
    let header_size: i64 = match get(&["HeaderSize"]) {
        None => 0,
        Some(h) => h.parse().ok().filter(|h| *h >= -1).ok_or_else(|| Fault::damaged("its `HeaderSize` means nothing"))?,
    };
    for (name, neutral) in [("ElementToIntensityFunctionSlope", 1.0), ("ElementToIntensityFunctionOffset", 0.0)] {
        if floats(&[name], 1)?.is_some_and(|v| v[0] != neutral) {
            notices.push(Notice(format!("its `{name}` is not applied, as in ITK; the values are those stored")));
        }
    }

    let layout = Layout { text, compressed, header_size, kind, big_endian };
    let data_file = need("ElementDataFile")?;
    let pixels = if matches!(data_file, "LOCAL" | "Local" | "local") {
        if header_size > 0 {
            return Err(Fault::unsupported(
                "its voxels follow the header and it states a `HeaderSize` as well, which readers take in different ways",
                "remove the `HeaderSize` line",
            ));
        }
        layout.read(&mut reader, expected, true)?
    } else {
        let files = data_files(path, data_file, &list)?;
        if !expected.is_multiple_of(files.len() * kind.size_bytes()) {
            return Err(Fault::damaged(format!("its {} data files do not divide its voxels evenly", files.len())));
        }
        let mut bytes = Vec::new();
        if let [file] = &files[..] {
            let pixels = File::open(file).map_err(Fault::Io).and_then(|f| layout.read(&mut BufReader::new(f), expected, false));
            pixels.map_err(|fault| Fault::Named(Box::new(fault.at(file))))?
        } else {
            if text {
                return Err(Fault::unsupported("its voxels are text in several files", "store them in binary"));
            }
            for file in &files {
                let part =
                    File::open(file).map_err(Fault::Io).and_then(|f| layout.bytes(&mut BufReader::new(f), expected / files.len(), false));
                bytes.extend(part.map_err(|fault| Fault::Named(Box::new(fault.at(file))))?);
            }
            payload::decode(bytes, kind, big_endian)
        }
    };
    Ok(Reading { image: Image { grid, components, frames, rescale: Rescale::IDENTITY, pixels }, notices, stored_type: None })
}

/// How the voxels lie in a data file.
struct Layout {
    text: bool,
    compressed: bool,
    /// bytes before the voxels; −1: they are the last
    header_size: i64,
    kind: Kind,
    big_endian: bool,
}

impl Layout {
    fn read<R: BufRead + Seek>(&self, reader: &mut R, expected: usize, local: bool) -> Parsed<crate::Pixels> {
        if self.text {
            let count = expected / self.kind.size_bytes();
            let mut text = Vec::new();
            reader.take((count as u64).saturating_mul(64).saturating_add(4096)).read_to_end(&mut text)?;
            return payload::parse_text(&text, self.kind, count);
        }
        Ok(payload::decode(self.bytes(reader, expected, local)?, self.kind, self.big_endian))
    }

    fn bytes<R: BufRead + Seek>(&self, reader: &mut R, expected: usize, local: bool) -> Parsed<Vec<u8>> {
        if self.compressed {
            if !local && self.header_size > 0 {
                reader.seek(SeekFrom::Start(self.header_size as u64))?;
            }
            // Compressed data are zlib by the format; some writers leave gzip.
            let packing = if reader.fill_buf()?.starts_with(&[0x1f, 0x8b]) { Packing::Gzip } else { Packing::Zlib };
            return payload::take_exactly(&mut *payload::unpack(reader, packing), expected, true);
        }
        if self.header_size == -1 {
            return payload::take_last(reader, expected);
        }
        if !local {
            payload::skip(reader, self.header_size as u64)?;
        }
        payload::take_exactly(reader, expected, true)
    }
}

struct Header {
    fields: HashMap<String, String>,
    list: Vec<String>,
}

impl Header {
    fn read(reader: &mut impl BufRead) -> Parsed<Self> {
        let mut fields = HashMap::new();
        let mut list = Vec::new();
        let mut limited = reader.take(HEADER_LIMIT);
        loop {
            let mut line = Vec::new();
            if limited.read_until(b'\n', &mut line)? == 0 {
                return Err(Fault::damaged("its header has no `ElementDataFile`, so nothing says where the voxels are"));
            }
            let line = String::from_utf8_lossy(&line);
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let Some((key, value)) = line.split_once('=').or_else(|| line.split_once(':')) else {
                return Err(Fault::damaged(format!("its header line {:?} has no `=`", line.chars().take(60).collect::<String>())));
            };
            let (key, value) = (key.trim().to_string(), value.trim().to_string());
            let last = key == "ElementDataFile";
            let is_list = last && value.starts_with("LIST");
            fields.insert(key, value);
            if is_list {
                let mut text = Vec::new();
                limited.read_to_end(&mut text)?;
                list = String::from_utf8_lossy(&text).lines().map(|l| l.trim().to_string()).filter(|l| !l.is_empty()).collect();
            }
            if last {
                return Ok(Self { fields, list });
            }
        }
    }
}

fn parse_type(name: &str) -> Parsed<Kind> {
    Ok(match name.strip_suffix("_ARRAY").unwrap_or(name) {
        "MET_CHAR" | "MET_ASCII_CHAR" => Kind::I8,
        "MET_UCHAR" => Kind::U8,
        "MET_SHORT" => Kind::I16,
        "MET_USHORT" => Kind::U16,
        // MetaIO's long has four bytes on every machine.
        "MET_INT" | "MET_LONG" => Kind::I32,
        "MET_UINT" | "MET_ULONG" => Kind::U32,
        "MET_LONG_LONG" => Kind::I64,
        "MET_ULONG_LONG" => Kind::U64,
        "MET_FLOAT" => Kind::F32,
        "MET_DOUBLE" => Kind::F64,
        other => return Err(Fault::unsupported(format!("its `ElementType` {other:?} is not known"), "store it with a numeric type")),
    })
}

fn data_files(header: &Path, value: &str, list: &[String]) -> Parsed<Vec<PathBuf>> {
    let folder = header.parent().unwrap_or(Path::new("."));
    if value.starts_with("LIST") {
        if list.is_empty() {
            return Err(Fault::damaged("its list of data files is empty"));
        }
        return Ok(list.iter().map(|name| folder.join(name)).collect());
    }
    let words: Vec<&str> = value.split_whitespace().collect();
    if let [pattern, numbers @ ..] = &words[..]
        && pattern.contains('%')
    {
        let numbers: Vec<i64> = numbers.iter().filter_map(|w| w.parse().ok()).collect();
        let [first, last, ref step @ ..] = numbers[..] else {
            return Err(Fault::damaged(format!("its `ElementDataFile` {value:?} is no pattern with two numbers")));
        };
        let step = step.first().copied().unwrap_or(1);
        if step < 1 || last < first || i128::from(last) - i128::from(first) > 100_000 {
            return Err(Fault::damaged(format!("its `ElementDataFile` {value:?} names no series of files")));
        }
        return (first..=last).step_by(step as usize).map(|n| numbered(pattern, n).map(|name| folder.join(name))).collect();
    }
    Ok(vec![folder.join(value)])
}

/// Where the voxels go.
pub(crate) enum Data<'a> {
    /// after the header (`.mha`)
    Local,
    /// in a file beside it (`.mhd`): its name and a writer
    Beside(&'a str, &'a mut dyn Write),
}

/// Writes a MetaImage in LPS, little-endian, as ITK does.
pub(crate) fn write(out: &mut dyn Write, data: Data<'_>, image: &Image, compress: bool) -> io::Result<()> {
    let type_name = match Kind::of(&image.pixels) {
        Kind::U8 => "MET_UCHAR",
        Kind::I8 => "MET_CHAR",
        Kind::U16 => "MET_USHORT",
        Kind::I16 => "MET_SHORT",
        Kind::U32 => "MET_UINT",
        Kind::I32 => "MET_INT",
        Kind::U64 => "MET_ULONG_LONG",
        Kind::I64 => "MET_LONG_LONG",
        Kind::F32 => "MET_FLOAT",
        Kind::F64 => "MET_DOUBLE",
    };
    let n = if image.frames > 1 { 4 } else { 3 };
    let grid = &image.grid;
    let list = |f: &dyn Fn(usize) -> String| (0..n).map(f).collect::<Vec<_>>().join(" ");
    let matrix = |axis: usize| {
        let cosine = |r: usize| match (axis, r) {
            (0..3, 0..3) => grid.direction[3 * r + axis],
            _ => f64::from(u8::from(axis == r)),
        };
        list(&|r| cosine(r).to_string())
    };
    let packed = if compress {
        let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        payload::encode(&image.pixels, &mut encoder)?;
        Some(encoder.finish()?)
    } else {
        None
    };
    write!(out, "ObjectType = Image\nNDims = {n}\nBinaryData = True\nBinaryDataByteOrderMSB = False\n")?;
    match &packed {
        Some(bytes) => write!(out, "CompressedData = True\nCompressedDataSize = {}\n", bytes.len())?,
        None => writeln!(out, "CompressedData = False")?,
    }
    write!(
        out,
        "TransformMatrix = {}\nOffset = {}\nCenterOfRotation = {}\nElementSpacing = {}\nDimSize = {}\n",
        list(&matrix),
        list(&|c| grid.origin.get(c).unwrap_or(&0.0).to_string()),
        list(&|_| "0".into()),
        list(&|c| grid.spacing.get(c).unwrap_or(&1.0).to_string()),
        list(&|c| grid.size.get(c).unwrap_or(&image.frames).to_string()),
    )?;
    if image.components > 1 {
        writeln!(out, "ElementNumberOfChannels = {}", image.components)?;
    }
    let name = match &data {
        Data::Local => "LOCAL",
        Data::Beside(name, _) => name,
    };
    write!(out, "ElementType = {type_name}\nElementDataFile = {name}\n")?;
    let voxels = |out: &mut dyn Write| match &packed {
        Some(bytes) => out.write_all(bytes),
        None => payload::encode(&image.pixels, out),
    };
    match data {
        Data::Local => voxels(out),
        Data::Beside(_, beside) => voxels(beside),
    }
}
