//! Registration of the phases of a 4D CT to its reference phase: where each point of the reference has gone.
//!
//! Finds u with phase(X + u(X)) ≈ reference(X). Demons [Thirion 1998] with the symmetric force of both images [Vercauteren 2009], coarse to fine:
//!   d = R − P∘(1 + u), J = ½(∇R + ∇(P∘(1 + u))), u ← S(u + d·J/(|J|² + d²/κ²)), steps of at most κ/2,
//! S a Gaussian. With a mask, S lets organs slide along its border [Schmidt-Richberg et al. 2012]: near it the part of u along the normal is
//! smoothed across, the part along the border within each side only, S(u) = nnᵀG(u) + (1 − nnᵀ)G_side(u). Bone is stiffened by a wide Gaussian over
//! bone alone, and a bone that touches no other (3 to 40 ml) moves as its rigid part. Cells that would fold are smoothed until they do not, such bones last.
//!
//! Units: HU, mm; vectors are worked along the grid's axes and given in LPS mm. Cost: about 40 ns a voxel and iteration on the finest level.
//! Not here: fields of other tools (they are read as they are), files, landmarks.

mod demons;
mod mask;
mod pyramid;

pub use demons::{Anatomy, RegisterOptions, register};
pub use mask::{bone_mask, bone_pieces, lung_mask};
