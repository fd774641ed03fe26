// The hand: takes the tool, moves it, lets it go. While it holds, it says so ten times a second, or the server lets go.

import { add, clamp } from "/geometry.js";

const $ = (id) => document.getElementById(id);
const SAY_EVERY_MS = 100;
const OUTSIDE_MM = 60; // how far outside the volume's box the hand may go

export class Tool {
  constructor(model) {
    this.model = model;
    this.locked = false; // held by the button or the key, not only while dragging
    $("hold").onclick = () => this.toggle();
    $("undo").onclick = () => this.undo();
    addEventListener("visibilitychange", () => { if (document.hidden) this.release(); });
    setInterval(() => { if (model.held) this.say(); }, SAY_EVERY_MS);
  }

  hello({ facts }) { $("incision").hidden = !facts.incises; }

  // The last stroke of incision is taken back.
  undo() { if (this.model.facts?.incises) this.model.link.send({ type: "undo" }); }

  toggle() { if (this.locked) this.release(); else if (this.take()) { this.locked = true; this.show(); } }

  // Takes the tool where it is; false where there is none.
  take() {
    const tool = this.model.state?.tool;
    if (!this.model.held && tool) this.model.held = [...tool.tip_mm];
    if (this.model.held) this.say();
    this.show();
    return !!this.model.held;
  }

  move(step) {
    const { held, facts } = this.model;
    if (!held) return;
    this.model.held = add(held, step).map((v, c) => clamp(v, facts.low_mm[c] - OUTSIDE_MM, facts.high_mm[c] + OUTSIDE_MM));
    this.moved = true;
  }

  // The end of a drag.
  drop() { if (!this.locked) this.release(); }

  release() {
    if (this.model.held) this.model.link.send({ type: "tool", taken: false });
    this.lost();
  }

  // The connection has gone: the server lets go by itself.
  lost() { this.model.held = null; this.locked = false; this.show(); }

  say() { this.model.link.send({ type: "tool", taken: true, target_mm: this.model.held }); this.moved = false; }

  show() {
    $("hold").setAttribute("aria-pressed", this.locked);
    $("hold").textContent = this.locked ? "Let the tool go" : "Take over the tool";
    for (const v of document.querySelectorAll(".view")) v.classList.toggle("held", !!this.model.held);
  }

  state({ state }) {
    if (this.moved && this.model.held) this.say();
    const tool = state?.tool;
    $("hold").disabled = !tool;
    document.body.dataset.tool = !tool ? "none" : tool.taken_over ? "taken" : "free"; // as the haptic process says
    const pill = $("tool-state");
    [pill.textContent, pill.dataset.state] = !tool ? ["none", "absent"]
      : this.model.held ? ["held here", "held"] : state.held ? ["held by a page", "held"]
      : tool.fading ? ["force fading", "held"] : tool.in_contact ? ["in contact", "contact"] : ["free", "ready"];
    if (tool) {
      $("tool-tip").textContent = `${tool.tip_mm.map((v) => v.toFixed(1)).join(", ")} mm`;
      $("tool-force").textContent = `${Math.hypot(...tool.force_n).toFixed(2)} N`;
      $("tool-depth").textContent = `${tool.penetration_mm.toFixed(2)} mm`;
    }
    const commit = state?.commit;
    if (commit) $("tool-commit").textContent = `${commit.moved_elements} moved · ${commit.bricks} bricks · ${commit.step_ms.toFixed(1)} ms`;
  }
}
