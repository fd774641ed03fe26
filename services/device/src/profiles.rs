//! What devices can do. Forces, stiffness, damping and workspaces of Touch and Force Dimension are those that CHAI3D's drivers
//! declare; masses, friction and encoder steps are of the devices' class (data sheets vary) and on the safe side.
//! The Inverse3's are not measured here: a cautious guess, to be replaced by whoever has one.

use maille_contact::DeviceProfile;

/// 3D Systems Touch (Phantom Omni).
pub const TOUCH: DeviceProfile = DeviceProfile {
    name: "Touch",
    max_force_n: 3.3,
    max_torque_n_mm: 0.0,
    max_stiffness_n_per_mm: 0.4,
    damping_n_s_per_mm: 0.004,
    coulomb_n: 0.2,
    quantum_mm: 0.055,
    mass_kg: 0.045,
    // a pose waits up to a period for the tick, and the force up to one for the device
    delay_s: 0.002,
    workspace_mm: 75.0,
};

/// Force Dimension omega.3, the smallest forces of its family.
pub const OMEGA: DeviceProfile = DeviceProfile {
    name: "omega",
    max_force_n: 12.0,
    max_torque_n_mm: 0.0,
    max_stiffness_n_per_mm: 5.0,
    damping_n_s_per_mm: 0.03,
    coulomb_n: 0.1,
    quantum_mm: 0.01,
    mass_kg: 0.1,
    delay_s: 0.002,
    workspace_mm: 75.0,
};

/// Force Dimension sigma.7, with torque.
pub const SIGMA: DeviceProfile =
    DeviceProfile { name: "sigma.7", max_torque_n_mm: 200.0, max_stiffness_n_per_mm: 4.0, mass_kg: 0.2, ..OMEGA };

/// Haply Inverse3.
pub const INVERSE3: DeviceProfile = DeviceProfile {
    name: "Inverse3",
    max_force_n: 3.0,
    max_torque_n_mm: 0.0,
    max_stiffness_n_per_mm: 1.0,
    damping_n_s_per_mm: 0.002,
    coulomb_n: 0.02,
    quantum_mm: 0.05,
    mass_kg: 0.08,
    // as the others, and a service and a socket between
    delay_s: 0.003,
    workspace_mm: 75.0,
};
