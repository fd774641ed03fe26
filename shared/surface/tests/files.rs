//! The written files, read back by readers that know only the formats.

use maille_surface::{Mesh, marching_cubes, write_obj, write_ply, write_stl};
use maille_testkit::{Sphere, sample_volume};
use maille_volume::{Grid, Rescale};

/// Between the integers stored, so that no triangle is without area.
fn mesh() -> Mesh {
    let field = Sphere { center: [6.13, 7.21, 8.07], radius: 5.0, level: 0.0, slope: 100.0 };
    marching_cubes(&sample_volume(&Grid::axis_aligned([14, 15, 16], [1.0; 3]), &field, Rescale::IDENTITY), 0.5)
}

fn float(bytes: &[u8], at: usize) -> f32 {
    f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

#[test]
fn stl_holds_every_triangle_with_its_corners_and_unit_normal() {
    let (mesh, mut bytes) = (mesh(), Vec::new());
    write_stl(&mesh, &mut bytes).unwrap();
    assert!(!bytes.starts_with(b"solid"), "readers take that for the text format");
    assert_eq!(u32::from_le_bytes(bytes[80..84].try_into().unwrap()) as usize, mesh.triangles.len());
    assert_eq!(bytes.len(), 84 + 50 * mesh.triangles.len());
    for (t, record) in mesh.triangles.iter().zip(bytes[84..].chunks(50)) {
        let [n, a, b, c] = [0, 12, 24, 36].map(|at| [float(record, at), float(record, at + 4), float(record, at + 8)]);
        assert_eq!([a, b, c], t.map(|v| mesh.positions[v as usize]));
        // counter-clockwise: the normal is along (b − a) × (c − a), and out of the sphere
        let outward: f32 = (0..3).map(|x| n[x] * (a[x] - [6.13, 7.21, 8.07][x])).sum();
        assert!(outward > 0.0);
        assert!((n.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-5, "a unit vector to f32");
    }
}

#[test]
fn ply_holds_vertices_normals_and_indices() {
    let (mesh, mut bytes) = (mesh(), Vec::new());
    write_ply(&mesh, &mut bytes).unwrap();
    let marker = b"end_header\n";
    let start = bytes.windows(marker.len()).position(|w| w == marker).unwrap() + marker.len();
    let header = std::str::from_utf8(&bytes[..start]).unwrap();
    let count =
        |name: &str| -> usize { header.lines().find_map(|l| l.strip_prefix(&format!("element {name} "))).unwrap().parse().unwrap() };
    assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"));
    assert_eq!((count("vertex"), count("face")), (mesh.positions.len(), mesh.triangles.len()));
    for v in 0..count("vertex") {
        let at = |n: usize| float(&bytes, start + 24 * v + 4 * n);
        assert_eq!([at(0), at(1), at(2)], mesh.positions[v]);
        assert_eq!([at(3), at(4), at(5)], mesh.normals[v]);
    }
    let faces = &bytes[start + 24 * count("vertex")..];
    assert_eq!(faces.len(), 13 * count("face"));
    for (t, record) in mesh.triangles.iter().zip(faces.chunks(13)) {
        assert_eq!(record[0], 3);
        assert_eq!(*t, [1, 5, 9].map(|at| u32::from_le_bytes(record[at..at + 4].try_into().unwrap())));
    }
}

#[test]
fn obj_holds_vertices_normals_and_faces_counted_from_one() {
    let (mesh, mut bytes) = (mesh(), Vec::new());
    write_obj(&mesh, &mut bytes).unwrap();
    let (mut back, text) = (Mesh::default(), String::from_utf8(bytes).unwrap());
    for line in text.lines() {
        let mut words = line.split(' ');
        let kind = words.next().unwrap();
        let numbers =
            |words: std::str::Split<'_, char>| -> [f32; 3] { words.map(|w| w.parse().unwrap()).collect::<Vec<_>>().try_into().unwrap() };
        match kind {
            "v" => back.positions.push(numbers(words)),
            "vn" => back.normals.push(numbers(words)),
            "f" => {
                let corners: Vec<u32> = words
                    .map(|w| {
                        let (vertex, normal) = w.split_once("//").unwrap();
                        assert_eq!(vertex, normal);
                        vertex.parse::<u32>().unwrap() - 1
                    })
                    .collect();
                back.triangles.push(corners.try_into().unwrap());
            }
            _ => assert_eq!(kind, "#"),
        }
    }
    // decimal text of an f32 reads back to the same f32
    assert_eq!(back, mesh);
}
