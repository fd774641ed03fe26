//! The triangles of a cell for each of the 256 ways its corners can lie inside or outside.
//!
//! The table is not written down but follows from one rule a face: walking around a face counter-clockwise seen from
//! outside the cell, each run of inside corners is cut off by one segment, from the edge by which the run is entered to the edge by
//! which it is left. A crossed edge is left through in one of its two faces and entered through in the other, so segments close
//! to loops; and as the rule asks only for the face's own corners, the neighbour cell draws the same segments, backwards. Hence no
//! holes, whatever the volume (the flaw of the first published table [Lorensen & Cline 1987; Dürst 1988]).
//!
//! Loops are cut into triangles without a diagonal that lies in a face, since the neighbour could draw it too, and then
//! four triangles would share it.
//!
//! Corner c stands at (c & 1, c >> 1 & 1, c >> 2). Edge 4a + n runs along axis a, n numbering its other two coordinates.

use std::sync::OnceLock;

/// Most triangles a cell can have.
const MOST: usize = 12;

/// Triangles of one configuration, as edge numbers.
#[derive(Clone, Copy)]
pub(crate) struct Case {
    pub count: u8,
    pub triangles: [[u8; 3]; MOST],
}

impl Case {
    /// The triangles.
    #[inline]
    pub fn triangles(&self) -> &[[u8; 3]] {
        &self.triangles[..usize::from(self.count)]
    }
}

/// Corners of the faces, counter-clockwise seen from outside: −x, +x, −y, +y, −z, +z.
const FACES: [[u8; 4]; 6] = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

/// Number of the edge between two neighbouring corners.
pub(crate) const fn edge(a: u8, b: u8) -> u8 {
    let low = if a < b { a } else { b };
    match a ^ b {
        1 => low >> 1,
        2 => 4 + (low & 1) + (low >> 2 << 1),
        _ => 8 + low,
    }
}

/// The table, by bit mask of inside corners; built at the first call in some microseconds.
pub(crate) fn cases() -> &'static [Case; 256] {
    static TABLE: OnceLock<[Case; 256]> = OnceLock::new();
    TABLE.get_or_init(|| std::array::from_fn(|mask| case(mask as u8)))
}

fn case(mask: u8) -> Case {
    let mut result = Case { count: 0, triangles: [[0; 3]; MOST] };
    let mut push = |t: [u8; 3]| {
        result.triangles[usize::from(result.count)] = t;
        result.count += 1;
    };
    for polygon in loops(mask) {
        let mut triangles = Vec::new();
        assert!(triangulate(&polygon, &mut triangles), "every loop has a triangulation without diagonals in faces");
        triangles.into_iter().for_each(&mut push);
    }
    result
}

/// The closed loops of crossed edges, each counter-clockwise seen from outside the surface.
fn loops(mask: u8) -> Vec<Vec<u8>> {
    let inside = |corner: u8| mask >> corner & 1 == 1;
    let mut next = [None; 12];
    for face in FACES {
        for leave in 0..4 {
            let (a, b) = (face[leave], face[(leave + 1) % 4]);
            if !inside(a) || inside(b) {
                continue;
            }
            // back along the run of inside corners to where it was entered
            let entered = (0..4).map(|n| (leave + 4 - n) % 4).find(|&n| !inside(face[(n + 3) % 4])).expect("b is outside");
            next[usize::from(edge(face[entered], face[(entered + 3) % 4]))] = Some(edge(a, b));
        }
    }
    let mut found = Vec::new();
    for first in 0..12u8 {
        let mut polygon = Vec::new();
        let mut at = first;
        while let Some(to) = next[usize::from(at)].take() {
            polygon.push(at);
            at = to;
        }
        if !polygon.is_empty() {
            found.push(polygon);
        }
    }
    found
}

/// Whether two edges of the cell lie in one face.
fn in_one_face(a: u8, b: u8) -> bool {
    FACES.iter().any(|face| {
        let has = |e| (0..4).any(|n| edge(face[n], face[(n + 1) % 4]) == e);
        has(a) && has(b)
    })
}

/// Cuts a polygon into triangles, none of whose diagonals lies in a face; false if that cannot be.
fn triangulate(polygon: &[u8], out: &mut Vec<[u8; 3]>) -> bool {
    let last = polygon.len() - 1;
    if last < 2 {
        return true;
    }
    // the triangle on the side (last, 0): its third corner splits the rest in two
    for third in 1..last {
        let free = |a: usize, b: usize| b - a < 2 || !in_one_face(polygon[a], polygon[b]);
        if !free(0, third) || !free(third, last) {
            continue;
        }
        let length = out.len();
        out.push([polygon[0], polygon[third], polygon[last]]);
        if triangulate(&polygon[..=third], out) && triangulate(&polygon[third..], out) {
            return true;
        }
        out.truncate(length);
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Position of the middle of an edge, in half cells.
    fn middle(e: u8) -> [i32; 3] {
        let ends: Vec<u8> =
            (0..8u8).flat_map(|a| [1, 2, 4].map(|b| (a, a ^ b))).find(|&(a, b)| edge(a, b) == e).map(|(a, b)| vec![a, b]).unwrap();
        std::array::from_fn(|c| ends.iter().map(|corner| i32::from(corner >> c & 1)).sum())
    }

    #[test]
    fn every_case_is_a_surface_whose_rim_is_the_segments_of_the_faces() {
        for mask in 0..=255u8 {
            let case = cases()[usize::from(mask)];
            let mut sides = std::collections::HashMap::new();
            for t in case.triangles() {
                for n in 0..3 {
                    *sides.entry((t[n], t[(n + 1) % 3])).or_insert(0) += 1;
                }
            }
            assert!(sides.values().all(|&n| n == 1), "mask {mask}: a side is used twice in one direction");
            // sides without their opposite are the rim: one segment for each run of inside corners of each face
            let rim: Vec<_> = sides.keys().filter(|(a, b)| !sides.contains_key(&(*b, *a))).collect();
            let runs: usize =
                FACES.iter().map(|f| (0..4).filter(|&n| mask >> f[n] & 1 == 1 && mask >> f[(n + 1) % 4] & 1 == 0).count()).sum();
            assert_eq!(rim.len(), runs, "mask {mask}");
            assert!(rim.iter().all(|(a, b)| in_one_face(*a, *b)));
            assert!(sides.keys().filter(|(a, b)| sides.contains_key(&(*b, *a))).all(|(a, b)| !in_one_face(*a, *b)));
        }
    }

    #[test]
    fn every_crossed_edge_and_no_other_is_used() {
        for mask in 0..=255u8 {
            let used: std::collections::HashSet<u8> = cases()[usize::from(mask)].triangles().iter().flatten().copied().collect();
            for a in 0..8u8 {
                for b in [1, 2, 4].map(|bit| a ^ bit) {
                    let crossed = (mask >> a ^ mask >> b) & 1 == 1;
                    assert_eq!(crossed, used.contains(&edge(a, b)), "mask {mask} edge {a}–{b}");
                }
            }
        }
    }

    #[test]
    fn a_single_inside_corner_is_cut_off_with_its_triangle_facing_away() {
        for corner in 0..8u8 {
            let case = cases()[1 << corner];
            assert_eq!(case.count, 1);
            let [a, b, c] = case.triangles[0].map(middle);
            let (u, v): ([i32; 3], [i32; 3]) = (std::array::from_fn(|n| b[n] - a[n]), std::array::from_fn(|n| c[n] - a[n]));
            let normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            let outward: i32 = (0..3).map(|n| normal[n] * (a[n] - 2 * i32::from(corner >> n & 1))).sum();
            assert!(outward > 0, "corner {corner}");
        }
    }
}
