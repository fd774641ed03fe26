//! The state of breathing in a running scene: what the scene says, led by what the page says.

use crate::{BreathingError, EFFECT};
use maille_contract::{
    BreathLead, BreathState, ControlBlock, Stamp,
    breath::{BREATH_AHEAD_NS, TRACE_KIND, TRACE_REGION},
};
use maille_motion::signal::{
    BreathStatistics, Conditioning, CsvOptions, Ease, Live, LiveState, Recorded, RecordedReport, Synthetic, Trace,
};
use maille_motion::{Bounded, Breath, Breathing};
use maille_scene::{Scene, breathing};
use maille_store::Region;
use maille_transport::Domain;

/// What breathes by itself.
enum Base {
    Synthetic(Box<Synthetic>),
    Recorded(Box<Recorded>),
    Still,
}

impl Breathing for Base {
    fn at(&self, time_ns: u64) -> Breath {
        match self {
            Self::Synthetic(signal) => signal.at(time_ns),
            Self::Recorded(signal) => signal.at(time_ns),
            Self::Still => Breath::EXPIRED,
        }
    }
}

/// A signal of another depth.
struct Scaled<B>(B, f64);

impl<B: Breathing> Breathing for Scaled<B> {
    fn at(&self, time_ns: u64) -> Breath {
        let breath = self.0.at(time_ns);
        Breath { level: breath.level * self.1, rate: breath.rate * self.1, ..breath }
    }
}

/// A signal and who leads it.
pub struct Signal {
    live: Live<Bounded<Scaled<Base>>>,
    state: BreathState,
    seen: u64,
    recorded: Option<RecordedReport>,
}

impl Signal {
    /// The signal that a scene asks for, with the text of its trace where it plays one. The same arguments give the same signal, bit by bit.
    ///
    /// # Errors
    /// When the trace cannot be played.
    pub fn new(scene: &breathing::Breathing, trace: Option<&str>) -> Result<Self, BreathingError> {
        let base = match (&scene.signal, trace) {
            (maille_scene::Signal::Synthetic, _) => {
                let mut usual = BreathStatistics::default();
                let parts = [&mut usual.inspiration_s, &mut usual.expiration_s, &mut usual.pause_s];
                let whole: f64 = parts.iter().map(|p| p.median).sum();
                for part in parts {
                    part.median *= scene.period_s / whole;
                }
                Base::Synthetic(Box::new(Synthetic::new(&usual, scene.seed)))
            }
            (maille_scene::Signal::Console, _) => Base::Still,
            (maille_scene::Signal::Recorded(file), Some(text)) => {
                let options = CsvOptions { value_column: scene.column.clone(), ..CsvOptions::default() };
                let trace = Trace::from_text(text, &file.display().to_string(), &options)?;
                Base::Recorded(Box::new(Recorded::new(&trace, &Conditioning { cutoff_hz: scene.cutoff_hz, flip: scene.flip })?))
            }
            (maille_scene::Signal::Recorded(file), None) => {
                return Err(BreathingError::Scene(format!("the trace {} was not brought along", file.display())));
            }
        };
        let recorded = match &base {
            Base::Recorded(signal) => Some(*signal.report()),
            _ => None,
        };
        let untouched = lead_of(&LiveState::untouched());
        Ok(Self {
            live: Live::new(Bounded(Scaled(base, scene.depth))),
            state: BreathState { stamp: Stamp::default(), leads: [untouched; 2], held: 0, led: 0 },
            seen: 0,
            recorded,
        })
    }

    /// What was made of the recording that it plays; `None` where it plays none.
    pub fn recorded(&self) -> Option<&RecordedReport> {
        self.recorded.as_ref()
    }

    /// The signal of a running scene; `None` when it does not breathe.
    ///
    /// # Errors
    /// When its trace is not there or cannot be played.
    pub fn open(domain: &Domain, scene: &Scene) -> Result<Option<Self>, BreathingError> {
        if !scene.has_effect(EFFECT) {
            return Ok(None);
        }
        if !matches!(scene.breathing.signal, maille_scene::Signal::Recorded(_)) {
            return Self::new(&scene.breathing, None).map(Some);
        }
        let region = Region::<[u64; 0]>::open(domain, TRACE_REGION, TRACE_KIND)?;
        let text = String::from_utf8_lossy(region.body::<u8>());
        Self::new(&scene.breathing, Some(&text)).map(Some)
    }

    /// Takes the page's last word; false when it made no sense (then the one before stands). Allocates nothing.
    pub fn listen(&mut self, control: &ControlBlock) -> bool {
        if control.breath.generation() == self.seen {
            return true;
        }
        let Some((state, generation)) = control.breath.load::<BreathState>() else { return true };
        self.seen = generation;
        let Some(state) = state.checked() else { return false };
        self.adopt(state);
        true
    }

    /// Goes by a command from now on.
    pub fn adopt(&mut self, state: BreathState) {
        self.live.states = state.leads.map(|lead| live_of(&lead));
        self.state = state;
    }

    /// Who leads.
    pub fn state(&self) -> &BreathState {
        &self.state
    }

    /// The next command, given at a simulation time: whether the breath is held, and the level if the slider leads. `None` while the last one does
    /// not hold yet: processes know two commands, and the one that holds must be among them. Try again a little later.
    pub fn command(&self, stamp: Stamp, held: bool, level: Option<f64>) -> Option<BreathState> {
        let last = &self.live.states[1];
        (stamp.time_ns >= last.since_ns).then(|| {
            let next = last.after(stamp.time_ns + BREATH_AHEAD_NS, if held { 0.0 } else { 1.0 }, level);
            let leads = [self.state.leads[1], lead_of(&next)];
            BreathState { stamp, leads, held: held.into(), led: level.is_some().into() }
        })
    }
}

impl Breathing for Signal {
    fn at(&self, time_ns: u64) -> Breath {
        self.live.at(time_ns)
    }
}

fn lead_of(state: &LiveState) -> BreathLead {
    let numbers = |ease: &Ease| [ease.from, ease.rate, ease.target];
    BreathLead {
        since_ns: state.since_ns,
        base_ns: state.base_ns,
        speed: numbers(&state.speed),
        mix: numbers(&state.mix),
        slider: numbers(&state.slider),
    }
}

fn live_of(lead: &BreathLead) -> LiveState {
    let ease = |[from, rate, target]: [f64; 3]| Ease { from, rate, target };
    LiveState { since_ns: lead.since_ns, base_ns: lead.base_ns, speed: ease(lead.speed), mix: ease(lead.mix), slider: ease(lead.slider) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    const MS: u64 = 1_000_000;

    #[test]
    fn a_page_that_drags_wildly_makes_no_step_and_all_who_listen_late_see_the_same() {
        let scene = breathing::Breathing::default();
        let mut page = Signal::new(&scene, None).unwrap();
        let mut others = [5u64, 20, 59].map(|late| (late, Signal::new(&scene, None).unwrap(), Vec::<(u64, BreathState)>::new()));
        let control = Box::new(ControlBlock::zeroed());
        let mut last = page.at(0);
        for ms in 0..8000u64 {
            let stamp = Stamp { time_ns: ms * MS, sequence: ms, incarnation: 1 };
            // a drag says something every 16 ms; the breath is held in the midst of it
            if ms > 1000 && ms % 16 == 0 {
                let level = (ms < 6000).then(|| 0.5 + 0.5 * (ms as f64 * 0.01).sin());
                if let Some(state) = page.command(stamp, (3000..4000).contains(&ms), level) {
                    assert!(state.checked().is_some());
                    page.adopt(state);
                    for (late, _, mail) in &mut others {
                        mail.push((ms + *late, state));
                    }
                }
            }
            let now = page.at(ms * MS);
            assert!((now.level - last.level).abs() < 0.02, "{ms}: {last:?} {now:?}");
            for (late, other, mail) in &mut others {
                while mail.first().is_some_and(|(at, _)| *at <= ms) {
                    control.breath.store(&mail.remove(0).1);
                    assert!(other.listen(&control));
                }
                assert_eq!(other.at(ms * MS), now, "{ms}, {late} late");
            }
            last = now;
        }
    }

    #[test]
    fn nonsense_in_the_cell_is_refused_and_the_last_word_stands() {
        let mut signal = Signal::new(&breathing::Breathing::default(), None).unwrap();
        let control = Box::new(ControlBlock::zeroed());
        let before = signal.at(1_234 * MS);
        let mut state = *signal.state();
        state.leads[1].mix[2] = f64::NAN;
        control.breath.store(&state);
        assert!(!signal.listen(&control) && signal.at(1_234 * MS) == before);
        assert!(signal.listen(&control), "it is refused once");
    }

    #[test]
    fn a_trace_that_was_not_brought_along_is_said() {
        let scene = breathing::Breathing { signal: maille_scene::Signal::Recorded("t.csv".into()), ..Default::default() };
        assert!(Signal::new(&scene, None).err().unwrap().to_string().contains("t.csv"));
    }
}
