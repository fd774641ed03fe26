//! Meshes out of bytes: STL (binary and text), PLY (text and binary little-endian) and OBJ; what [`write`](crate::write_stl) writes and
//! what other programs commonly do.
//!
//! Coordinates are taken as they stand, in LPS millimetres. Corners of STL triangles at the same place become one vertex. Faces of
//! more than three corners are cut into fans. Normals are the area-weighted mean of the triangles around a vertex; those in files
//! are left aside. No code here opens a file.

use crate::mesh::Mesh;
use std::{collections::HashMap, str::SplitWhitespace};
use thiserror::Error;

/// Why bytes are no mesh.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
pub enum ReadError {
    /// an ending that no reader has
    #[error("meshes are read from .stl, .ply and .obj, not from .{0}")]
    Format(String),
    /// what is wrong, and where
    #[error("no sound {format}: {reason}")]
    Unsound {
        /// STL, PLY or OBJ
        format: &'static str,
        /// line or byte, and what stands there
        reason: String,
    },
}

type Triangles = (Vec<[f32; 3]>, Vec<[u32; 3]>);

/// Reads a mesh in the format that a file's ending names.
///
/// # Errors
/// [`ReadError`].
pub fn read_mesh(bytes: &[u8], ending: &str) -> Result<Mesh, ReadError> {
    let unsound = |format| move |reason| ReadError::Unsound { format, reason };
    let (positions, triangles) = match ending.to_ascii_lowercase().as_str() {
        "stl" => stl(bytes).map_err(unsound("STL"))?,
        "ply" => ply(bytes).map_err(unsound("PLY"))?,
        "obj" => obj(bytes).map_err(unsound("OBJ"))?,
        other => return Err(ReadError::Format(other.into())),
    };
    let format = if ending.eq_ignore_ascii_case("stl") {
        "STL"
    } else if ending.eq_ignore_ascii_case("ply") {
        "PLY"
    } else {
        "OBJ"
    };
    let fault = |reason: String| Err(ReadError::Unsound { format, reason });
    if let Some(n) = positions.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
        return fault(format!("vertex {n} is not finite"));
    }
    if let Some(n) = triangles.iter().position(|t| t.iter().any(|&v| v as usize >= positions.len())) {
        return fault(format!("triangle {n} has a corner that is no vertex"));
    }
    if triangles.is_empty() {
        return fault("there is no triangle in it".into());
    }
    let mut mesh = Mesh { normals: vec![[0.0; 3]; positions.len()], positions, triangles };
    for t in 0..mesh.triangles.len() {
        let corners = mesh.triangles[t];
        let area = mesh.doubled_area_vector(&corners);
        for v in corners {
            (0..3).for_each(|c| mesh.normals[v as usize][c] += area[c] as f32);
        }
    }
    for n in &mut mesh.normals {
        let length = n.iter().map(|c| c * c).sum::<f32>().sqrt();
        *n = if length > 0.0 { n.map(|c| c / length) } else { [0.0, 0.0, 1.0] };
    }
    Ok(mesh)
}

/// Corners that lie at the same place become one.
#[derive(Default)]
struct Welder {
    known: HashMap<[u32; 3], u32>,
    positions: Vec<[f32; 3]>,
}

impl Welder {
    fn vertex(&mut self, p: [f32; 3]) -> u32 {
        // 0 and −0 are one place
        let p = p.map(|c| c + 0.0);
        *self.known.entry(p.map(f32::to_bits)).or_insert_with(|| {
            self.positions.push(p);
            self.positions.len() as u32 - 1
        })
    }
}

fn f32_at(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn stl(bytes: &[u8]) -> Result<Triangles, String> {
    let mut weld = Welder::default();
    let mut triangles = Vec::new();
    // a text begins with "solid", but so do some binary files: their length tells
    let count = bytes.get(80..84).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    if let Some(count) = count.filter(|&n| 84 + 50 * n == bytes.len()) {
        for n in 0..count {
            let corner = |m: usize| std::array::from_fn(|c| f32_at(bytes, 84 + 50 * n + 12 + 12 * m + 4 * c));
            triangles.push([0, 1, 2].map(|m| weld.vertex(corner(m))));
        }
        return Ok((weld.positions, triangles));
    }
    let text = std::str::from_utf8(bytes).map_err(|_| length_fault(bytes.len(), count))?;
    if !text.trim_start().starts_with("solid") {
        return Err(length_fault(bytes.len(), count));
    }
    let mut corners = Vec::new();
    for (n, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("vertex") => {
                let p = numbers(&mut words).ok_or_else(|| format!("line {} is no vertex: {line}", n + 1))?;
                corners.push(weld.vertex(p));
            }
            Some("endfacet") => {
                let [a, b, c] = corners[..] else {
                    return Err(format!("the facet that ends in line {} has {} corners", n + 1, corners.len()));
                };
                triangles.push([a, b, c]);
                corners.clear();
            }
            _ => {}
        }
    }
    Ok((weld.positions, triangles))
}

fn length_fault(length: usize, count: Option<usize>) -> String {
    match count {
        Some(n) => format!("{length} bytes, but {n} triangles take {}", 84 + 50 * n),
        None => format!("{length} bytes hold no header"),
    }
}

fn numbers(words: &mut SplitWhitespace<'_>) -> Option<[f32; 3]> {
    let mut next = || words.next()?.parse().ok();
    Some([next()?, next()?, next()?])
}

fn fan(corners: &[u32], triangles: &mut Vec<[u32; 3]>) {
    triangles.extend(corners.windows(2).skip(1).map(|w| [corners[0], w[0], w[1]]));
}

fn obj(bytes: &[u8]) -> Result<Triangles, String> {
    let text = std::str::from_utf8(bytes).map_err(|e| format!("byte {} is no text", e.valid_up_to()))?;
    let (mut positions, mut triangles, mut corners) = (Vec::new(), Vec::new(), Vec::new());
    for (n, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace();
        let fault = || format!("line {} cannot be read: {line}", n + 1);
        match words.next() {
            Some("v") => positions.push(numbers(&mut words).ok_or_else(fault)?),
            Some("f") => {
                corners.clear();
                for word in words {
                    let number: i64 = word.split('/').next().and_then(|w| w.parse().ok()).ok_or_else(fault)?;
                    // 1 is the first, −1 the last that there was
                    let at = if number > 0 { number - 1 } else { positions.len() as i64 + number };
                    corners.push(u32::try_from(at).ok().filter(|_| number != 0).ok_or_else(fault)?);
                }
                if corners.len() < 3 {
                    return Err(fault());
                }
                fan(&corners, &mut triangles);
            }
            _ => {}
        }
    }
    Ok((positions, triangles))
}

/// Numbers of a PLY, in text or in bytes.
enum Body<'a> {
    Text(SplitWhitespace<'a>),
    Bytes { bytes: &'a [u8], at: usize },
}

impl Body<'_> {
    fn next(&mut self, kind: &str) -> Result<f64, String> {
        match self {
            Self::Text(words) => {
                let word = words.next().ok_or("it ends too early")?;
                word.parse().map_err(|_| format!("{word} is no number"))
            }
            Self::Bytes { bytes, at } => {
                let size = size_of_kind(kind)?;
                let b = bytes.get(*at..*at + size).ok_or("it ends too early")?;
                *at += size;
                Ok(match kind {
                    "char" | "int8" => f64::from(b[0] as i8),
                    "uchar" | "uint8" => f64::from(b[0]),
                    "short" | "int16" => f64::from(i16::from_le_bytes([b[0], b[1]])),
                    "ushort" | "uint16" => f64::from(u16::from_le_bytes([b[0], b[1]])),
                    "int" | "int32" => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
                    "uint" | "uint32" => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
                    "float" | "float32" => f64::from(f32_at(b, 0)),
                    _ => f64::from_le_bytes(std::array::from_fn(|n| b[n])),
                })
            }
        }
    }
}

fn size_of_kind(kind: &str) -> Result<usize, String> {
    Ok(match kind {
        "char" | "int8" | "uchar" | "uint8" => 1,
        "short" | "int16" | "ushort" | "uint16" => 2,
        "int" | "int32" | "uint" | "uint32" | "float" | "float32" => 4,
        "double" | "float64" => 8,
        other => return Err(format!("a number of the unknown type {other}")),
    })
}

/// A property's name, and its kind of number; two where it is a list.
type Property<'a> = (&'a str, Vec<&'a str>);

fn ply(bytes: &[u8]) -> Result<Triangles, String> {
    const END: &[u8] = b"end_header";
    let end = bytes.windows(END.len()).position(|w| w == END).ok_or("its header does not end")?;
    let header = std::str::from_utf8(&bytes[..end]).map_err(|_| "its header is no text")?;
    let first = end + bytes[end..].iter().position(|&b| b == b'\n').ok_or("nothing follows its header")? + 1;
    let mut elements: Vec<(&str, usize, Vec<Property<'_>>)> = Vec::new();
    let mut format = "";
    for line in header.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            ["format", f, ..] => format = f,
            ["element", name, count] => elements.push((name, count.parse().map_err(|_| format!("{count} {name}"))?, Vec::new())),
            ["property", "list", count, kind, name] => {
                elements.last_mut().ok_or("a property of nothing")?.2.push((name, vec![count, kind]))
            }
            ["property", kind, name] => elements.last_mut().ok_or("a property of nothing")?.2.push((name, vec![kind])),
            _ => {}
        }
    }
    let mut body = match format {
        "ascii" => Body::Text(std::str::from_utf8(&bytes[first..]).map_err(|_| "a text with bytes that are none")?.split_whitespace()),
        "binary_little_endian" => Body::Bytes { bytes, at: first },
        other => return Err(format!("format {other}; ascii and binary_little_endian are read")),
    };
    let (mut positions, mut triangles, mut corners) = (Vec::new(), Vec::new(), Vec::new());
    for (name, count, properties) in elements {
        for _ in 0..count {
            let mut p = [0.0f32; 3];
            for (property, kinds) in &properties {
                if let [length, kind] = kinds[..] {
                    corners.clear();
                    let length = body.next(length)?;
                    for _ in 0..length.max(0.0) as u64 {
                        corners.push(body.next(kind)? as u32);
                    }
                    if name == "face" && property.starts_with("vertex_ind") {
                        fan(&corners, &mut triangles);
                    }
                } else {
                    let v = body.next(kinds[0])?;
                    if let Some(c) = ["x", "y", "z"].iter().position(|axis| axis == property) {
                        p[c] = v as f32;
                    }
                }
            }
            if name == "vertex" {
                positions.push(p);
            }
        }
    }
    Ok((positions, triangles))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{write_obj, write_ply, write_stl};

    fn tetrahedron() -> Mesh {
        let positions = vec![[0.0, 0.0, 0.0], [3.5, 0.0, 0.0], [0.0, 2.25, 0.0], [0.0, 0.0, -7.125]];
        Mesh { normals: vec![[0.0, 0.0, 1.0]; 4], positions, triangles: vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]] }
    }

    #[test]
    fn what_is_written_is_read_again() {
        let mesh = tetrahedron();
        type Write = fn(&Mesh, &mut Vec<u8>) -> std::io::Result<()>;
        let writers: [(&str, Write); 3] =
            [("stl", |m, o| write_stl(m, o)), ("PLY", |m, o| write_ply(m, o)), ("obj", |m, o| write_obj(m, o))];
        for (ending, write) in writers {
            let mut bytes = Vec::new();
            write(&mesh, &mut bytes).unwrap();
            let read = read_mesh(&bytes, ending).unwrap();
            assert_eq!(read.triangles.len(), 4, "{ending}");
            assert_eq!(read.positions.len(), 4, "{ending}: corners are shared");
            assert!((read.volume() - mesh.volume()).abs() < 1e-6 && (read.area() - mesh.area()).abs() < 1e-4, "{ending}");
            // the corner at (3.5, 0, 0) points away from the others
            let tip = read.positions.iter().position(|p| p[0] == 3.5).unwrap();
            assert!(read.normals[tip][0].abs() > 0.5, "{ending}: {:?}", read.normals[tip]);
        }
    }

    #[test]
    fn texts_of_other_programs_are_read() {
        let stl =
            b"solid x\n facet normal 0 0 1\n outer loop\n vertex 0 0 0\n vertex 1 0 0\n vertex 0 1e0 0\n endloop\n endfacet\nendsolid x\n";
        assert_eq!(read_mesh(stl, "stl").unwrap().triangles, [[0, 1, 2]]);
        let obj = b"# c\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1 4//1\nf -4/1 -3 -2\n";
        assert_eq!(read_mesh(obj, "obj").unwrap().triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
        let ply = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\n\
            element face 1\nproperty list uchar uint vertex_index\nend_header\n0 0 0 9\n1 0 0 9\n0 1 0 9\n3 0 1 2\n";
        assert_eq!(read_mesh(ply, "ply").unwrap().positions[1], [1.0, 0.0, 0.0]);
    }

    #[test]
    fn nonsense_is_refused_with_a_sentence() {
        let mut stl = Vec::new();
        write_stl(&tetrahedron(), &mut stl).unwrap();
        let mut ply = Vec::new();
        write_ply(&tetrahedron(), &mut ply).unwrap();
        let cases: [(&[u8], &str); 10] = [
            (b"", "stl"),
            (&stl[..stl.len() - 7], "stl"),
            (&ply[..ply.len() - 3], "ply"),
            (b"ply\nformat binary_big_endian 1.0\nend_header\n", "ply"),
            (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "obj"),
            (b"v 0 0\n", "obj"),
            (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "obj"),
            (b"v 0 0 0\nf 1 0 1\n", "obj"),
            (b"v 0 0 0\n", "obj"),
            (b"", "vtk"),
        ];
        for (bytes, ending) in cases {
            let error = read_mesh(bytes, ending).unwrap_err().to_string();
            assert!(error.len() > 20, "{error}");
        }
    }
}
