//! Rays through a displacement field: where a point of world space lies in the patient at rest.
//!
//! x = X + u(X), u = Σ c_k B_k the [`Motion`] of one moment; a ray stands at x and needs X = x + v(x). Per frame [`Warp::update`]
//! inverts u on a coarse lattice of its own by the project's one inversion kernel, from the last frame's answer. Rays read v at
//! the nodes of a lattice that follows the picture's own rays (`view`), as parabolas from plane to plane (`tile`, `bend`).
//!
//! Error [mm], computed per frame ([`WarpReport`]): at the middle of every cell of the patient's lattice, where interpolation is worst,
//! X = x + v is put into u, and |x − X − u(X)| / (1 − q) bounds its distance from the true X if u contracts by q. What the picture's
//! lattice adds is told by [`Warp::view_error_mm`].
//!
//! Where lattices err by more than is allowed, a field's kinks and sliding organs, samples are found one by one in the field itself (`rough`, `exact`).
//!
//! Empty space stays in rest space: how fast a ray goes there, forwards and backwards along each axis, is bounded for the picture. So the map of
//! the unwarped volume holds, nothing of it is made anew, and rays jump nearly as far as straight ones (`Bend::way_out`).
//!
//! Frames: positions and displacements inside are continuous indices of the volume; millimetres at the border.
//! References, to be compared with: the paper's own scheme ([`Moment::along`]; drawn: [`crate::WarpScheme`]), and the volume [`resampled`]. Not here: where fields come from.

mod bend;
mod exact;
mod field;
mod lattice;
mod led;
pub mod pitch;
mod reference;
mod rough;
mod settle;
mod tile;
mod view;

pub(crate) use bend::Bend;
pub use exact::Exact;
pub(crate) use exact::{FOLDED, LOOKS, SHORTEST};
pub use field::{Moment, Motion, WarpError};
pub use lattice::{Warp, WarpOptions, WarpReport};
pub(crate) use led::Led;
pub use reference::resampled;
pub(crate) use tile::Tile;
pub(crate) use view::{Hull, View};
