//! The thread between the feed and the pages: requests in, view states and tool commands out, pictures and states to the pages.
//!
//! One round every [`ROUND`], a state every [`STATE_EVERY_NS`]. A frame is taken and encoded only while some page can take it. A
//! page holds the tool alone; it lets go by saying so, by leaving, or by being silent for [`HAND_SILENT_NS`], so that a frozen
//! browser never keeps pressing.

use crate::{
    breath::{self, Desk},
    encode::PictureEncoder,
    feed::{Feed, ServiceStatus},
    hub::{Event, Hub, PageId},
    presets::{Preset, presets},
    protocol::{CommitSummary, Hello, PROTOCOL, Request, State, Tool, ToolRequest, View, ViewPatch},
    rates::{RateMeter, Rates},
};
use maille_contract::{
    Commit, Stamp, ToolCommand, ToolState, ViewState,
    messages::{TOOL_FADING, TOOL_IN_CONTACT, TOOL_TAKEN_OVER, TRANSFER_POINTS},
};
use std::{
    sync::{Arc, atomic::Ordering::Relaxed, mpsc},
    time::Duration,
};

/// Pause between rounds: a frame waits for half of it on average, a tenth of a frame's period.
const ROUND: Duration = Duration::from_millis(4);
/// Time between states \[ns\].
const STATE_EVERY_NS: u64 = 50_000_000;
/// Time between looks at the services \[ns\].
const SERVICES_EVERY_NS: u64 = 200_000_000;
/// A hand that says nothing for this long has let go \[ns\].
const HAND_SILENT_NS: u64 = 600_000_000;
/// Force samples kept for one state: ten times what comes in its time.
const FORCE_SAMPLES: usize = 128;

/// The state of that thread.
pub struct Pump<F: Feed> {
    feed: F,
    hub: Arc<Hub>,
    events: mpsc::Receiver<Event>,
    encoder: PictureEncoder,
    presets: Vec<Preset>,
    view: ViewState,
    command_sequence: u64,
    holder: Option<Holder>,
    desk: Desk,
    tool: Option<ToolState>,
    commit: Option<Commit>,
    force: Vec<[f64; 2]>,
    services: Vec<ServiceStatus>,
    meter: RateMeter,
    rates: Rates,
    frames: u64,
    next_state_ns: u64,
    next_services_ns: u64,
}

/// The page that holds the tool.
struct Holder {
    page: PageId,
    heard_ns: u64,
    target_mm: [f64; 3],
}

impl<F: Feed> Pump<F> {
    /// A pump; the first view state is published at once, so that all agree on it.
    pub fn new(feed: F, hub: Arc<Hub>, events: mpsc::Receiver<Event>, jpeg_quality: u8) -> Self {
        let view = feed.first_view();
        let mut pump = Self {
            feed,
            hub,
            events,
            encoder: PictureEncoder::new(jpeg_quality),
            presets: presets(),
            view,
            command_sequence: 0,
            holder: None,
            desk: Desk::default(),
            tool: None,
            commit: None,
            force: Vec::with_capacity(FORCE_SAMPLES),
            services: Vec::new(),
            meter: RateMeter::default(),
            rates: Rates::default(),
            frames: 0,
            next_state_ns: 0,
            next_services_ns: 0,
        };
        pump.publish_view();
        pump
    }

    /// Runs until the feed says that the console should end.
    pub fn run(mut self) {
        while !self.feed.should_end() {
            self.round();
            std::thread::sleep(ROUND);
        }
        self.release();
        self.hub.ended.send_replace(true);
    }

    fn round(&mut self) {
        let now = self.feed.now_ns();
        self.take_requests(now);
        if self.holder.as_ref().is_some_and(|h| now.saturating_sub(h.heard_ns) > HAND_SILENT_NS) {
            self.release();
        }
        self.desk.serve(&mut self.feed);
        self.take_messages();
        if self.hub.waiting.load(Relaxed) > 0 {
            self.take_frame();
        }
        if now >= self.next_services_ns {
            self.next_services_ns = now + SERVICES_EVERY_NS;
            self.services = self.feed.services();
            // the time of the counters, not of the round: a rate is only as good as its time
            self.rates = self.meter.update(self.feed.now_ns(), &self.services);
        }
        self.feed.beat(self.frames, self.hub.refused.load(Relaxed));
        if now >= self.next_state_ns {
            self.next_state_ns = now + STATE_EVERY_NS;
            self.send_state();
        }
    }

    /// Applies everything that the pages asked for; what they did to the view becomes one new view state.
    fn take_requests(&mut self, now: u64) {
        let mut view_changed = false;
        while let Ok(event) = self.events.try_recv() {
            match event {
                Event::Request(_, Request::View(patch)) => view_changed |= self.patch_view(&patch),
                Event::Request(page, Request::Tool(request)) => self.tool_request(page, request, now),
                Event::Request(_, Request::Breath(request)) => {
                    let breathes = self.feed.breath().is_some();
                    if !self.desk.ask(request, breathes) {
                        self.hub.refuse();
                    }
                }
                Event::Request(_, Request::Effect(request)) => {
                    if !self.feed.switch(&request.name, request.on) {
                        self.hub.refuse();
                    }
                }
                Event::Request(_, Request::Undo(_)) if self.feed.facts().incises => self.feed.send_undo(),
                Event::Request(_, Request::Undo(_)) => self.hub.refuse(),
                Event::Request(_, Request::Ack { .. }) => {}
                Event::Left(page) if self.holder.as_ref().is_some_and(|h| h.page == page) => self.release(),
                Event::Left(_) => {}
            }
        }
        if view_changed {
            self.publish_view();
        }
    }

    fn patch_view(&mut self, patch: &ViewPatch) -> bool {
        match patch.apply(&self.view) {
            Some(new) => self.view = new,
            None => {
                self.hub.refuse();
                return false;
            }
        }
        true
    }

    fn publish_view(&mut self) {
        self.view.stamp =
            Stamp { time_ns: self.feed.time_ns(), sequence: self.view.stamp.sequence + 1, incarnation: self.feed.incarnation() };
        self.feed.send_view(&self.view);
        let hello = Hello {
            protocol: PROTOCOL,
            facts: self.feed.facts(),
            presets: &self.presets,
            transfer_points_max: TRANSFER_POINTS,
            view: View::from(&self.view),
        };
        if let Ok(text) = serde_json::to_string(&hello) {
            self.hub.hello.send_replace(text.into());
        }
    }

    fn tool_request(&mut self, page: PageId, request: ToolRequest, now: u64) {
        let held_by_another = self.holder.as_ref().is_some_and(|h| h.page != page);
        match request.target_mm {
            _ if held_by_another => self.hub.refuse(),
            Some(target_mm) if request.taken && target_mm.iter().all(|v| v.is_finite()) => {
                self.holder = Some(Holder { page, heard_ns: now, target_mm });
                self.send_command(true, target_mm);
            }
            _ if request.taken => self.hub.refuse(),
            _ => self.release(),
        }
    }

    fn release(&mut self) {
        if let Some(holder) = self.holder.take() {
            self.send_command(false, holder.target_mm);
        }
    }

    fn send_command(&mut self, taken: bool, target_mm: [f64; 3]) {
        self.command_sequence += 1;
        let stamp = Stamp { time_ns: self.feed.time_ns(), sequence: self.command_sequence, incarnation: self.feed.incarnation() };
        self.feed.send_command(&ToolCommand { stamp, taken: u64::from(taken), target_mm, sent_ns: self.feed.now_ns() });
    }

    fn take_messages(&mut self) {
        while let Some(tool) = self.feed.tool_state() {
            let force = tool.force_n.iter().map(|f| f * f).sum::<f64>().sqrt();
            if self.force.len() < FORCE_SAMPLES && force.is_finite() {
                self.force.push([tool.stamp.time_ns as f64 * 1e-9, force]);
            }
            self.tool = Some(tool);
        }
        while let Some(commit) = self.feed.commit() {
            self.commit = Some(commit);
        }
    }

    fn take_frame(&mut self) {
        let (encoder, hub, frames) = (&mut self.encoder, &self.hub, &mut self.frames);
        self.feed.frame(&mut |header, payload| match encoder.encode(header, payload) {
            Some(picture) => {
                *frames += 1;
                hub.pictures.send_replace(Some(Arc::new(picture)));
            }
            None => hub.refuse(),
        });
    }

    fn send_state(&mut self) {
        if self.hub.states.receiver_count() > 0 {
            let time_ns = self.feed.time_ns();
            let breath = self.feed.breath().map(|signal| breath::seen(signal, time_ns));
            let state = State {
                time_s: time_ns as f64 * 1e-9,
                view: View::from(&self.view),
                tool: self.tool.as_ref().and_then(tool_seen),
                held: self.holder.is_some(),
                force: &self.force,
                services: &self.services,
                rates: self.rates,
                commit: self.commit.as_ref().map(commit_seen),
                breath,
                effects: self.feed.switches(),
                given_up: self.feed.given_up(),
                refused: self.hub.refused.load(Relaxed),
                pages: self.hub.pages.load(Relaxed),
            };
            if let Ok(text) = serde_json::to_string(&state) {
                // an error means that the last page has just left
                let _ = self.hub.states.send(text.into());
            }
        }
        self.force.clear();
    }
}

/// What a page may see of the tool; nothing if the pose cannot be drawn.
fn tool_seen(t: &ToolState) -> Option<Tool> {
    let finite = [t.tip_mm, t.proxy_mm, t.direction, t.force_n].iter().flatten().all(|v| v.is_finite());
    (finite && t.penetration_mm.is_finite() && t.radius_mm.is_finite()).then_some(Tool {
        tip_mm: t.tip_mm,
        proxy_mm: t.proxy_mm,
        direction: t.direction,
        force_n: t.force_n,
        penetration_mm: t.penetration_mm,
        radius_mm: t.radius_mm,
        in_contact: t.flags & TOOL_IN_CONTACT != 0,
        taken_over: t.flags & TOOL_TAKEN_OVER != 0,
        fading: t.flags & TOOL_FADING != 0,
    })
}

fn commit_seen(c: &Commit) -> CommitSummary {
    CommitSummary {
        epoch: c.epoch,
        moved_elements: c.moved_elements,
        bricks: c.bricks,
        step_ms: c.step_ns as f64 * 1e-6,
        refused_mm: c.refused_mm.iter().map(|v| v * v).sum::<f64>().sqrt(),
    }
}
