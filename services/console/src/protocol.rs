//! What the page and the server say to each other over the WebSocket.
//!
//! **Page → server**, JSON text, one object a message ([`Request`]):
//!
//! - `{"type":"view", …}`: any of the fields of [`ViewPatch`]; what is not named stays as it is;
//! - `{"type":"tool","taken":true,"target_mm":[x,y,z]}` while the hand holds the tool, at least every 250 ms;
//!   `{"type":"tool","taken":false}` lets it go;
//! - `{"type":"breath","held":true,"level":0.4}`: the breath is held or goes on, and the slider leads it or (`null`) nobody does;
//! - `{"type":"effect","name":"sections","on":false}`: an effect that may be switched live is switched;
//! - `{"type":"undo"}`: the last stroke of incision is taken back;
//! - `{"type":"ack","frame":n}` after frame n has been drawn: the next one is sent only then.
//!
//! **Server → page**, JSON text: one [`Hello`] first (and again when the patient or the scene changes), then a [`State`] twenty
//! times a second.
//!
//! **Server → page**, binary: one frame, all numbers little-endian:
//!
//! | byte | type | what |
//! |---|---|---|
//! | 0 | u32 | [`FRAME_MAGIC`] |
//! | 4 | u32 | number of the frame, to be acknowledged |
//! | 8 | f64 | simulation time \[s\] |
//! | 16 | f64 | epoch of the tissue shown |
//! | 24 | f64 | sequence of the view state shown |
//! | 32 | f32 | time spent rendering \[ms\] |
//! | 36 | u32 | number of views, 6 |
//! | 40 + 8 v | u16, u16, u32 | width, height, bytes of view v's JPEG; 0 bytes where the scene has no such view |
//! | 88 … | | the JPEGs, one after the other, in the order 3d, axial, coronal, sagittal, ultrasound, x-ray |
//!
//! Lengths are millimetres in patient coordinates (LPS), forces newtons, values HU. A message that is not understood, or
//! whose numbers cannot be used, changes nothing and is counted.

use maille_contract::{
    ViewState,
    messages::{TRANSFER_POINTS, VIEWS},
};
use serde::{Deserialize, Serialize};

/// Raised when a message changes its meaning.
pub const PROTOCOL: u32 = 3;
/// First four bytes of a frame: "MLF3".
pub const FRAME_MAGIC: u32 = u32::from_le_bytes(*b"MLF3");
/// Bytes before the first JPEG.
pub const FRAME_HEADER_BYTES: usize = 40 + 8 * VIEWS.len();
/// Longest message that a page may send: the largest real one is a tenth of it.
pub const MAX_REQUEST_BYTES: usize = 16 << 10;

/// What a page asks for.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum Request {
    /// change what the views show
    View(Box<ViewPatch>),
    /// take, move or let go the tool
    Tool(ToolRequest),
    /// hold, lead or let go the breath
    Breath(BreathRequest),
    /// switch an effect
    Effect(EffectRequest),
    /// take the last stroke of incision back
    Undo(UndoRequest),
    /// a frame was drawn
    Ack {
        /// its number
        frame: u32,
    },
}

/// New values of some fields of the view state.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[expect(missing_docs, reason = "the fields are those of `ViewState`, documented there")]
pub struct ViewPatch {
    pub threshold_hu: Option<f64>,
    pub mode: Option<u64>,
    pub camera: Option<u64>,
    pub eye_mm: Option<[f64; 3]>,
    pub target_mm: Option<[f64; 3]>,
    pub up: Option<[f64; 3]>,
    pub fov_deg: Option<f64>,
    pub window_center_hu: Option<f64>,
    pub window_width_hu: Option<f64>,
    pub sections_mm: Option<[f64; 3]>,
    pub sections_follow_tool: Option<bool>,
    pub organ_alone: Option<u64>,
    /// HU, r, g, b, opacity over 1 mm; an empty list goes back to the scene's own
    pub transfer: Option<Vec<[f64; 5]>>,
}

impl ViewPatch {
    /// The state with the patch applied; `None` if the result could not be shown.
    pub fn apply(&self, old: &ViewState) -> Option<ViewState> {
        let mut new = *old;
        let put = |to: &mut f64, from: Option<f64>| *to = from.unwrap_or(*to);
        put(&mut new.threshold_hu, self.threshold_hu);
        put(&mut new.fov_deg, self.fov_deg);
        put(&mut new.window_center_hu, self.window_center_hu);
        put(&mut new.window_width_hu, self.window_width_hu);
        new.mode = self.mode.unwrap_or(new.mode);
        new.camera = self.camera.unwrap_or(new.camera);
        new.eye_mm = self.eye_mm.unwrap_or(new.eye_mm);
        new.target_mm = self.target_mm.unwrap_or(new.target_mm);
        new.up = self.up.unwrap_or(new.up);
        new.sections_mm = self.sections_mm.unwrap_or(new.sections_mm);
        new.sections_follow_tool = self.sections_follow_tool.map_or(new.sections_follow_tool, u64::from);
        new.organ_alone = self.organ_alone.unwrap_or(new.organ_alone);
        if let Some(points) = &self.transfer {
            new.transfer = [[0.0; 5]; TRANSFER_POINTS];
            new.transfer.get_mut(..points.len())?.copy_from_slice(points);
            new.transfer_count = points.len() as u64;
        }
        if new.mode > 1 || new.camera > 1 || new.organ_alone > 255 {
            return None;
        }
        new.checked()
    }
}

/// The hand in the page.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToolRequest {
    /// whether the page holds the tool
    pub taken: bool,
    /// where the hand wants the tip \[mm\]; needed while it is held
    #[serde(default)]
    pub target_mm: Option<[f64; 3]>,
}

/// One stroke is taken back at a time: there is nothing to say about it.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UndoRequest {}

/// The hand on the breath.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BreathRequest {
    /// whether the breath is held
    pub held: bool,
    /// the level that the slider asks for while it leads
    pub level: Option<f64>,
}

/// An effect is switched.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EffectRequest {
    /// its name in the registry
    pub name: String,
    /// whether it shall be on
    pub on: bool,
}

/// What does not change while the run lasts.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "hello")]
pub struct Hello<'a> {
    /// [`PROTOCOL`]
    pub protocol: u32,
    /// the scene, its volume and limits
    pub facts: &'a crate::feed::Facts,
    /// transfer functions to choose from
    pub presets: &'a [crate::presets::Preset],
    /// points a transfer function may have
    pub transfer_points_max: usize,
    /// view state at this moment
    pub view: View,
}

/// The view state as the page reads it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[expect(missing_docs, reason = "the fields are those of `ViewState`, documented there")]
pub struct View {
    pub sequence: u64,
    pub threshold_hu: f64,
    pub mode: u64,
    pub camera: u64,
    pub eye_mm: [f64; 3],
    pub target_mm: [f64; 3],
    pub up: [f64; 3],
    pub fov_deg: f64,
    pub window_center_hu: f64,
    pub window_width_hu: f64,
    pub sections_mm: [f64; 3],
    pub sections_follow_tool: bool,
    pub organ_alone: u64,
    pub transfer: Vec<[f64; 5]>,
}

impl From<&ViewState> for View {
    fn from(v: &ViewState) -> Self {
        Self {
            sequence: v.stamp.sequence,
            threshold_hu: v.threshold_hu,
            mode: v.mode,
            camera: v.camera,
            eye_mm: v.eye_mm,
            target_mm: v.target_mm,
            up: v.up,
            fov_deg: v.fov_deg,
            window_center_hu: v.window_center_hu,
            window_width_hu: v.window_width_hu,
            sections_mm: v.sections_mm,
            sections_follow_tool: v.sections_follow_tool != 0,
            organ_alone: v.organ_alone,
            transfer: v.transfer[..(v.transfer_count as usize).min(TRANSFER_POINTS)].to_vec(),
        }
    }
}

/// What changes all the time.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "state")]
pub struct State<'a> {
    /// simulation time \[s\]
    pub time_s: f64,
    /// what the views show
    pub view: View,
    /// the tool as last felt
    pub tool: Option<Tool>,
    /// whether a page holds the tool, and whether it is the one that reads this is told by the page itself
    pub held: bool,
    /// samples since the last state: simulation time \[s\], |F| \[N\]
    pub force: &'a [[f64; 2]],
    /// the services, in the order of their roles
    pub services: &'a [crate::feed::ServiceStatus],
    /// loops and events a second
    pub rates: crate::rates::Rates,
    /// the last commit
    pub commit: Option<CommitSummary>,
    /// how the patient breathes, where one does
    pub breath: Option<crate::breath::Breath>,
    /// effects that may be switched, and whether they are on
    pub effects: Vec<(&'static str, bool)>,
    /// what the governor gave up, knob and setting, where the scene leaves its accuracy to it
    pub given_up: Option<Vec<(&'static str, f64)>>,
    /// requests refused since the start
    pub refused: u64,
    /// pages connected
    pub pages: usize,
}

/// The tool as the page draws it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[expect(missing_docs, reason = "the fields are those of `ToolState`, documented there")]
pub struct Tool {
    pub tip_mm: [f64; 3],
    pub proxy_mm: [f64; 3],
    pub direction: [f64; 3],
    pub force_n: [f64; 3],
    pub penetration_mm: f64,
    pub radius_mm: f64,
    pub in_contact: bool,
    pub taken_over: bool,
    pub fading: bool,
}

/// What the last commit did.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[expect(missing_docs, reason = "the fields are those of `Commit`, documented there")]
pub struct CommitSummary {
    pub epoch: u64,
    pub moved_elements: u64,
    pub bricks: u64,
    pub step_ms: f64,
    pub refused_mm: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::feed::default_view;

    fn request(text: &str) -> Option<Request> {
        serde_json::from_str(text).ok()
    }

    #[test]
    fn a_patch_changes_what_it_names_and_nothing_else() {
        let old = default_view([-100.0; 3], [100.0; 3]);
        let Some(Request::View(patch)) = request(r#"{"type":"view","threshold_hu":-250,"sections_follow_tool":true}"#) else {
            panic!("a view message was not understood")
        };
        let new = patch.apply(&old).unwrap();
        assert_eq!((new.threshold_hu, new.sections_follow_tool), (-250.0, 1));
        assert_eq!(ViewState { threshold_hu: old.threshold_hu, sections_follow_tool: old.sections_follow_tool, ..new }, old);
    }

    #[test]
    fn what_could_not_be_shown_is_refused() {
        let old = default_view([-100.0; 3], [100.0; 3]);
        for text in [
            r#"{"type":"view","fov_deg":0}"#,
            r#"{"type":"view","mode":2}"#,
            r#"{"type":"view","eye_mm":[0,0,0],"target_mm":[0,0,0]}"#,
            r#"{"type":"view","window_width_hu":-5}"#,
            r#"{"type":"view","transfer":[[0,0,0,0,0],[0,1,1,1,1]]}"#,
            r#"{"type":"view","transfer":[[0,0,0,0,2]]}"#,
        ] {
            let Some(Request::View(patch)) = request(text) else { panic!("not a view message: {text}") };
            assert!(patch.apply(&old).is_none(), "taken: {text}");
        }
        let many =
            ViewPatch { transfer: Some((0..=TRANSFER_POINTS).map(|i| [i as f64, 0.0, 0.0, 0.0, 0.0]).collect()), ..Default::default() };
        assert!(many.apply(&old).is_none());
    }

    #[test]
    fn words_and_numbers_that_are_not_ours_are_no_request() {
        for text in [
            "",
            "null",
            "{",
            r#"{"type":"shutdown"}"#,
            r#"{"type":"view","treshold_hu":1}"#,
            r#"{"type":"view","threshold_hu":1e999}"#,
            r#"{"type":"tool"}"#,
            r#"{"type":"undo","strokes":2}"#,
            r#"{"type":"tool","taken":true,"target_mm":[1,2]}"#,
            r#"{"type":"ack","frame":-1}"#,
        ] {
            assert!(request(text).is_none(), "understood: {text}");
        }
    }
}
