//! Meshes as bytes: binary STL, binary PLY with normals, and OBJ. Coordinates stay in LPS millimetres, which none of these
//! formats can say; comments do.

use crate::mesh::{Mesh, norm};
use std::io::{self, Write};

/// Binary STL: every triangle with its own corners and its flat normal.
///
/// # Errors
/// Those of the writer.
pub fn write_stl(mesh: &Mesh, mut out: impl Write) -> io::Result<()> {
    // a binary STL must not begin with "solid"
    let mut header = [b' '; 80];
    let title = b"maille surface, LPS, mm";
    header[..title.len()].copy_from_slice(title);
    out.write_all(&header)?;
    let count = u32::try_from(mesh.triangles.len()).map_err(|_| io::Error::other("an STL file holds at most 2^32 - 1 triangles"))?;
    out.write_all(&count.to_le_bytes())?;
    let mut bytes = Vec::with_capacity(50 * 4096);
    for triangles in mesh.triangles.chunks(4096) {
        bytes.clear();
        for triangle in triangles {
            let n = mesh.doubled_area_vector(triangle);
            let length = norm(n);
            let normal = n.map(|x| if length > 0.0 { (x / length) as f32 } else { 0.0 });
            let corners = triangle.map(|v| mesh.positions[v as usize]);
            for x in normal.iter().chain(corners.iter().flatten()) {
                bytes.extend_from_slice(&x.to_le_bytes());
            }
            bytes.extend_from_slice(&[0, 0]);
        }
        out.write_all(&bytes)?;
    }
    out.flush()
}

/// Binary little-endian PLY: vertices with normals, triangles as lists of three.
///
/// # Errors
/// Those of the writer.
pub fn write_ply(mesh: &Mesh, mut out: impl Write) -> io::Result<()> {
    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment maille surface, LPS, mm")?;
    writeln!(out, "element vertex {}", mesh.positions.len())?;
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        writeln!(out, "property float {name}")?;
    }
    writeln!(out, "element face {}\nproperty list uchar int vertex_indices\nend_header", mesh.triangles.len())?;
    let mut bytes = Vec::with_capacity(24 * 4096);
    for (positions, normals) in mesh.positions.chunks(4096).zip(mesh.normals.chunks(4096)) {
        bytes.clear();
        for (p, n) in positions.iter().zip(normals) {
            for x in p.iter().chain(n) {
                bytes.extend_from_slice(&x.to_le_bytes());
            }
        }
        out.write_all(&bytes)?;
    }
    for triangles in mesh.triangles.chunks(4096) {
        bytes.clear();
        for triangle in triangles {
            bytes.push(3);
            for v in triangle {
                bytes.extend_from_slice(&v.to_le_bytes());
            }
        }
        out.write_all(&bytes)?;
    }
    out.flush()
}

/// Wavefront OBJ: text, one normal a vertex.
///
/// # Errors
/// Those of the writer.
pub fn write_obj(mesh: &Mesh, mut out: impl Write) -> io::Result<()> {
    writeln!(out, "# maille surface, LPS, mm")?;
    for [x, y, z] in &mesh.positions {
        writeln!(out, "v {x} {y} {z}")?;
    }
    for [x, y, z] in &mesh.normals {
        writeln!(out, "vn {x} {y} {z}")?;
    }
    for triangle in &mesh.triangles {
        // OBJ counts from one
        let [a, b, c] = triangle.map(|v| u64::from(v) + 1);
        writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
    }
    out.flush()
}
