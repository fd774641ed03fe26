//! Touch in tissue that moves by itself: the core works where tissue is at rest, and is told what the motion does to the tool.
//!
//! The caller carries the pose to the patient at rest (X with x = X + u(X, t)), lets the core tick there, and turns force and torque back by the
//! rotation R of the motion at X. Then contact, friction and damping are those of the tool against the tissue under it: an anchor of
//! friction sticks to the tissue, damping is by relative velocity, and a commit is seen where it was made. Two things cannot be had from X alone:
//!
//! - balls of one tool are rigid in the world, not at rest: each is placed by its own inverse;
//! - the device's port is in the world: its energy is counted along Rᵀdx, and the work of the tissue's own motion, F·Rᵀu̇ dt, which no hand put
//!   in, is granted to the passivity controller within its credit (`passivity`).
//!
//! What is neglected: the stretch in the gradient. A depth in stretched tissue is a few percent of another in the world.

/// What the motion does to the tool in this tick. All in the frame of tissue at rest [mm].
pub trait MovingTissue {
    /// From the tip's centre to the centre of a ball that is `arm_mm` from it where nothing stretches.
    fn place(&mut self, arm_mm: [f64; 3]) -> [f64; 3];
    /// Where the device's port is: any origin, its steps Rᵀdx.
    fn port_mm(&self) -> [f64; 3];
    /// How far the tissue under the tip moved by itself since the last tick, Rᵀ·du.
    fn moved_mm(&self) -> [f64; 3];
}
