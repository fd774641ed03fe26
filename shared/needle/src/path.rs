//! The path that the tip has cut: nodes in reference space, placed as the tip goes forward, taken back as it goes back.
//!
//! No node: the needle is outside. One: the tip rests on the skin. More: p_1 on the skin, then a node every Δp, and the tip p_l, the only one that
//! moves [Fortmeier et al. 2015, section 2.3]:
//!
//!   p_l⁺ = p_l + d_l·{ Δd (back, towards p_{l−1}) if Δd ≤ 0;  0 while a₂Δd² + a₁Δd < f_cut (eq. 4);
//!                      Δd + γ₁ − √(γ₁² + γ₂) if a₂ > 0;  Δd − f_cut/a₁ if a₂ = 0 }
//!
//! where the last two leave exactly the deflection at which the spring holds f_cut. Nearer to p_{l−1} than 0.5·Δp that node goes; further than
//! 1.5·Δp a node is placed Δp behind it. A tip that moves far in one tick looks at the tissue on its way, so that no layer is missed. A layer at
//! the entry of a tissue ([`crate::Capsule`]) holds the tip at the border until its own force is reached; what of it is cut stays cut (`borders`). f_cut is held
//! against the force that the tip really has: a spring that has relaxed by f_r (`axial`) has to be stretched further, to Δd with
//! a₂Δd² + a₁Δd = f_cut + f_r. Where the next tissue is stiffer, its spring
//! begins at the force that the last one held ([`Path::preload_mm`]): a border does not store energy.
//!
//! Units: mm, N; frame: reference. Invariants: neighbours are never nearer than 0.5·Δp or further than 1.5·Δp, but for a first piece that is
//! shorter; capacity is fixed. Cost: at most [`MAX_LOOKS`] look-ups a tick, one where the needle moves slowly. Allocation: none after `new`.

use crate::borders::{Borders, Standing};
use crate::events::{Event, EventKind};
use crate::limits::{MAX_EVENTS, MAX_LOOKS};
use crate::{MaterialTable, Tissue, V3};

/// Step of looks ahead [mm].
pub(crate) const LOOK_MM: f64 = 0.5;

/// A place that the tip has passed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathNode {
    /// p_i [mm]
    pub reference: V3,
    /// tissue there
    pub material: u8,
    /// Δx_i [mm], eq. 6
    pub slip_mm: f64,
}

/// Events of a tick, in order.
pub(crate) type Told = [Option<Event>; MAX_EVENTS];

/// Puts an event behind the others; one too many is left out.
pub(crate) fn tell(told: &mut Told, event: Event) {
    if let Some(free) = told.iter_mut().find(|e| e.is_none()) {
        *free = Some(event);
    }
}

/// The nodes, and what the tip is about to cut.
#[derive(Clone, Debug)]
pub struct Path {
    nodes: Vec<PathNode>,
    spacing_mm: f64,
    /// what was crossed, and the layer that may hold the tip
    borders: Borders,
    /// part of Δd that the present tissue's spring does not see [mm]
    preload_mm: f64,
    /// the surface has given way
    entered: bool,
}

impl Path {
    /// An empty path with nodes every `spacing_mm` and room for a needle of `length_mm`.
    pub(crate) fn new(spacing_mm: f64, length_mm: f64) -> Self {
        // neighbours may be half a spacing apart; breathing may stretch a path by half
        let room = ((3.0 * length_mm / spacing_mm) as usize + 8).min(crate::limits::MAX_PATH_NODES);
        Self { nodes: Vec::with_capacity(room), spacing_mm, borders: Borders::default(), preload_mm: 0.0, entered: false }
    }

    /// Nodes from the skin to the tip.
    pub fn nodes(&self) -> &[PathNode] {
        &self.nodes
    }

    pub(crate) fn nodes_mut(&mut self) -> &mut [PathNode] {
        &mut self.nodes
    }

    /// Most nodes it can hold.
    pub(crate) fn capacity(&self) -> usize {
        self.nodes.capacity()
    }

    /// The tip, if inside.
    pub fn tip(&self) -> Option<&PathNode> {
        self.nodes.last()
    }

    /// Δp [mm].
    pub fn spacing_mm(&self) -> f64 {
        self.spacing_mm
    }

    /// Δd that the tip's spring does not see [mm].
    pub fn preload_mm(&self) -> f64 {
        self.preload_mm
    }

    /// Length in reference space [mm].
    pub fn length_mm(&self) -> f64 {
        self.nodes.windows(2).map(|w| (w[1].reference - w[0].reference).norm()).sum()
    }

    pub(crate) fn clear(&mut self) {
        self.nodes.clear();
        self.borders.clear();
        self.preload_mm = 0.0;
        self.entered = false;
    }

    /// A path that nothing cut, in this tissue: the first point on the skin, the last the tip. None of them has moved along the needle.
    pub(crate) fn lay(&mut self, points: impl Iterator<Item = (V3, u8)>) {
        self.clear();
        self.nodes.extend(points.map(|(reference, material)| PathNode { reference, material, slip_mm: 0.0 }).take(self.nodes.capacity()));
        self.entered = true;
    }

    /// First contact with the skin.
    pub(crate) fn touch(&mut self, reference: V3, material: u8, table: &MaterialTable) {
        self.clear();
        self.nodes.push(PathNode { reference, material, slip_mm: 0.0 });
        self.borders.enter(material, table.get(material), reference, 0.0);
    }

    /// Force at which the tip goes on [N].
    pub fn threshold_n(&self, table: &MaterialTable) -> f64 {
        match (self.borders.standing(), self.nodes.last()) {
            (_, None) => 0.0,
            (Standing::Layer(force, _), _) => force,
            (_, Some(tip)) => table.get(tip.material).cutting_force_n,
        }
    }

    /// Force of the tip's spring at a deflection [N]; eq. 5 without sign and direction.
    pub fn tip_force_n(&self, deflection_mm: f64, table: &MaterialTable) -> f64 {
        self.nodes.last().map_or(0.0, |tip| table.get(tip.material).tip_force_n(deflection_mm - self.preload_mm))
    }

    /// Moves the tip for a device that is Δd ahead along d (unit vector); returns how far it went [mm], negative for back. `relaxed_n` is what relaxation
    /// has taken off the tip's force.
    pub(crate) fn follow<T: Tissue + ?Sized>(
        &mut self,
        delta_mm: f64,
        d: V3,
        relaxed_n: f64,
        tissue: &T,
        table: &MaterialTable,
        told: &mut Told,
    ) -> f64 {
        if self.nodes.is_empty() || !delta_mm.is_finite() || delta_mm == 0.0 {
            return 0.0;
        }
        if delta_mm < 0.0 { -self.retract(-delta_mm, tissue, told) } else { self.cut(delta_mm, d, relaxed_n, tissue, table, told) }
    }

    fn cut<T: Tissue + ?Sized>(&mut self, delta_mm: f64, d: V3, relaxed_n: f64, tissue: &T, table: &MaterialTable, told: &mut Told) -> f64 {
        // a device that came back gives the spring its whole length again
        self.preload_mm = self.preload_mm.min(delta_mm);
        let look = LOOK_MM.max(delta_mm / (MAX_LOOKS / 2) as f64);
        let (mut left, mut went) = (delta_mm, 0.0);
        for _ in 0..MAX_LOOKS {
            let l = self.nodes.len() - 1;
            let tip = self.nodes[l];
            let material = table.get(tip.material);
            let spring = left - self.preload_mm;
            let threshold = self.threshold_n(table);
            if material.tip_force_n(spring) < threshold + relaxed_n {
                break;
            }
            let told_here = |depth: f64, at: V3| Event {
                kind: EventKind::Puncture,
                material: tip.material,
                reference_mm: at.into(),
                depth_mm: depth,
                // on its way through this tick's Δd the tip passed its threshold: more than that it never had
                force_n: threshold,
            };
            let standing = self.borders.standing();
            if matches!(standing, Standing::Layer(_, thickness) if thickness <= 0.0) {
                self.borders.give_way();
                self.entered = true;
                tell(told, told_here(self.length_mm(), tip.reference));
                continue;
            }
            let within = match standing {
                Standing::Free => f64::INFINITY,
                Standing::Cut(way) | Standing::Layer(_, way) => way,
            };
            let step = (spring - material.deflection_mm(threshold + relaxed_n)).min(look).min(within);
            if step <= 1e-9 {
                break;
            }
            let (to, found) = beyond(tip.reference, d * step, tip.material, tissue);
            let stepped = (to - tip.reference).norm();
            if l == 0 {
                // p_1 stays on the skin
                self.nodes.push(tip);
            }
            if standing == Standing::Free && !self.entered {
                // a surface without a layer of its own
                self.entered = true;
                tell(told, told_here(0.0, tip.reference));
            }
            let l = self.nodes.len() - 1;
            self.nodes[l].reference = to;
            (left, went) = (left - stepped, went + stepped);
            self.preload_mm = (self.preload_mm - stepped).max(0.0);
            let through = self.borders.went(stepped);
            if found != tip.material {
                self.nodes[l].material = found;
                let depth = self.length_mm();
                let before = self.borders.enter(found, table.get(found), to, depth);
                let stands = self.borders.standing() != Standing::Free || table.get(found).cutting_force_n == f64::INFINITY;
                // by a hole that is there nothing is punctured
                if !before {
                    let kind = if stands { EventKind::Contact } else { EventKind::Puncture };
                    tell(told, Event { kind, material: found, ..told_here(depth, to) });
                }
                // same force on the other side of the border
                let spring = left - self.preload_mm;
                self.preload_mm = (left - table.get(found).deflection_mm(material.tip_force_n(spring))).clamp(0.0, left);
            } else if through {
                self.entered = true;
                tell(told, told_here(self.length_mm(), to));
            }
            self.place_nodes(tissue);
        }
        went
    }

    /// The rule of 1.5·Δp, and the node on the skin when the tip leaves it.
    fn place_nodes<T: Tissue + ?Sized>(&mut self, tissue: &T) {
        let l = self.nodes.len() - 1;
        let tip = self.nodes[l];
        if l == 0 {
            return;
        }
        let behind = self.nodes[l - 1].reference;
        let along = tip.reference - behind;
        let length = along.norm();
        if length > 1.5 * self.spacing_mm && self.nodes.len() < self.nodes.capacity() {
            let at = behind + along * (self.spacing_mm / length);
            // of the tissue of its own place: a border may lie between it and the tip
            self.nodes[l] = PathNode { reference: at, material: tissue.material_at(at.into()), ..tip };
            self.nodes.push(tip);
        }
    }

    fn retract<T: Tissue + ?Sized>(&mut self, by_mm: f64, tissue: &T, told: &mut Told) -> f64 {
        self.preload_mm = 0.0;
        let was = self.nodes[self.nodes.len() - 1].material;
        let mut left = by_mm;
        // each round takes a node away or ends
        while left > 0.0 {
            let l = self.nodes.len() - 1;
            let tip = self.nodes[l];
            if l == 0 {
                tell(told, Event::withdrawn(&tip));
                self.clear();
                return by_mm;
            }
            let back = self.nodes[l - 1].reference - tip.reference;
            let length = back.norm();
            if left >= length {
                left -= length;
                self.nodes.pop();
                continue;
            }
            self.nodes[l].reference = tip.reference + back * (left / length);
            if length - left < 0.5 * self.spacing_mm && l >= 2 {
                self.nodes.remove(l - 1);
            }
            break;
        }
        let l = self.nodes.len() - 1;
        // p_1 keeps what was found at the contact: it lies on the border
        if l > 0 {
            self.nodes[l].material = tissue.material_at(self.nodes[l].reference.into());
        }
        if self.nodes[l].material == was {
            self.borders.went(-by_mm);
        } else {
            self.borders.leave(self.length_mm());
        }
        by_mm
    }
}

/// A step through tissue, or as far as just over the first border; and what is there.
fn beyond<T: Tissue + ?Sized>(from: V3, step: V3, material: u8, tissue: &T) -> (V3, u8) {
    let found = tissue.material_at((from + step).into());
    if found == material {
        return (from + step, found);
    }
    let (mut low, mut high, mut there) = (0.0, 1.0, found);
    for _ in 0..12 {
        let middle = 0.5 * (low + high);
        let here = tissue.material_at((from + step * middle).into());
        if here == material {
            low = middle;
        } else {
            (high, there) = (middle, here);
        }
    }
    (from + step * high, there)
}
