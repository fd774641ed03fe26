//! When frames begin: at the beats of the scene's rate, and, for a commit, before its beat.
//!
//! What has moved is looked at once a period, at the beat. A commit waits less: where the last beat had nothing to draw, its frame begins at once, and
//! the next beat is a period later. Where things move, its frame takes the place of the next beat, up to half a period early; the one after keeps its time,
//! so that frames of what moves anyway stay evenly spread.
//!
//! So, for frames that take at most half a period: a commit is on its frame within the frame's own time where the picture stood, and within one
//! period where things move (of commits that come faster than frames may, within one and a half). Invariants, whatever comes when, while the loop keeps up:
//! n frames take at least n − 1½ periods from the first to the last; from one look to the next it is at most one and a half.
//!
//! Pure: times come in [ns], times go out.

/// The rhythm of a loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Beats {
    period_ns: u64,
    next_ns: u64,
    /// nothing has been drawn since before the last beat
    rests: bool,
}

impl Beats {
    /// Beats every period, the first now.
    pub fn new(period_ns: u64, now_ns: u64) -> Self {
        Self { period_ns: period_ns.max(1), next_ns: now_ns, rests: false }
    }

    /// When to look next, where there is a commit that no frame has shown (`fresh`), or none.
    pub fn due_ns(&self, fresh: bool) -> u64 {
        match (fresh, self.rests) {
            (false, _) => self.next_ns,
            (true, false) => self.next_ns.saturating_sub(self.period_ns / 2),
            (true, true) => 0,
        }
    }

    /// Looks now; the beats that went by without a look.
    pub fn look(&mut self, now_ns: u64) -> u64 {
        if now_ns < self.next_ns {
            // instead of the next beat; there is none to take the place of while things rest
            self.next_ns = if self.rests { now_ns } else { self.next_ns } + self.period_ns;
            return 0;
        }
        let missed = (now_ns - self.next_ns) / self.period_ns;
        self.next_ns += (missed + 1) * self.period_ns;
        self.rests = true;
        missed
    }

    /// Says that what was looked at is being drawn.
    pub fn draw(&mut self) {
        self.rests = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: u64 = 1_000;

    /// Numbers without order.
    fn random(seed: &mut u64) -> u64 {
        *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        *seed >> 33
    }

    /// A loop beside commits: when its frames began, and for each commit when the first frame after it did. `moving`: something else moves as well.
    fn play(commits: &[u64], moving: bool, mut takes: impl FnMut() -> u64, end: u64) -> (Vec<u64>, Vec<(u64, u64)>) {
        let (mut beats, mut now) = (Beats::new(PERIOD, 0), 0);
        let (mut frames, mut shown, mut waiting) = (Vec::<u64>::new(), Vec::new(), 0);
        while now < end {
            let come = commits.iter().take_while(|&&at| at <= now).count();
            let due = beats.due_ns(come > waiting);
            if now < due {
                // woken by the next commit, or by the time
                now = commits.get(come).map_or(due, |&at| at.min(due));
                continue;
            }
            beats.look(now);
            if moving || come > waiting {
                beats.draw();
                frames.push(now);
                shown.extend(commits[waiting..come].iter().map(|&at| (at, now)));
                waiting = come;
                now += takes();
            }
        }
        (frames, shown)
    }

    fn at_random(seed: &mut u64, mean: u64, end: u64) -> Vec<u64> {
        let mut at = 0;
        std::iter::from_fn(|| {
            at += 1 + random(seed) % (2 * mean);
            (at < end).then_some(at)
        })
        .collect()
    }

    #[test]
    fn a_commit_into_a_picture_that_stands_is_drawn_at_once() {
        let mut seed = 7;
        // further apart than the loop needs to come to rest
        let commits: Vec<u64> = (1..200).map(|n| 5 * PERIOD * n + random(&mut seed) % (2 * PERIOD)).collect();
        let (frames, shown) = play(&commits, false, || 400, 1_100 * PERIOD);
        assert_eq!((frames.len(), shown.len()), (commits.len(), commits.len()));
        assert!(shown.iter().all(|(commit, begun)| commit == begun));
    }

    #[test]
    fn while_things_move_a_commit_waits_half_a_period_at_most_where_it_is_the_only_one_of_its_slot() {
        let mut seed = 11;
        for takes in [1, 200, 500] {
            let commits: Vec<u64> = (1..300).map(|n| 3 * PERIOD * n + random(&mut seed) % PERIOD).collect();
            let (_, shown) = play(&commits, true, || takes, 1_000 * PERIOD);
            let longest = shown.iter().map(|(commit, begun)| begun - commit).max();
            assert!(longest <= Some(PERIOD / 2), "{takes}: {longest:?}");
            assert_eq!(shown.len(), commits.len());
        }
    }

    #[test]
    fn frames_are_no_more_than_the_rate_says_and_evenly_spread_whatever_commits_come() {
        let mut seed = 3;
        let end = 2_000 * PERIOD;
        for mean in [30, 300, 800, 1_300, 4_000] {
            for moving in [true, false] {
                let commits = at_random(&mut seed, mean, end);
                let mut other = seed;
                let (frames, shown) = play(&commits, moving, || random(&mut other) % (PERIOD / 2), end);
                for n in 1..frames.len().min(40) {
                    let shortest = frames.windows(n + 1).map(|w| w[n] - w[0]).min().unwrap();
                    assert!(2 * shortest >= (2 * n as u64 - 1) * PERIOD, "commits every {mean}: {} frames in {shortest}", n + 1);
                }
                let latest = shown.iter().map(|(commit, begun)| begun - commit).max();
                assert!(latest <= Some(PERIOD), "commits every {mean}: {latest:?}");
                if moving {
                    let longest = frames.windows(2).map(|w| w[1] - w[0]).max();
                    assert!(longest <= Some(PERIOD * 3 / 2), "commits every {mean}: {longest:?}");
                }
            }
        }
    }

    #[test]
    fn without_commits_it_beats_like_a_clock_and_says_what_was_missed() {
        let (frames, _) = play(&[], true, || 300, 100 * PERIOD);
        assert!(frames.iter().enumerate().all(|(n, &at)| at == n as u64 * PERIOD), "{frames:?}");
        let mut beats = Beats::new(PERIOD, 0);
        assert_eq!([beats.look(0), beats.look(4 * PERIOD + 1), beats.look(5 * PERIOD)], [0, 3, 0]);
        assert_eq!(beats.due_ns(false), 6 * PERIOD);
    }
}
