//! How finely to draw the next frame so that it is ready in time.
//!
//! A frame costs about k · scale² / step, scale being the share of the full width and height that is drawn, step the distance
//! between samples over the one asked for. k is followed from the frames that were drawn. While things move, step and scale
//! share what must be saved (a coarser step up to [`LONGEST_STEP`] first hurts less than fewer pixels). Once they have rested for
//! [`REST`] frames the picture is drawn whole at the step asked for, unless the last one was; then nothing is to be drawn.
//!
//! Somebody who knows of other loads may hold everything below a quality of its own ([`FrameBudget::hold`]), pictures at rest too.
//!
//! Pure: times come in, quality goes out. Invariants: scale in [`SMALLEST_SCALE`]…1, step in 1…[`LONGEST_STEP`], unless held coarser.

/// Fewest pixels an axis while things move.
pub const SMALLEST_SCALE: f64 = 0.25;
/// Longest step while things move, over the one asked for. By two voxels rays land so deep in skin that what they meet first is noise,
/// and its gradient points anywhere: dark specks, by more than 60 of 255 on the skin of a real head; by one and a half none is darker by 30.
pub const LONGEST_STEP: f64 = 1.5;
/// Share of the time that is planned for: the rest is for what is not ray casting and for frames that differ.
const PLANNED: f64 = 0.85;
/// How quickly k follows the last frame.
const FOLLOW: f64 = 0.4;
/// Changes of scale below this are not worth their flicker.
const STEADY: f64 = 0.06;
/// Frames without motion before the picture is refined: a hand that pauses is not made to wait for a fine picture.
pub const REST: u32 = 3;

/// What to draw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// share of the full width and height
    pub scale: f64,
    /// factor of the step that was asked for
    pub step: f64,
}

impl Quality {
    /// Whole pictures at the step asked for.
    pub const FULL: Self = Self { scale: 1.0, step: 1.0 };

    /// The coarser of both, in each way.
    #[must_use]
    pub fn coarser(self, other: Self) -> Self {
        Self { scale: self.scale.min(other.scale), step: self.step.max(other.step) }
    }

    /// Pixels of a picture that is this fine.
    pub fn pixels(self, full: usize) -> usize {
        ((full as f64 * self.scale).round() as usize).clamp(1, full.max(1))
    }
}

/// Follows the time of frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameBudget {
    frame_ms: f64,
    /// time of a frame of full quality [ms], as far as it is known
    full_ms: Option<f64>,
    last: Quality,
    /// nothing is drawn finer
    held: Quality,
    /// frames since anything moved
    rested: u32,
}

impl FrameBudget {
    /// For frames every `frame_ms` milliseconds.
    pub fn new(frame_ms: f64) -> Self {
        Self { frame_ms: frame_ms.max(1e-3), full_ms: None, last: Quality::FULL, held: Quality::FULL, rested: 0 }
    }

    /// Changes the time that there is for a frame [ms]: what everything else leaves.
    pub fn allow(&mut self, frame_ms: f64) {
        if frame_ms.is_finite() {
            self.frame_ms = frame_ms.max(1e-3);
        }
    }

    /// Draws nothing finer than this from now on; [`Quality::FULL`] lets go. Numbers that are no quality are ignored.
    pub fn hold(&mut self, finest: Quality) {
        if finest.scale > 0.0 && finest.step.is_finite() {
            self.held = Quality::FULL.coarser(finest);
        }
    }

    /// Says what the last frame, drawn with the quality given out last, took [ms]; numbers that are no times are ignored.
    pub fn drawn(&mut self, ms: f64) {
        if !(ms.is_finite() && ms > 0.0) {
            return;
        }
        let full = ms * self.last.step / (self.last.scale * self.last.scale);
        self.full_ms = Some(self.full_ms.map_or(full, |known| known + FOLLOW * (full - known)));
    }

    /// Quality of the next frame; none while the picture that stands will do, or not yet.
    pub fn next(&mut self, moving: bool) -> Option<Quality> {
        self.rested = if moving { 0 } else { self.rested.saturating_add(1) };
        let next = match self.rested {
            0 => self.moving().coarser(self.held),
            1..REST => return None,
            _ if self.settled() => return None,
            _ => self.held,
        };
        self.last = next;
        Some(next)
    }

    /// Whether the picture that stands, drawn by the quality given out last, is as fine as it gets.
    pub fn settled(&self) -> bool {
        self.last == self.held
    }

    fn moving(&self) -> Quality {
        let affordable = self.full_ms.map_or(1.0, |full| PLANNED * self.frame_ms / full);
        if affordable >= 1.0 {
            return Quality::FULL;
        }
        let step = affordable.powf(-0.4).clamp(1.0, LONGEST_STEP);
        let scale = (affordable * step).sqrt().clamp(SMALLEST_SCALE, 1.0);
        let steady = self.last.step >= 1.0 && (scale - self.last.scale).abs() < STEADY && (step - self.last.step).abs() < STEADY * 2.0;
        if steady { self.last } else { Quality { scale, step } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A machine on which a full frame takes `full` ms.
    fn run(full: f64, frames: usize, budget: &mut FrameBudget) -> (Quality, f64) {
        let mut seen = (Quality::FULL, 0.0);
        for _ in 0..frames {
            let q = budget.next(true).expect("what moves is drawn");
            let ms = full * q.scale * q.scale / q.step;
            budget.drawn(ms);
            seen = (q, ms);
        }
        seen
    }

    /// What is drawn in as many frames without motion.
    fn rest(frames: u32, budget: &mut FrameBudget) -> Vec<Quality> {
        (0..frames).filter_map(|_| budget.next(false)).collect()
    }

    #[test]
    fn moving_frames_settle_below_the_time_there_is() {
        for full in [5.0, 40.0, 120.0, 400.0] {
            let (quality, ms) = run(full, 12, &mut FrameBudget::new(33.0));
            assert!(ms <= 33.0, "{full}: {quality:?} takes {ms}");
            // and do not waste it
            assert!(ms > 0.5 * 33.0 || quality == Quality::FULL, "{full}: {quality:?} takes {ms}");
        }
    }

    #[test]
    fn what_rests_becomes_whole_once_and_not_before_it_rests() {
        let mut budget = FrameBudget::new(33.0);
        run(200.0, 8, &mut budget);
        assert!(!budget.settled());
        assert_eq!(rest(REST - 1, &mut budget), []);
        assert_eq!(rest(50, &mut budget), [Quality::FULL]);
        assert!(budget.settled());
        let moving = budget.next(true).unwrap();
        assert!(moving.scale < 1.0 && moving.step > 1.0 && !budget.settled());
        // a whole picture that stands is not drawn again
        let mut quick = FrameBudget::new(33.0);
        run(5.0, 8, &mut quick);
        assert_eq!(rest(50, &mut quick), []);
    }

    #[test]
    fn what_is_held_stays_coarse_at_rest_too_until_it_is_let_go() {
        let mut budget = FrameBudget::new(33.0);
        let held = Quality { scale: 0.5, step: 1.5 };
        budget.hold(held);
        assert_eq!(run(5.0, 4, &mut budget).0, held);
        assert_eq!(rest(50, &mut budget), []);
        budget.hold(Quality { scale: f64::NAN, step: 1.0 });
        assert!(budget.settled());
        budget.hold(Quality::FULL);
        assert_eq!(rest(50, &mut budget), [Quality::FULL]);
    }

    #[test]
    fn a_machine_that_becomes_slower_is_followed_and_nonsense_is_ignored() {
        let mut budget = FrameBudget::new(33.0);
        run(20.0, 5, &mut budget);
        let (_, ms) = run(300.0, 20, &mut budget);
        assert!(ms <= 33.0, "{ms}");
        let before = budget;
        for ms in [f64::NAN, f64::INFINITY, -1.0, 0.0] {
            budget.drawn(ms);
        }
        assert_eq!(budget, before);
        let (quality, _) = run(1e6, 20, &mut budget);
        assert_eq!((quality.scale, quality.step), (SMALLEST_SCALE, LONGEST_STEP));
    }

    #[test]
    fn the_picture_does_not_flicker() {
        let mut budget = FrameBudget::new(33.0);
        run(150.0, 10, &mut budget);
        let first = budget.next(true).unwrap();
        for n in 0..20 {
            // frames that differ by a twentieth
            budget.drawn(150.0 * (1.0 + 0.05 * f64::from(n % 3 - 1)) * first.scale * first.scale / first.step);
            assert_eq!(budget.next(true), Some(first));
        }
    }
}
