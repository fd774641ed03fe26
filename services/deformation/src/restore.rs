//! Recovery: the working state from what the last transaction committed. No file, no log.

use crate::{state::State, step::Engine};
use maille_chainmail::DisplacementBrick;
use maille_store::{Cuts, Plastic, Writer};
use maille_transport::Stopwatch;

/// Puts every committed displacement back, its plastic part, the cut links, and the state.
pub(crate) fn restore<W: Stopwatch>(engine: &mut Engine<W>, writer: &Writer) {
    for id in 0..writer.layout().count() as u32 {
        if let Some(numbers) = writer.displacement(id) {
            engine.moved.insert(id);
            engine.mail.restore_brick(id, bytemuck::cast_ref::<_, DisplacementBrick>(numbers));
        }
        if let Some(numbers) = writer.channel::<Plastic>(id) {
            engine.mail.restore_plastic_brick(id, bytemuck::cast_ref::<_, DisplacementBrick>(numbers));
        }
        if let Some(cuts) = writer.channel::<Cuts>(id) {
            engine.mail.restore_cut_brick(id, cuts);
            if let Some(incisions) = &mut engine.incisions {
                incisions.restore(id, cuts);
            }
        }
    }
    engine.resume();
    if let Some(state) = State::read(writer.state()) {
        engine.resume_threshold(state.threshold_hu);
        engine.state = state;
    }
}
