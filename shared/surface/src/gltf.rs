//! glTF 2.0, binary (.glb): one mesh with normals, in a node that turns patient millimetres to glTF's metres.
//!
//! Positions are stored in LPS millimetres as everywhere; the node's matrix takes left to +X, head to +Y, the front to +Z and millimetres
//! to metres, so that viewers show the patient upright, facing them, in true size.

use crate::Mesh;
use std::io::{self, Write};

const JSON: u32 = 0x4e4f_534a;
const BIN: u32 = 0x004e_4942;

/// Writes a mesh as one .glb.
///
/// # Errors
/// Those of the writer, and a mesh of more than 4 GiB.
pub fn write_glb(mesh: &Mesh, mut out: impl Write) -> io::Result<()> {
    let (vertices, indices) = (mesh.positions.len(), mesh.triangles.len() * 3);
    let (vertex_bytes, index_bytes) = (vertices * 12, indices * 4);
    let length = 2 * vertex_bytes + index_bytes;
    let json = document(mesh, vertices, indices);
    let whole = 12 + 8 + json.len() + 8 + length;
    let whole = u32::try_from(whole).map_err(|_| io::Error::other("a glTF file holds at most 4 GiB"))?;
    for word in [0x4654_6c67, 2, whole, json.len() as u32, JSON] {
        out.write_all(&u32::to_le_bytes(word))?;
    }
    out.write_all(json.as_bytes())?;
    for word in [length as u32, BIN] {
        out.write_all(&u32::to_le_bytes(word))?;
    }
    let mut write = |numbers: &mut dyn Iterator<Item = [u8; 4]>| -> io::Result<()> {
        let mut bytes = Vec::with_capacity(1 << 16);
        for number in numbers {
            bytes.extend_from_slice(&number);
            if bytes.len() >= 1 << 16 {
                out.write_all(&bytes)?;
                bytes.clear();
            }
        }
        out.write_all(&bytes)
    };
    write(&mut mesh.positions.iter().flatten().map(|x| x.to_le_bytes()))?;
    write(&mut mesh.normals.iter().flatten().map(|x| x.to_le_bytes()))?;
    write(&mut mesh.triangles.iter().flatten().map(|v| v.to_le_bytes()))?;
    out.flush()
}

/// The JSON chunk, padded to four bytes with spaces.
fn document(mesh: &Mesh, vertices: usize, indices: usize) -> String {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for p in &mesh.positions {
        for c in 0..3 {
            low[c] = low[c].min(p[c]);
            high[c] = high[c].max(p[c]);
        }
    }
    if vertices == 0 {
        (low, high) = ([0.0; 3], [0.0; 3]);
    }
    let (vertex_bytes, index_bytes) = (vertices * 12, indices * 4);
    let mut json = format!(
        concat!(
            r#"{{"asset":{{"version":"2.0","generator":"maille"}},"scene":0,"scenes":[{{"nodes":[0]}}],"#,
            r#""nodes":[{{"mesh":0,"matrix":[0.001,0,0,0,0,0,-0.001,0,0,0.001,0,0,0,0,0,1]}}],"#,
            r#""meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"NORMAL":1}},"indices":2}}]}}],"#,
            r#""accessors":[{{"bufferView":0,"componentType":5126,"count":{vertices},"type":"VEC3","min":{low:?},"max":{high:?}}},"#,
            r#"{{"bufferView":1,"componentType":5126,"count":{vertices},"type":"VEC3"}},"#,
            r#"{{"bufferView":2,"componentType":5125,"count":{indices},"type":"SCALAR"}}],"#,
            r#""bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":{vertex_bytes},"target":34962}},"#,
            r#"{{"buffer":0,"byteOffset":{vertex_bytes},"byteLength":{vertex_bytes},"target":34962}},"#,
            r#"{{"buffer":0,"byteOffset":{offset},"byteLength":{index_bytes},"target":34963}}],"#,
            r#""buffers":[{{"byteLength":{length}}}]}}"#
        ),
        vertices = vertices,
        indices = indices,
        low = low,
        high = high,
        vertex_bytes = vertex_bytes,
        index_bytes = index_bytes,
        offset = 2 * vertex_bytes,
        length = 2 * vertex_bytes + index_bytes,
    );
    while json.len() % 4 != 0 {
        json.push(' ');
    }
    json
}
