// The model (what the server said and what the mouse changed) and the panels that show it.
//
// A panel is an object with `hello(model)` and `state(model)`, either may be missing: a new effect brings a panel of its own.

import { Link } from "/link.js";
import { Views } from "/views.js";
import { Mouse } from "/mouse.js";
import { Tool } from "/tool.js";
import { Picture } from "/picture.js";
import { TransferEditor } from "/transfer.js";
import { Breath } from "/breath.js";
import { Charts } from "/charts.js";
import { Services } from "/services.js";

const $ = (id) => document.getElementById(id);

// After a change made here the server's view state is not believed for so long: it may be older than the change.
const OWN_EDIT_MS = 500;

class Model {
  facts = null; // what does not change
  presets = [];
  view = null; // what the views show
  state = null; // the last state message
  frame = null; // the last frame, without pixels
  frameAt = 0;
  online = false;
  pending = null;
  editedAt = -Infinity;

  // Changes the view here at once and on the server with the next animation frame.
  edit(patch) {
    if (!this.view) return;
    Object.assign(this.view, patch);
    this.editedAt = performance.now();
    if (!this.pending) setTimeout(() => { this.link.send({ type: "view", ...this.pending }); this.pending = null; }, 16);
    this.pending = { ...this.pending, ...patch };
    this.changed();
  }

  changed() { for (const panel of this.panels) panel.state?.(this); }
  service(role) { return this.state?.services.find((s) => s.role === role); }
}

const model = new Model();
const views = new Views(model);
const tool = new Tool(model);
const mouse = new Mouse(model, views, tool);
const transfer = new TransferEditor(model);
const picture = new Picture(model, mouse);

// The line at the top.
const top = {
  hello: (m) => {
    $("scene").textContent = m.facts.scene;
    $("description").textContent = m.facts.description;
    document.title = `maille – ${m.facts.scene}`;
    // panels of effects that the scene does not call for
    for (const e of document.querySelectorAll("[data-panel]")) e.hidden = !m.facts.panels.includes(e.dataset.panel);
  },
  state: (m) => {
    if (m.state) $("time").textContent = `${m.state.time_s.toFixed(1)} s`;
    if (m.frame) $("epoch").textContent = m.frame.epoch;
    if (m.state) $("top-frames").textContent = `${m.state.rates.frames_hz.toFixed(0)} Hz`;
    $("connection").textContent = m.online ? "live" : "console restarts…";
    $("connection").dataset.state = m.online ? "ready" : "stopped";
  },
};

model.panels = [top, views, tool, picture, transfer, new Breath(model), new Charts(), new Services()];

model.link = new Link({
  onOpen: () => { model.online = true; model.changed(); },
  onClose: () => { model.online = false; tool.lost(); model.changed(); },
  onText: (message) => {
    if (message.type === "hello") {
      const first = !model.facts;
      model.facts = message.facts;
      model.presets = message.presets;
      model.pointsMax = message.transfer_points_max;
      if (first || performance.now() - model.editedAt > OWN_EDIT_MS) model.view = message.view;
      for (const panel of model.panels) panel.hello?.(model);
    } else if (message.type === "state") {
      model.state = message;
      if (performance.now() - model.editedAt > OWN_EDIT_MS) model.view = message.view;
    }
    model.changed();
  },
  onFrame: async (frame) => {
    await views.show(frame);
    model.frame = frame;
    model.frameAt = performance.now();
    document.body.dataset.frames = Number(document.body.dataset.frames) + 1;
  },
});

// Keys. A text field keeps its own.
addEventListener("keydown", (e) => {
  if (e.ctrlKey || e.altKey || e.metaKey || e.target.matches("input[type=number]") || $("help").open || !model.view) return;
  const slice = { ArrowUp: 1, ArrowDown: -1 }[e.key];
  const act = {
    v: () => model.edit({ mode: 1 - model.view.mode }),
    c: () => model.edit({ camera: 1 - model.view.camera }),
    f: () => model.edit({ sections_follow_tool: !model.view.sections_follow_tool }),
    r: () => mouse.resetCamera(),
    t: () => tool.toggle(),
    u: () => tool.undo(),
    b: () => { if (model.facts.breathing) $("breath-hold").click(); },
    Escape: () => tool.release(),
    "[": () => model.edit({ threshold_hu: model.view.threshold_hu - 10, mode: 1 }),
    "]": () => model.edit({ threshold_hu: model.view.threshold_hu + 10, mode: 1 }),
    "?": () => $("help").showModal(),
  }[e.key.length === 1 ? e.key.toLowerCase() : e.key];
  if (act) { act(); e.preventDefault(); }
  else if (slice && !e.target.matches("input") && mouse.moveSlice(slice)) e.preventDefault();
});
$("help-button").onclick = () => $("help").showModal();
