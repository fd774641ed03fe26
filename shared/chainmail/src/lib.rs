//! ChainMail on voxels: link limits, propagation, and what a push changes.
//!
//! Every voxel is an element, linked to its six neighbours. With cubic regions [Dräger 2005, 3.2] each component of the
//! displacement u stands alone and a link between neighbours p, q along an axis of spacing s demands
//!
//! |u_c(p) − u_c(q)| ≤ w(p, q) = ½ (o_p + o_q) · s          half a link lies in each voxel
//!
//! with o the chain region's offset, `o_eff = offset · (1 − (v/4096)²)`, v = clamp(HU + 1000, 0, 4095), where density
//! scaling is on [3.6.2]. That is a system of difference constraints: its solutions are closed under pointwise minimum and
//! maximum, and with d the shortest path over the w, pins p with targets t_p,
//!
//! u′(x) = min( max( u(x), max_p (t_p − d(x, p)) ), min_p (t_p + d(x, p)) )
//!
//! satisfies every link and moves no element further than it must: raise from the pins, then lower from the pins.
//!
//! Fixed: bone (HU ≥ `bone_hu`) and the virtual elements one step beyond the border have u = 0 and block. The virtual element has
//! the offset of its inner neighbour, so that this link is a whole one, w = o · s. Bone has an offset like any other
//! voxel in the limit of its links; its fixity is a bound on u, not a limit of links (a limit of 0 would freeze the first
//! layer of tissue around it). A movement limit is a bound |u_c| ≤ m = `movement_limit · (1 − (v/4096)²)`, by component as
//! the chain regions are. The admissible part of a push is its clamp to ±M, M(x) = min_y (m(y) + d(x, y)) with m = 0 on
//! bone, found only where the push reaches ([`Admission`] says whether by component or along the push).
//!
//! Links may differ by axis and direction, run through tissue only, close voids and open cuts: the `links` module and [`LinkModel`]. They may
//! change while tissue is deformed: [`ChainMail::repair`]. In idle time tissue goes back towards rest: [`ChainMail::relax_elastic`]. What
//! the thesis and its forerunners do instead is in [`reference`](mod@reference).
//!
//! Units and frame: u in mm *along the grid's axes* (not LPS); `maille_displacement::in_patient` rotates. `f32`.
//! Invariants: after every push all links hold up to rounding (a few ulp of |u|), bone has u = 0 bit for bit, |u_c| ≤ m. Subtraction of
//! floats is monotone, so the result is the same bits whatever the order of propagation.
//! Cost: in proportion to the moved elements, in bricks on demand. Not here: voxels ([`maille_mapper`] rewrites them).
//!
//! [`maille_mapper`]: https://docs.rs/maille-mapper

#![forbid(unsafe_code)]

mod brick;
mod by_element;
mod consistent;
mod cut;
mod elements;
mod from_rest;
mod graph;
mod intersection;
mod links;
mod mail;
mod propagate;
mod push;
pub mod reference;
mod region;
mod relax;
mod relaxation;
mod repair;
mod state;
mod sweep;
mod tile;
mod tissue;

pub use brick::{DisplacementBrick, ELEMENTS};
pub use cut::{Triangle, swept_blade};
pub use elements::{elements_in_capsule, elements_in_sphere, enclosing_elements};
pub use intersection::intersection_search;
pub use links::{AxisLimits, CUT, Gaps, LinkModel, Metric, Slender};
pub use mail::{ChainMail, Motion, Pin, PushOutcome};
pub use region::{ChangedBrick, ChangedRegion};
pub use relaxation::{Capsule, PlasticBand, RelaxOptions, Relaxed};
pub use tissue::{Admission, ElementLimits, Tissue, link_limit};
