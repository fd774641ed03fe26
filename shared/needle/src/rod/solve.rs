//! One step: Newton with a factorisation that is kept while it serves, never uphill.
//!
//! Residual: the largest displacement of a node that the forces left over would still cause, |K⁻¹·∂E| [mm]; it is measured at the shape that is
//! returned, and not applied to it. Each accepted step lowers the energy (steps that would raise it are halved), so that a step of the rod never
//! stores energy that nobody put in, converged or not.

use super::Rod;
use crate::V3;
use crate::limits::{MAX_ATTEMPTS, MAX_CHORDS, MAX_FACTORISATIONS, MAX_HALVINGS, MAX_STEP_S};

/// Largest turn of a segment in one step [rad]: beyond, the second derivatives say nothing.
const MAX_TURN: f64 = 0.7;
/// A kept factorisation that gains less than this is made anew.
const CHORD_GAIN: f64 = 0.2;

/// How a solve went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Solved {
    /// what is left [mm]; see the module
    pub residual_mm: f64,
    /// factorisations made
    pub factorisations: u32,
    /// times the energy was looked at
    pub evaluations: u32,
    /// times the step was made anew against more drag
    pub slowed: u32,
    /// whether the residual met the tolerance
    pub converged: bool,
}

impl Rod {
    /// Moves the rod to where its energy is least after a time `dt_s`; infinite: to rest.
    ///
    /// Where Newton does not arrive within its bound (a needle that snaps over in one tick), the step is made anew against a hundred times the
    /// drag, and again: the needle takes some ticks for what it would have done in one, each of them solved. [`Solved::slowed`] tells.
    pub fn solve(&mut self, dt_s: f64) -> Solved {
        let dt = if dt_s.is_nan() { 1e-3 } else { dt_s.max(1e-6) };
        let to_rest = dt.is_infinite();
        let dt = if to_rest { dt } else { dt.min(MAX_STEP_S) };
        let p = &self.parameters;
        // what would hold the needle's shape against its own stiffness within a tenth of its length
        let least_drag = 1e-2 * p.bending_n_mm2 / p.length_mm.powi(3);
        let drag = p.viscosity_n_s_per_mm2 * self.segment_mm / dt;
        self.start.copy_from(&self.shape);
        // `factorise` walks along the needle; sorting in place allocates nothing
        self.attachments.sort_unstable_by(|a, b| a.arc_mm.total_cmp(&b.arc_mm));
        let attempts = if to_rest { 1 } else { MAX_ATTEMPTS };
        let bound = if to_rest { MAX_ATTEMPTS * MAX_FACTORISATIONS } else { MAX_FACTORISATIONS };
        let mut solved = Solved::default();
        for attempt in 0..attempts {
            self.drag = if attempt == 0 { drag } else { drag.max(least_drag) * 100f64.powi(attempt as i32) };
            self.turn_drag = if attempt == 0 { 0.0 } else { self.drag * self.segment_mm * self.segment_mm };
            self.shape.copy_from(&self.start);
            self.descend(&mut solved, bound as u32, least_drag);
            solved.slowed = attempt as u32;
            if solved.converged {
                break;
            }
        }
        solved
    }

    /// Newton from the present shape, with so many factorisations at most.
    fn descend(&mut self, solved: &mut Solved, bound: u32, least_damping: f64) {
        let tolerance = self.parameters.tolerance_mm;
        let last = solved.factorisations + bound;
        let mut damping = 0.0;
        self.energy = self.measure(false);
        solved.evaluations += 1;
        while solved.factorisations < last {
            self.derive(true);
            let mut last_force = self.gather();
            solved.factorisations += 1;
            let used = damping;
            let turned_over = self.factorise(last_force, used);
            let (mut size, mut base) = self.substitute(last_force);
            if (turned_over || self.largest_turn() > MAX_TURN) && solved.factorisations + bound / 2 < last {
                // far from where second derivatives tell the truth: shorter steps
                damping = (damping * 10.0).max(least_damping);
                if !turned_over {
                    continue;
                }
            } else {
                damping = if damping < 10.0 * least_damping { 0.0 } else { 0.1 * damping };
            }
            for _ in 0..=MAX_CHORDS {
                solved.residual_mm = size;
                if !size.is_finite() {
                    return;
                }
                if size <= tolerance {
                    if used > 0.0 {
                        // a damped step is short whatever is left: looked at again without
                        damping = 0.0;
                        break;
                    }
                    solved.converged = true;
                    return;
                }
                let before = size;
                let whole = self.accept(base, size, &mut solved.evaluations);
                self.derive(false);
                last_force = self.gather();
                (size, base) = self.substitute(last_force);
                solved.residual_mm = size;
                match whole {
                    Accepted::No => return,
                    Accepted::Part => break,
                    Accepted::Whole if size > CHORD_GAIN * before && size > tolerance => break,
                    Accepted::Whole => {}
                }
            }
        }
    }

    /// Largest turn of the step in the stages [rad].
    fn largest_turn(&self) -> f64 {
        self.stages.iter().fold(0.0f64, |most, s| most.max(s.step.norm_squared())).sqrt()
    }

    /// Takes the step in the stages, halved until it does not raise the energy.
    fn accept(&mut self, base: V3, size: f64, evaluations: &mut u32) -> Accepted {
        let mut by = (MAX_TURN / self.largest_turn()).min(1.0);
        // differences of energies are noise below this
        let noise = if size < 1e-3 { 1e-11 } else { 1e-13 } * self.energy.abs().max(1.0);
        for _ in 0..MAX_HALVINGS {
            let stages = &self.stages;
            self.trial.stepped(&self.shape, |i| stages[i].step, base, by, self.segment_mm);
            let energy = self.measure(true);
            *evaluations += 1;
            if energy <= self.energy + noise {
                std::mem::swap(&mut self.shape, &mut self.trial);
                self.energy = energy;
                return if by == 1.0 { Accepted::Whole } else { Accepted::Part };
            }
            by *= 0.5;
        }
        self.measure(false);
        Accepted::No
    }
}

enum Accepted {
    Whole,
    Part,
    No,
}
