//! A triangle mesh with shared vertices.

/// Triangles over shared vertices, in patient space.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// vertices [mm, LPS]
    pub positions: Vec<[f32; 3]>,
    /// unit normals at the vertices, pointing out of the bright side
    pub normals: Vec<[f32; 3]>,
    /// vertex numbers, counter-clockwise seen from outside
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Area [mm²], summed in order.
    pub fn area(&self) -> f64 {
        self.triangles.iter().map(|t| 0.5 * norm(self.doubled_area_vector(t))).sum()
    }

    /// Enclosed volume [mm³] by the divergence theorem; a meaning only for a closed mesh.
    pub fn volume(&self) -> f64 {
        self.triangles
            .iter()
            .map(|t| {
                let p = self.corner(t[0]);
                let n = self.doubled_area_vector(t);
                (p[0] * n[0] + p[1] * n[1] + p[2] * n[2]) / 6.0
            })
            .sum()
    }

    /// (b − a) × (c − a) of a triangle [mm²].
    pub(crate) fn doubled_area_vector(&self, t: &[u32; 3]) -> [f64; 3] {
        let [a, b, c] = t.map(|v| self.corner(v));
        let (u, v): ([f64; 3], [f64; 3]) = (std::array::from_fn(|n| b[n] - a[n]), std::array::from_fn(|n| c[n] - a[n]));
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    }

    fn corner(&self, vertex: u32) -> [f64; 3] {
        self.positions[vertex as usize].map(f64::from)
    }
}

pub(crate) fn norm(v: [f64; 3]) -> f64 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}
