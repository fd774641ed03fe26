//! Outlines of solid bodies in a section: where their surfaces cut its plane.
//!
//! A triangle that crosses the plane leaves a line between its two edges' crossings. A capsule is outlined where its distance
//! function vanishes, the distance measured in the plane by the function's slope there. Lines are about 1½ pixels wide, each pixel
//! covered once by the body that covers it most. Units: mm of the plane, pixels of the picture.

use crate::{
    geometry::{Geometry, dot, minus},
    picture::Picture,
    section::Section,
};

/// Coverage falls from 1 to 0 between these distances [pixels].
const LINE: [f64; 2] = [0.4, 1.2];

/// Part of a line in a pixel: how much of the pixel, and in which colour.
struct Mark {
    at: u32,
    cover: f32,
    color: [f32; 3],
}

/// Where lines are: memory and time go with their length, not with the picture.
struct Ink {
    width: usize,
    height: usize,
    marks: Vec<Mark>,
}

impl Ink {
    fn put(&mut self, x: usize, y: usize, distance: f64, color: [f32; 3]) {
        let cover = ((LINE[1] - distance) / (LINE[1] - LINE[0])).clamp(0.0, 1.0) as f32;
        if cover > 0.0 {
            self.marks.push(Mark { at: (y * self.width + x) as u32, cover, color });
        }
    }

    /// Pixels within a box [pixels], a line's width more on every side.
    fn within(&self, low: [f64; 2], high: [f64; 2]) -> [std::ops::Range<usize>; 2] {
        let limit = [self.width, self.height];
        [0, 1].map(|c| {
            let first = (low[c] - LINE[1]).ceil().clamp(0.0, limit[c] as f64) as usize;
            let end = ((high[c] + LINE[1]).floor() + 1.0).clamp(0.0, limit[c] as f64) as usize;
            first..end.max(first)
        })
    }

    fn line(&mut self, a: [f64; 2], b: [f64; 2], color: [f32; 3]) {
        let [xs, ys] = self.within([a[0].min(b[0]), a[1].min(b[1])], [a[0].max(b[0]), a[1].max(b[1])]);
        let along = [b[0] - a[0], b[1] - a[1]];
        let square = (along[0] * along[0] + along[1] * along[1]).max(f64::MIN_POSITIVE);
        for y in ys {
            for x in xs.clone() {
                let from = [x as f64 - a[0], y as f64 - a[1]];
                let t = ((from[0] * along[0] + from[1] * along[1]) / square).clamp(0.0, 1.0);
                let distance = (from[0] - t * along[0]).hypot(from[1] - t * along[1]);
                self.put(x, y, distance, color);
            }
        }
    }
}

/// Draws outlines over a section; the geometry must have been checked.
pub(crate) fn outlines(geometry: &Geometry<'_>, section: &Section, picture: &mut Picture) {
    let (width, height) = (picture.width, picture.height);
    let [right, down] = section.plane.axes();
    let normal = crate::geometry::cross(right, down);
    // pixel coordinates and height above the plane [mm]
    let place = |p: [f64; 3]| {
        let from = minus(p, section.center);
        let pixel = |axis: [f64; 3], n: usize| dot(from, axis) / section.mm_per_pixel + (n as f64 - 1.0) / 2.0;
        ([pixel(right, width), pixel(down, height)], dot(from, normal))
    };
    let mut ink = Ink { width, height, marks: Vec::new() };
    for mesh in geometry.meshes {
        let placed: Vec<([f64; 2], f64)> = mesh.positions.iter().map(|p| place(p.map(f64::from))).collect();
        for t in mesh.triangles {
            let corners = t.map(|v| placed[v as usize]);
            // a corner in the plane counts as above it: a line is then drawn once
            let above = corners.map(|c| c.1 >= 0.0);
            if above[0] == above[1] && above[1] == above[2] {
                continue;
            }
            let mut ends = [[0.0; 2]; 2];
            let mut n = 0;
            for (a, b) in [(0, 1), (1, 2), (2, 0)] {
                if above[a] != above[b] && n < 2 {
                    let ((p, s), (q, t)) = (corners[a], corners[b]);
                    let share = s / (s - t);
                    ends[n] = std::array::from_fn(|c| p[c] + (q[c] - p[c]) * share);
                    n += 1;
                }
            }
            ink.line(ends[0], ends[1], mesh.color);
        }
    }
    for capsule in geometry.capsules {
        let ends = [place(capsule.a), place(capsule.b)];
        if ends.iter().all(|e| e.1 > capsule.radius) || ends.iter().all(|e| e.1 < -capsule.radius) {
            continue;
        }
        let radius = capsule.radius / section.mm_per_pixel;
        let low = [0, 1].map(|c| ends[0].0[c].min(ends[1].0[c]) - radius);
        let high = [0, 1].map(|c| ends[0].0[c].max(ends[1].0[c]) + radius);
        let [xs, ys] = ink.within(low, high);
        for y in ys {
            for x in xs.clone() {
                let at = |dx: f64, dy: f64| capsule.distance(section.position(x as f64 + dx, y as f64 + dy, width, height));
                let distance = at(0.0, 0.0);
                let slope = (at(0.5, 0.0) - at(-0.5, 0.0)).hypot(at(0.0, 0.5) - at(0.0, -0.5));
                ink.put(x, y, distance.abs() / slope.max(0.05 * section.mm_per_pixel), capsule.color);
            }
        }
    }
    // of those that cover a pixel alike the first, as they were drawn
    ink.marks.sort_by(|a, b| a.at.cmp(&b.at).then(b.cover.total_cmp(&a.cover)));
    ink.marks.dedup_by_key(|mark| mark.at);
    for Mark { at, cover, color } in ink.marks {
        for (byte, c) in picture.rgb[3 * at as usize..][..3].iter_mut().zip(color) {
            *byte = (f32::from(*byte) + (255.0 * c - f32::from(*byte)) * cover + 0.5) as u8;
        }
    }
}
