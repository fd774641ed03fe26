//! Fewer triangles: quadric edge collapse [Garland & Heckbert 1997] with probabilistic quadrics [Trettner & Kobbelt 2020], by the `alum` crate.
//!
//! Collapses that would change the topology are refused there, so that a closed manifold stays one of its genus. Normals are taken anew
//! from the triangles. Smoothing is no step of its own: the window of the continuous function that the mesh is made from smooths
//! before there are triangles, and knows where the voxels were.
//!
//! Cost: some 3 µs a triangle, one thread. Not here: levels of detail.

use crate::Mesh;
use alum::{Adaptor, F64Adaptor, Handle, HasDecimation, HasIterators, HasTopology, PolyMeshF64, QuadricDecimater, QuadricType};

/// Why a mesh cannot be thinned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the mesh cannot be thinned: {reason}; write it whole")]
pub struct DecimateError {
    /// what the library says
    pub reason: String,
}

impl From<alum::Error> for DecimateError {
    fn from(error: alum::Error) -> Self {
        Self { reason: format!("{error:?}") }
    }
}

/// The mesh with about `triangles` triangles; itself if it has no more.
///
/// # Errors
/// When an edge has more than two triangles, as it may in a mesh that was read from elsewhere.
pub fn decimate(mesh: &Mesh, triangles: usize) -> Result<Mesh, DecimateError> {
    if mesh.triangles.len() <= triangles {
        return Ok(mesh.clone());
    }
    let mut half_edges = PolyMeshF64::with_capacity(mesh.positions.len(), mesh.triangles.len() * 3 / 2, mesh.triangles.len());
    // about the middle of the mesh, so that quadrics lose no digits far from the origin
    let count = mesh.positions.len() as f64;
    let middle: [f64; 3] = std::array::from_fn(|c| mesh.positions.iter().map(|p| f64::from(p[c])).sum::<f64>() / count);
    let points: Vec<_> = mesh.positions.iter().map(|p| F64Adaptor::vector(std::array::from_fn(|c| f64::from(p[c]) - middle[c]))).collect();
    let vertices: Vec<_> = half_edges.add_vertices(&points)?.collect();
    for t in &mesh.triangles {
        let [a, b, c] = t.map(|v| vertices[v as usize]);
        half_edges.add_tri_face(a, b, c)?;
    }
    let mut decimater = QuadricDecimater::new(&half_edges, QuadricType::ProbabilisticTriangle)?;
    half_edges.decimate_to_face_count(&mut decimater, triangles)?;
    half_edges.garbage_collection()?;
    let normals = half_edges.update_vertex_normals_accurate()?;
    let (normals, points) = (normals.try_borrow()?, half_edges.points());
    let points = points.try_borrow()?;
    let mut out = Mesh::default();
    for v in half_edges.vertices() {
        out.positions.push(std::array::from_fn(|c| (F64Adaptor::vector_coord(&points[v], c) + middle[c]) as f32));
        out.normals.push(std::array::from_fn(|c| F64Adaptor::vector_coord(&normals[v], c) as f32));
    }
    for f in half_edges.faces() {
        let mut corners = half_edges.fv_ccw_iter(f).map(|v| v.index());
        out.triangles.push(std::array::from_fn(|_| corners.next().expect("a triangle has three corners")));
    }
    Ok(out)
}
