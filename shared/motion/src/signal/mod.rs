//! Breathing signals: recorded, made up, live; and the functions τ of the key-frame models.
//!
//! A recording goes text → [`Trace`] (what was measured, without what was not) → [`Recorded`] (resampled, filtered, looped).
//! [`Synthetic`] draws breaths that vary as those of a recording; [`Live`] follows a slider or holds another signal's breath.
//! Files are read by whoever calls: parsers take the text and the name that errors should show.

mod axis;
mod csv;
mod cycles;
mod filter;
mod live;
mod random;
mod recorded;
mod synthetic;
mod tau;
mod trace;
mod vxp;

pub use csv::CsvOptions;
pub use cycles::{Cycle, find_cycles};
pub use filter::LowPass;
pub use live::{Ease, Live, LiveState};
pub use recorded::{Conditioning, Recorded, RecordedReport};
pub use synthetic::{BreathStatistics, Spread, Synthetic};
pub use tau::{Tau, TauKind};
pub use trace::{SignalError, Trace};
