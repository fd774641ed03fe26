//! Why fields or models were refused.

use thiserror::Error;

/// Why fields or models were refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum MotionError {
    /// no field, or fields that do not lie on one grid of two nodes or more an axis
    #[error("a motion needs at least {needed} fields, all on one grid of two nodes or more an axis; {given} were given")]
    Fields {
        /// how many there should be
        needed: usize,
        /// how many came, or how many fit
        given: usize,
    },
    /// a vector that is not finite, or too long for its precision
    #[error("field {field}: the vector at node {node} is not finite, or too long to be stored")]
    Vector {
        /// which field
        field: usize,
        /// which node
        node: usize,
    },
    /// places of key frames or values of signals that cannot be used
    #[error("{0}")]
    Places(String),
    /// bytes that are no model
    #[error("these bytes are no motion model: {0}")]
    Bytes(String),
}
