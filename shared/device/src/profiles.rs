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

/// 3D Systems Phantom Premium 1.5 6DOF, with torque: its weakest axis's. Damping and friction as the Touch's, which is cautious.
pub const PREMIUM: DeviceProfile =
    DeviceProfile { name: "Premium 6DOF", max_force_n: 8.5, max_torque_n_mm: 170.0, quantum_mm: 0.03, mass_kg: 0.09, ..TOUCH };

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

/// Force Dimension delta.3.
pub const DELTA: DeviceProfile = DeviceProfile { name: "delta.3", max_force_n: 20.0, mass_kg: 0.2, workspace_mm: 150.0, ..OMEGA };

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

/// All profiles, for scenes that name one.
pub const ALL: [DeviceProfile; 6] = [TOUCH, PREMIUM, OMEGA, DELTA, SIGMA, INVERSE3];

/// The profile of this name.
pub fn named(name: &str) -> Option<DeviceProfile> {
    ALL.into_iter().find(|profile| profile.name.eq_ignore_ascii_case(name))
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_contact::HapticConfig;

    /// Every profile gives a configuration that its device renders passively, whatever stiffness a scene asks for.
    #[test]
    fn every_profile_makes_a_passive_configuration() {
        for profile in ALL {
            let (config, _) = HapticConfig::on_device(2.0, 100.0, 5e-4, 1e-3, &profile).unwrap();
            let (k, b) = (config.coupling.stiffness_n_per_mm(), config.coupling.damping_n_s_per_mm());
            assert!(profile.damping_n_s_per_mm > k * (0.5e-3 + profile.delay_s) + b, "{}", profile.name);
            assert!(k > 0.2 && k <= profile.max_stiffness_n_per_mm && config.passivity, "{}: {k} N/mm", profile.name);
            assert_eq!(config.limits.max_force_n, profile.max_force_n);
            assert_eq!(named(&profile.name.to_uppercase()), Some(profile));
        }
        assert_eq!(named("mouse"), None);
    }
}
