//! Tissue that a needle drags along: the places of its path are pins, ChainMail lets the rest give way, and voxels really move.
//!
//! What the tissue looks like is a function of the needle as it is, not of its history: all goes to rest, then the pins take the tissue along the path
//! to where haptic says it is (`maille-needle`'s `drag`). So nothing accumulates, a needle that is drawn out leaves everything bit by bit as it was, and
//! a process that starts anew needs nothing but the needle. Between places of the path the drag is linear; each pin is one of the eight elements
//! around a place every half voxel.
//!
//! A needle that has moved nothing by more than [`WORTH_MM`] since the last time costs one look. One that nobody holds (haptic died) is out.
//! Units: mm; frame: reference, LPS; displacements along the grid's axes. Not here: forces, which do not depend on this.

use crate::step::{Done, Engine};
use maille_chainmail::{Motion, Pin, enclosing_elements};
use maille_contract::ControlBlock;
use maille_contract::needle::{NEEDLE_NODES, NeedleDrag};
use maille_displacement::along_axes;
use maille_scene::Scene;
use maille_store::{Reader, Writer};
use maille_transport::Stopwatch;
use maille_volume::Grid;

/// Changes of drag below this are not worth a transaction [mm]: half a tenth of a voxel of the finest CT.
const WORTH_MM: f32 = 0.03;
/// Most places that pins are made for: a needle of 300 mm at a quarter of a millimetre.
const MOST_PLACES: usize = 1200;

/// What was answered last.
pub(crate) struct Drag {
    answered: Option<NeedleDrag>,
}

impl Drag {
    /// Where the scene asks for it.
    pub fn new(scene: &Scene) -> Option<Self> {
        scene.has_effect("needle-drag").then_some(Self { answered: None })
    }

    /// Follows the needle, if that is worth it.
    pub fn follow<W: Stopwatch>(
        &mut self,
        engine: &mut Engine<W>,
        control: &ControlBlock,
        now_ns: u64,
        reader: &Reader,
        writer: &mut Writer,
    ) -> Option<Done> {
        let held = control.held_tool(now_ns).and_then(|_| control.needle_drag.load::<NeedleDrag>()).and_then(|(drag, _)| drag.checked());
        let drag = held.unwrap_or_else(bytemuck::Zeroable::zeroed);
        if self.answered.is_some_and(|last| !differ(&last, &drag)) {
            return None;
        }
        self.answered = Some(drag);
        engine.drag(&pins(&reader.info().grid, &drag), now_ns, reader, writer)
    }
}

/// Whether the tissue would look otherwise.
fn differ(a: &NeedleDrag, b: &NeedleDrag) -> bool {
    let (n, m) = (a.count as usize, b.count as usize);
    let far = |a: &[f32; 3], b: &[f32; 3]| (0..3).any(|c| (a[c] - b[c]).abs() > WORTH_MM);
    n != m || (0..n.min(NEEDLE_NODES)).any(|i| far(&a.by_mm[i], &b.by_mm[i]) || far(&a.path_mm[i], &b.path_mm[i]))
}

/// The elements along a path, each to where it is dragged; of an element that is met twice the later place counts, which is the one nearer the tip.
fn pins(grid: &Grid, drag: &NeedleDrag) -> Vec<Pin> {
    let count = drag.count as usize;
    let wide = |p: [f32; 3]| p.map(f64::from);
    let step = 0.5 * grid.min_spacing();
    let mut pins = Vec::new();
    let mut places = 0;
    for n in 1..count {
        let ([a, b], [u, v]) = ([n - 1, n].map(|i| wide(drag.path_mm[i])), [n - 1, n].map(|i| wide(drag.by_mm[i])));
        let length = (0..3).map(|c| (b[c] - a[c]).powi(2)).sum::<f64>().sqrt();
        let steps = ((length / step).ceil() as usize).clamp(1, 200);
        for k in usize::from(n > 1)..=steps {
            places += 1;
            if places > MOST_PLACES {
                return pins;
            }
            let w = k as f64 / steps as f64;
            let mix = |a: [f64; 3], b: [f64; 3]| -> [f64; 3] { std::array::from_fn(|c| a[c] + w * (b[c] - a[c])) };
            let motion = Motion::To(along_axes(grid, mix(u, v)).map(|v| v as f32));
            pins.extend(enclosing_elements(grid, mix(a, b)).into_iter().map(|voxel| Pin { voxel, motion }));
        }
    }
    pins
}

impl<W: Stopwatch> Engine<W> {
    /// Tissue as these pins have it, from rest; `None` when nothing has moved.
    fn drag(&mut self, pins: &[Pin], now_ns: u64, reader: &Reader, writer: &mut Writer) -> Option<Done> {
        self.watch.start();
        let mut region = self.mail.relax(0.0, 0.0);
        let pushed = self.mail.push(&reader.rest(), pins);
        region.merge(&pushed.region);
        self.watch.split("needle-drag");
        if region.is_empty() {
            return None;
        }
        self.state.last_step_ns = now_ns;
        Some(Done { moved_elements: pushed.moved, ..self.commit(&region, reader, writer) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::restore::restore;
    use maille_contract::Role;
    use maille_store::{StoreKeeper, StoreSizes};
    use maille_transport::{ControlMap, Domain, Untimed};
    use maille_volume::{BrickSource as _, Rescale, Sampler, Volume};
    use std::sync::atomic::Ordering::Relaxed;

    const SIZE: usize = 48;

    /// A block of tissue whose value says where along x it was [HU].
    fn with_block(then: impl FnOnce(&Domain, &ControlMap, &Scene, Reader, Writer)) {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let voxels = (0..SIZE * SIZE * SIZE).map(|n| (n % SIZE * 4) as i16).collect();
        let volume = Volume::new(Grid::axis_aligned([SIZE; 3], [1.0; 3]), Rescale { slope: 1.0, intercept: 0.0 }, voxels);
        let keeper = StoreKeeper::create(&domain, &volume, StoreSizes::for_volume(27, 27, 3, true), |_| {}).unwrap();
        let mut scene = Scene::builtin_default();
        scene.effects.insert("needle-drag".into(), maille_scene::EffectSetting::Switch(true));
        scene.effects.remove("relaxation");
        let (reader, writer) = (Reader::open(&domain, Role::Deformation).unwrap(), Writer::open(&domain).unwrap());
        then(&domain, &control, &scene, reader, writer);
        drop(keeper);
        drop(control);
        domain.remove().unwrap();
    }

    fn hold(control: &ControlMap) {
        let haptic = control.service(Role::Haptic);
        haptic.set_state(maille_contract::ServiceState::Ready);
        haptic.heartbeat_ns.store(1_000, Relaxed);
        control.tool.store::<maille_contract::ToolState>(&bytemuck::Zeroable::zeroed());
    }

    /// A needle along z through the middle, its shaft bowed to +x by `by` in the middle, its tip ahead by 1 mm.
    fn bowed(by: f32) -> NeedleDrag {
        let mut drag: NeedleDrag = bytemuck::Zeroable::zeroed();
        (drag.count, drag.radius_mm) = (5, 0.6);
        for n in 0..5 {
            drag.path_mm[n] = [24.0, 24.0, 4.0 + 6.0 * n as f32];
            drag.by_mm[n] = [by * [0.0, 0.5, 1.0, 0.5, 0.0][n], 0.0, if n == 4 { 1.0 } else { 0.0 }];
        }
        drag
    }

    #[test]
    fn tissue_lies_where_the_needle_has_taken_it_and_is_as_it_was_when_the_needle_is_out() {
        with_block(|_, control, scene, reader, mut writer| {
            let mut engine = Engine::new(scene, reader.info(), Untimed);
            restore(&mut engine, &writer);
            let mut drag = Drag::new(scene).unwrap();
            let mut follow = |engine: &mut Engine<Untimed>, writer: &mut Writer| {
                drag.follow(engine, control, 1_000, &reader, writer).map(|d| d.moved_elements)
            };
            assert_eq!(follow(&mut engine, &mut writer), None, "nobody holds a needle");
            hold(control);
            control.needle_drag.store(&bowed(3.0));
            assert!(follow(&mut engine, &mut writer).is_some_and(|moved| moved > 100));
            assert_eq!(follow(&mut engine, &mut writer), None, "a needle at rest costs a look");
            let snapshot = reader.snapshot();
            let sampler = Sampler::new(&snapshot);
            // the tissue that was at x = 24 is now at 27: its value says so
            let at = |x: f64, z: f64| sampler.value([x, 24.0, z]).unwrap() / 4.0;
            assert!((at(27.0, 16.0) - 24.0).abs() < 0.3, "{}", at(27.0, 16.0));
            assert!((at(25.5, 10.0) - 24.0).abs() < 0.3, "{}", at(25.5, 10.0));
            // ChainMail lets what is far away rest
            assert_eq!(at(45.0, 16.0), 45.0);
            drop(snapshot);
            // another bow is reached from rest, whatever was before
            for by in [-2.0, 5.0, 1.0] {
                control.needle_drag.store(&bowed(by));
                follow(&mut engine, &mut writer);
            }
            let mut other = Engine::new(scene, reader.info(), Untimed);
            other.mail.push(&reader.rest(), &pins(&reader.info().grid, &bowed(1.0)));
            let same = (0..SIZE).all(|i| (0..SIZE).all(|k| engine.mail.displacement([i, 24, k]) == other.mail.displacement([i, 24, k])));
            assert!(same, "nothing of what was before is left");
            control.needle_drag.store::<NeedleDrag>(&bytemuck::Zeroable::zeroed());
            follow(&mut engine, &mut writer);
            let snapshot = reader.snapshot();
            let rest = reader.rest();
            for id in 0..snapshot.layout().count() as u32 {
                assert!(snapshot.brick(id).voxels == rest.brick(id).voxels, "brick {id} is as it was");
            }
        });
    }

    #[test]
    fn a_process_that_died_leaves_nothing_that_the_next_does_not_put_right() {
        with_block(|_, control, scene, reader, mut writer| {
            hold(control);
            control.needle_drag.store(&bowed(4.0));
            let mut engine = Engine::new(scene, reader.info(), Untimed);
            restore(&mut engine, &writer);
            Drag::new(scene).unwrap().follow(&mut engine, control, 1_000, &reader, &mut writer);
            // the next finds what was committed, and the needle elsewhere
            control.needle_drag.store(&bowed(-1.0));
            let mut next = Engine::new(scene, reader.info(), Untimed);
            restore(&mut next, &writer);
            assert!(Drag::new(scene).unwrap().follow(&mut next, control, 1_000, &reader, &mut writer).is_some());
            let mut fresh = Engine::new(scene, reader.info(), Untimed);
            fresh.mail.push(&reader.rest(), &pins(&reader.info().grid, &bowed(-1.0)));
            assert!((0..SIZE).all(|i| next.mail.displacement([i, 24, 16]) == fresh.mail.displacement([i, 24, 16])));
        });
    }

    #[test]
    fn nonsense_moves_nothing() {
        with_block(|_, control, scene, reader, mut writer| {
            hold(control);
            let mut engine = Engine::new(scene, reader.info(), Untimed);
            let mut drag = Drag::new(scene).unwrap();
            for wrong in [f32::NAN, f32::INFINITY, 1e9] {
                let mut needle = bowed(1.0);
                needle.path_mm[2][1] = wrong;
                control.needle_drag.store(&needle);
                assert!(drag.follow(&mut engine, control, 1_000, &reader, &mut writer).is_none());
            }
            let mut needle = bowed(1.0);
            needle.count = 1 << 40;
            control.needle_drag.store(&needle);
            assert!(drag.follow(&mut engine, control, 1_000, &reader, &mut writer).is_none());
        });
    }
}
