//! Rays through a displacement field: where a point of world space lies in the patient at rest.
//!
//! x = X + u(X), u = Σ c_k B_k the [`Motion`] of one moment; a ray stands at x and needs X = x + v(x). Per frame [`Warp::update`]
//! inverts u on a coarse lattice of its own by the project's one inversion kernel, from the last frame's answer. Rays read v at
//! knots, as far apart as v is straight, and go straight between them.
//!
//! Error [mm], computed per frame ([`WarpReport`]): at the middle of every cell of the lattice, where interpolation is worst,
//! X = x + v is put into u, and |x − X − u(X)| / (1 − q) bounds its distance from the true X if u contracts by q. Between
//! knots R apart it is R²/8 times the second derivative of v, whose largest value in each block of the lattice sets R.
//!
//! Empty space stays in rest space: between knots the ray is straight there too, so the map of the unwarped volume is exact and
//! nothing of it is made anew; beyond the next knot a bound on how fast X may move along the ray (from the lattice's largest
//! slopes) says how far a ray may jump.
//!
//! Frames: positions and displacements inside are continuous indices of the volume; millimetres at the border.
//! References: [`Reference`]. Not here: where fields come from.

mod bend;
mod field;
mod lattice;

pub(crate) use bend::Bend;
pub use field::{Moment, Motion, WarpError};
pub use lattice::{Warp, WarpOptions, WarpReport};
