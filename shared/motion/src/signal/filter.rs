//! Causal low-pass of second order (Butterworth) that gives the filtered value and its exact derivative.
//!
//! y″ = ω²(x − y) − √2·ω·y′ with x linear between samples, solved exactly: no step size to choose, any spacing of samples.
//! Both y and y′ are states, so that y′ is the derivative of y and not a difference of noisy values; y′ is continuous whatever x does.
//! A slow signal comes late by √2/ω (0.15 s at 1.5 Hz).

/// Value and derivative behind the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LowPass {
    /// ω [rad/s]
    omega: f64,
    /// y
    pub value: f64,
    /// y′ [1/s]
    pub rate: f64,
}

impl LowPass {
    /// At rest at a value; `cutoff_hz` is where half the power passes.
    pub fn new(cutoff_hz: f64, value: f64) -> Self {
        Self { omega: std::f64::consts::TAU * cutoff_hz.max(1e-3), value, rate: 0.0 }
    }

    /// How late a slow signal comes [s].
    pub fn delay_s(&self) -> f64 {
        std::f64::consts::SQRT_2 / self.omega
    }

    /// Goes on by `dt` while the input moves linearly from `from` to `to`.
    pub fn advance(&mut self, from: f64, to: f64, dt: f64) {
        if dt <= 0.0 {
            return;
        }
        // particular solution of a linear input: it follows, late by the delay
        let slope = (to - from) / dt;
        let lag = slope * self.delay_s();
        // the rest decays: e = exp(−st)(a cos st + b sin st), s = ω/√2
        let s = self.omega * std::f64::consts::FRAC_1_SQRT_2;
        let a = self.value - (from - lag);
        let b = (self.rate - slope) / s + a;
        let (sin, cos) = (s * dt).sin_cos();
        let fade = (-s * dt).exp();
        self.value = to - lag + fade * (a * cos + b * sin);
        self.rate = slope + fade * s * ((b - a) * cos - (a + b) * sin);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_for_any_step_and_the_rate_is_the_derivative() {
        let mut whole = LowPass::new(1.5, 0.3);
        whole.rate = -0.4;
        let mut parts = whole;
        whole.advance(1.0, 3.0, 0.5);
        for n in 0..50 {
            let at = |n: i32| 1.0 + 2.0 * f64::from(n) / 50.0;
            let before = parts;
            parts.advance(at(n), at(n + 1), 0.01);
            let mut middle = before;
            middle.advance(at(n), 0.5 * (at(n) + at(n + 1)), 0.005);
            assert!(((parts.value - before.value) / 0.01 - middle.rate).abs() < 1e-2);
        }
        assert!((whole.value - parts.value).abs() < 1e-12 && (whole.rate - parts.rate).abs() < 1e-11);
        // a constant is reached
        whole.advance(2.0, 2.0, 10.0);
        assert!((whole.value - 2.0).abs() < 1e-12 && whole.rate.abs() < 1e-12);
    }
}
