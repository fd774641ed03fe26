//! What cannot be built.

/// Why a needle, a rod or a tissue table was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NeedleError {
    /// a number out of range
    #[error("{name} is {value}; it must be {expected}")]
    OutOfRange {
        /// what it is, as the scene calls it
        name: &'static str,
        /// what was given
        value: f64,
        /// what would do
        expected: &'static str,
    },
    /// a gauge without a standard size
    #[error("there is no needle of gauge {0}; gauges 14 to 25 are known, or give diameters")]
    UnknownGauge(u32),
}

/// `value` where `holds`, else the reason.
pub(crate) fn check(name: &'static str, value: f64, expected: &'static str, holds: bool) -> Result<f64, NeedleError> {
    if holds && value.is_finite() { Ok(value) } else { Err(NeedleError::OutOfRange { name, value, expected }) }
}
