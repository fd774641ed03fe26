//! Incisions: a tool that presses takes away a box of voxels, or a ball; strokes are taken back one after the other.
//!
//! What is taken away are *elements*, where the tissue is now ([`Incision`]): all their links are cut, so that ChainMail, the mapper, touch and picture
//! agree about what is there, and a patient who is deformed or breathes is cut where the tool is. The commit carries the bricks that show a voxel that
//! became void, the cut links, and the state.
//!
//! Each element's byte in the channel of cuts numbers the stroke that took it away, so that a process that starts anew can take back what its predecessor cut.
//! A **stroke** is all that is cut within [`STROKE_NS`] of each other. The last [`UNDOABLE`] strokes can be taken back; an older one stays
//! ([`FOR_GOOD`]). Taking back a stroke brings the elements' links back, but for those to elements that are still away. What was there is then there again bit for bit:
//! in a scene with incisions tissue is at rest but for what is cut, for its tool pushes nothing and no other effect that moves tissue goes with it (`needle-drag`
//! needs a needle, relaxation finds nothing to relax, a threshold that moves links has no displacement to move). Were tissue displaced, as only a caller of this
//! crate can have it, it would be mapped anew, and a voxel could differ by what the mapper's tolerance of a hundredth of a voxel is worth, 10 HU at the steepest
//! edges: its answer within that depends on the voxels that it is asked for together.
//!
//! Invariant: in a scene with incisions nothing else cuts links (the scene's tool is one), so that a link is cut exactly when one of its ends is away.
//! Cost: the elements of the box, and the mapper's of so many voxels.

use maille_chainmail::{CUT, ChainMail, ChangedBrick, ChangedRegion};
use maille_contract::ToolMove;
use maille_scene::Scene;
use maille_store::BRICK_VOXELS;
use maille_vif::{Incision, Tool};
use maille_volume::{BrickId, BrickLayout, BrickSource, brick::EDGE};
use std::collections::{BTreeMap, BTreeSet};

/// Cuts further apart than this belong to different strokes [ns].
const STROKE_NS: u64 = 500_000_000;
/// Strokes that can be taken back.
const UNDOABLE: u64 = 30;
/// Number of elements whose stroke can no longer be taken back.
const FOR_GOOD: u8 = 31;
/// Where the number stands in an element's byte; below it are the bits of cut links.
const SHIFT: u32 = 3;

/// What is stored with every commit.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub(crate) struct Strokes {
    /// strokes that stand
    pub made: u64,
    /// of these, how many can be taken back
    pub undoable: u64,
    /// CLOCK_MONOTONIC [ns] of the last cut; 0: the next begins a stroke
    pub last_ns: u64,
    /// strokes that were asked to be taken back and have been
    pub undone: u64,
}

/// The incisions of a scene.
pub(crate) struct Incisions {
    tool: Tool,
    depth_mm: f64,
    hardest_hu: f64,
    /// number of each element's stroke, 0 where it is there
    numbers: BTreeMap<BrickId, Box<[u8; BRICK_VOXELS]>>,
}

/// What a cut, or taking one back, changed.
#[derive(Default)]
pub(crate) struct Changed {
    /// elements whose links changed
    pub region: ChangedRegion,
    /// bricks whose numbers changed
    pub numbered: BTreeSet<BrickId>,
    pub elements: u64,
}

impl Changed {
    /// And what another changed.
    pub fn add(&mut self, other: Self) {
        self.region.merge(&other.region);
        self.numbered.extend(other.numbered);
        self.elements += other.elements;
    }
}

/// Stroke n's number.
fn number_of(stroke: u64) -> u8 {
    (stroke % UNDOABLE) as u8 + 1
}

fn place(layout: &BrickLayout, [i, j, k]: [usize; 3]) -> (BrickId, usize) {
    (layout.brick_of(i, j, k), ((k % EDGE) * EDGE + j % EDGE) * EDGE + i % EDGE)
}

fn add(region: &mut BTreeMap<BrickId, ChangedBrick>, layout: &BrickLayout, voxel: [usize; 3]) {
    let [i, j, k] = voxel.map(|v| v % EDGE);
    let id = layout.brick_of(voxel[0], voxel[1], voxel[2]);
    region.entry(id).or_insert_with(|| ChangedBrick::new(id)).extend(k * EDGE + j, i, i + 1);
}

impl Incisions {
    /// Of a scene that asks for them.
    pub fn new(scene: &Scene) -> Option<Self> {
        let i = &scene.incision;
        let tool = i.radius_mm.map_or(Tool::Box(i.voxels), |radius_mm| Tool::Ball { radius_mm });
        scene.has_effect("incision").then(|| Self { tool, depth_mm: i.depth_mm, hardest_hu: i.hardest_hu, numbers: BTreeMap::new() })
    }

    /// Puts back what a commit stored of a brick.
    pub fn restore(&mut self, id: BrickId, cuts: &[u8; BRICK_VOXELS]) {
        if cuts.iter().any(|c| c >> SHIFT != 0) {
            self.numbers.insert(id, Box::new(cuts.map(|c| c >> SHIFT)));
        }
    }

    /// A brick's bytes for the store: cut links and numbers.
    pub fn write(&self, mail: &ChainMail, id: BrickId, out: &mut [u8; BRICK_VOXELS]) {
        match mail.cut_brick(id) {
            Some(cuts) => out.copy_from_slice(cuts),
            None => out.fill(0),
        }
        if let Some(numbers) = self.numbers.get(&id) {
            out.iter_mut().zip(numbers.iter()).for_each(|(byte, number)| *byte |= number << SHIFT);
        }
    }

    /// Cuts below a tip that presses; `None` when nothing is taken away.
    pub fn cut<S: BrickSource>(
        &mut self,
        rest: &S,
        mail: &mut ChainMail,
        strokes: &mut Strokes,
        message: &ToolMove,
        threshold_hu: f64,
        now_ns: u64,
    ) -> Option<Changed> {
        if message.depth_mm < self.depth_mm {
            return None;
        }
        let (grid, layout, rescale) = (&rest.info().grid, *rest.layout(), rest.info().rescale);
        let deepest: [f64; 3] = std::array::from_fn(|c| message.tip_mm[c] - message.radius_mm * message.normal[c]);
        let incision = Incision::new(grid, self.tool, grid.index_from_world(deepest))?;
        let (low, high) = incision.bounds();
        let value = |[i, j, k]: [usize; 3]| rescale.value(f64::from(rest.voxel(i, j, k)));
        let taken: Vec<[usize; 3]> = mail
            .elements_now_in(low, high, |voxel| incision.contains(voxel))
            .into_iter()
            .filter(|&element| !mail.is_removed(element) && value(element) <= self.hardest_hu)
            .collect();
        // air has nothing that could be taken away; what of it lies in the box goes with the tissue
        if !taken.iter().any(|&element| value(element) >= threshold_hu) {
            return None;
        }
        let mut numbered = BTreeSet::new();
        if strokes.last_ns == 0 || now_ns.saturating_sub(strokes.last_ns) > STROKE_NS {
            strokes.made += 1;
            strokes.undoable = (strokes.undoable + 1).min(UNDOABLE);
            // whoever had this number before stays away for good
            self.renumber(number_of(strokes.made), FOR_GOOD, &mut numbered);
        }
        strokes.last_ns = now_ns;
        let number = number_of(strokes.made);
        let mut region = BTreeMap::new();
        for &element in &taken {
            let (id, at) = place(&layout, element);
            self.numbers.entry(id).or_insert_with(|| Box::new([0; BRICK_VOXELS]))[at] = number;
            numbered.insert(id);
            add(&mut region, &layout, element);
        }
        let mut region = ChangedRegion { bricks: region.into_values().collect() };
        region.merge(&mail.remove_elements(&taken));
        Some(Changed { region, numbered, elements: taken.len() as u64 })
    }

    /// Takes the last stroke back; `None` when there is none.
    pub fn undo<S: BrickSource>(&mut self, rest: &S, mail: &mut ChainMail, strokes: &mut Strokes) -> Option<Changed> {
        if strokes.undoable == 0 {
            return None;
        }
        let (layout, number) = (*rest.layout(), number_of(strokes.made));
        let mut back = Vec::new();
        for (&id, numbers) in &self.numbers {
            let first = layout.first_voxel(id);
            let own = numbers.iter().enumerate().filter(|(_, n)| **n == number);
            back.extend(own.map(|(at, _)| [first[0] + at % EDGE, first[1] + at / EDGE % EDGE, first[2] + at / (EDGE * EDGE)]));
        }
        let mut numbered = BTreeSet::new();
        self.renumber(number, 0, &mut numbered);
        strokes.made -= 1;
        strokes.undoable -= 1;
        strokes.last_ns = 0;
        // links of what came back, as they would be had the others been cut alone
        let (mut region, mut bytes) = (BTreeMap::new(), BTreeMap::new());
        for &element in &back {
            add(&mut region, &layout, element);
            for axis in 0..3 {
                let mut next = element;
                next[axis] += 1;
                let away = next[axis] < layout.size[axis] && self.is_away(&layout, next);
                put(&mut bytes, mail, &layout, element, CUT[axis], away);
                if element[axis] > 0 {
                    let mut before = element;
                    before[axis] -= 1;
                    put(&mut bytes, mail, &layout, before, CUT[axis], self.is_away(&layout, before));
                    add(&mut region, &layout, before);
                }
            }
        }
        bytes.into_iter().for_each(|(id, cuts)| mail.restore_cut_brick(id, &cuts));
        let mut region = ChangedRegion { bricks: region.into_values().collect() };
        // links that are there again hold again, where tissue has moved meanwhile
        region.merge(&mail.repair(rest));
        Some(Changed { region, numbered, elements: back.len() as u64 })
    }

    fn is_away(&self, layout: &BrickLayout, voxel: [usize; 3]) -> bool {
        let (id, at) = place(layout, voxel);
        self.numbers.get(&id).is_some_and(|numbers| numbers[at] != 0)
    }

    fn renumber(&mut self, from: u8, to: u8, changed: &mut BTreeSet<BrickId>) {
        for (&id, numbers) in &mut self.numbers {
            for number in numbers.iter_mut().filter(|n| **n == from) {
                *number = to;
                changed.insert(id);
            }
        }
        self.numbers.retain(|_, numbers| numbers.iter().any(|n| *n != 0));
    }
}

type Bytes = BTreeMap<BrickId, Box<[u8; BRICK_VOXELS]>>;

/// Sets or clears a bit in the bytes of an element's brick, which begin as the mail has them.
fn put(bytes: &mut Bytes, mail: &ChainMail, layout: &BrickLayout, voxel: [usize; 3], bit: u8, set: bool) {
    let (id, at) = place(layout, voxel);
    let cuts = bytes.entry(id).or_insert_with(|| Box::new(*mail.cut_brick(id).unwrap_or(&[0; BRICK_VOXELS])));
    cuts[at] = if set { cuts[at] | bit } else { cuts[at] & !bit };
}
