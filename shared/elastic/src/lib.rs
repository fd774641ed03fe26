//! Linear elasticity on a voxel grid: the truth that ChainMail is measured against. For tests and reports only; nothing that
//! runs beside a patient depends on this crate.
//!
//! Find u with ∫ ε(v) : C(E, ν) : ε(u) = f·v for all v, u given on a Dirichlet set: small strains, isotropic, one Young's modulus a
//! cell, one Poisson's ratio. Discretised by trilinear hexahedra whose nodes are the voxel centres, integrated by 2 × 2 × 2 Gauss
//! points [Hughes, The Finite Element Method, chapters 3 and 4]. All cells have one shape, so their stiffness matrices are one
//! 24 × 24 matrix times E: the operator is applied cell by cell and never assembled. Solved by conjugate gradients with
//! the diagonal as preconditioner [Hestenes & Stiefel 1952].
//!
//! Units: mm, N, N/mm² (only ratios of E matter when all loads are displacements). Frame: the grid's axes. f64 throughout.
//! Invariants: the operator is symmetric, rigid motions without rotation cost no energy, a linear displacement is reproduced exactly
//! (patch test); the result does not depend on the number of threads. Cost: 576 multiply-adds a cell and iteration, 120 bytes a
//! node; iterations grow with the number of cells along an edge and with the root of the ratio of stiffness.
//! Not here: large strains, nearly incompressible tissue (ν → ½ locks trilinear cells), contact that decides where it touches.

#![forbid(unsafe_code)]

mod block;
mod cell;
pub mod closed;
pub mod indentation;
mod solve;

pub use block::{Block, Fault};
pub use solve::{Boundary, Solution, Stopping, solve};
