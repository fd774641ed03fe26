//! Recovery: the working state from what the last transaction committed. No file, no log.

use crate::{state::State, step::Engine};
use maille_chainmail::DisplacementBrick;
use maille_store::Writer;

/// Puts every committed displacement back, and the state.
pub(crate) fn restore(engine: &mut Engine, writer: &Writer) {
    for id in 0..writer.layout().count() as u32 {
        if let Some(numbers) = writer.displacement(id) {
            engine.mail.restore_brick(id, bytemuck::cast_ref::<_, DisplacementBrick>(numbers));
        }
    }
    if let Some(state) = State::read(writer.state()) {
        engine.set_threshold(state.threshold_hu);
        engine.state = state;
    }
}
