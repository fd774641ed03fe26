//! Breathing from the page: hold the breath, lead it by the slider, let it go on.
//!
//! Processes know two commands, so the next one is given only when the last one holds; what a page says meanwhile is kept, the newest only. A breath that is
//! held stays held when the page leaves: it is the patient's, not a hand's.

use crate::{feed::Feed, protocol::BreathRequest};
use maille_breathing::Signal;
use maille_contract::Stamp;
use maille_motion::Breathing as _;
use serde::Serialize;

/// Levels that the slider may ask for: a little beyond the usual ends.
pub const LEVELS: [f64; 2] = [-0.3, 1.3];

/// How the patient breathes, as the page shows it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Breath {
    /// 0 end of expiration, 1 end of inspiration
    pub level: f64,
    /// \[1/s\]
    pub rate: f64,
    /// place in the cycle: 0 end of inspiration, ½ end of expiration
    pub phase: f64,
    /// the breath is held
    pub held: bool,
    /// the slider leads
    pub led: bool,
}

/// What the pages want and have not got yet.
#[derive(Default)]
pub(crate) struct Desk {
    wanted: Option<BreathRequest>,
    sequence: u64,
}

impl Desk {
    /// Takes a request; false when it makes no sense, or nobody breathes here.
    pub fn ask(&mut self, request: BreathRequest, breathes: bool) -> bool {
        let sound = breathes && request.level.is_none_or(|level| (LEVELS[0]..=LEVELS[1]).contains(&level));
        if sound {
            self.wanted = Some(request);
        }
        sound
    }

    /// Gives the next command if one is wanted and the last one holds.
    pub fn serve(&mut self, feed: &mut impl Feed) {
        let Some(BreathRequest { held, level }) = self.wanted else { return };
        let stamp = Stamp { time_ns: feed.time_ns(), sequence: self.sequence + 1, incarnation: feed.incarnation() };
        let Some(signal) = feed.breath() else { return };
        let Some(state) = signal.command(stamp, held, level) else { return };
        signal.adopt(state);
        feed.send_breath(&state);
        (self.wanted, self.sequence) = (None, stamp.sequence);
    }
}

/// How a signal stands at a time.
pub(crate) fn seen(signal: &Signal, time_ns: u64) -> Breath {
    let (now, state) = (signal.at(time_ns), signal.state());
    Breath { level: now.level, rate: now.rate, phase: now.phase, held: state.held == 1, led: state.led == 1 }
}
