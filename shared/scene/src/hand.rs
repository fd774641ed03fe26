//! The simulated hand of device `"sim"`, and the device that it holds: how it grips and trembles, how coarse and late its poses are.
//!
//! m a = k (x_hand − x) − b v + F, as `maille_contact::SimulatedHand` has it.

use serde::{Deserialize, Serialize};

/// Hands of operators, as the passivity and stability tests have them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum GripKind {
    /// a full grip: 0.5 N/mm, 0.01 N·s/mm, 0.25 kg
    Full,
    /// two fingers, loosely: 0.05 N/mm, 0.001 N·s/mm, 0.1 kg
    Light,
}

/// `[tool.hand]`. Numbers that are given count before those of the grip.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Hand {
    /// `"full"` or `"light"`; without: 0.6 N/mm, 0.01 N·s/mm, 0.1 kg
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grip: Option<GripKind>,
    /// grip [N/mm], 0.01 to 10
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffness_n_per_mm: Option<f64>,
    /// damping [N·s/mm], 0 to 1
    #[serde(skip_serializing_if = "Option::is_none")]
    pub damping_n_s_per_mm: Option<f64>,
    /// moving mass of hand and handle [kg], 0.01 to 5
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mass_kg: Option<f64>,
    /// amplitude of its tremor along the tool and across [mm], 0 to 2
    pub tremor_mm: f64,
    /// frequency of its tremor [Hz], 1 to 20
    pub tremor_hz: f64,
    /// encoder step of the device [mm], 0 to 1
    pub encoder_mm: f64,
    /// how late the device's poses are [ms], 0 to 30; whole ticks count
    pub delay_ms: f64,
    /// Coulomb friction of the device [N], 0 to 2
    pub coulomb_n: f64,
}

impl Default for Hand {
    fn default() -> Self {
        Self {
            grip: None,
            stiffness_n_per_mm: None,
            damping_n_s_per_mm: None,
            mass_kg: None,
            tremor_mm: 0.0,
            tremor_hz: 9.0,
            encoder_mm: 0.0,
            delay_ms: 0.0,
            coulomb_n: 0.0,
        }
    }
}

impl Hand {
    /// Stiffness [N/mm], damping [N·s/mm] and mass [kg]: those given, the others of the grip.
    pub fn mechanics(&self) -> [f64; 3] {
        let usual = match self.grip {
            None => [0.6, 0.01, 0.1],
            Some(GripKind::Full) => [0.5, 0.01, 0.25],
            Some(GripKind::Light) => [0.05, 0.001, 0.1],
        };
        let given = [self.stiffness_n_per_mm, self.damping_n_s_per_mm, self.mass_kg];
        std::array::from_fn(|n| given[n].unwrap_or(usual[n]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_count_before_those_of_the_grip() {
        assert_eq!(Hand::default().mechanics(), [0.6, 0.01, 0.1]);
        let light = Hand { grip: Some(GripKind::Light), mass_kg: Some(0.3), ..Hand::default() };
        assert_eq!(light.mechanics(), [0.05, 0.001, 0.3]);
    }
}
