// What the mouse does in a view: turn, shift and zoom the camera; move sections, window and level; drag the tool.

import { PLANES, add, sub, norm, unit, cross, rotate, dot, clamp } from "/geometry.js";

const TURN = 0.008; // radians a screen pixel
const STEEPEST = 0.985; // cosine between view and up that is not passed

export class Mouse {
  constructor(model, views, tool) {
    Object.assign(this, { model, views, tool });
    for (const view of views.list) this.listen(view);
  }

  listen(view) {
    const { element } = view;
    let drag = null;
    element.oncontextmenu = (e) => e.preventDefault();
    element.onpointerenter = () => { this.over = view; };
    element.onpointerdown = (e) => {
      if (!this.model.view) return;
      element.focus({ preventScroll: true });
      const tool = e.button === 0 && (e.shiftKey || this.tool.locked) && this.tool.take();
      drag = { what: tool ? "tool" : e.button === 0 ? "main" : "second", at: view.at(e), x: e.clientX, y: e.clientY };
      element.setPointerCapture(e.pointerId);
      if (drag.what === "main" && view.isSection) this.pointAt(view, drag.at);
      e.preventDefault();
    };
    element.onpointermove = (e) => {
      if (!drag) return;
      const at = view.at(e), picture = [at[0] - drag.at[0], at[1] - drag.at[1]], screen = [e.clientX - drag.x, e.clientY - drag.y];
      if (drag.what === "tool") this.dragTool(view, picture);
      else if (view.isSection) drag.what === "main" ? this.pointAt(view, at) : this.window(screen);
      else if (this.model.view.camera === 0) drag.what === "main" ? this.turn(screen) : this.shift(view, picture);
      Object.assign(drag, { at, x: e.clientX, y: e.clientY });
    };
    element.onpointerup = element.onpointercancel = () => { if (drag?.what === "tool") this.tool.drop(); drag = null; };
    element.ondblclick = () => { if (!view.isSection) this.resetCamera(); };
    element.addEventListener("wheel", (e) => {
      if (!this.model.view) return;
      e.preventDefault();
      const notches = -(e.deltaY || e.deltaX) / (e.deltaMode === 1 ? 3 : 100); // Shift turns the wheel sideways
      if (this.model.held && (e.shiftKey || e.ctrlKey)) this.pushTool(view, notches);
      else if (view.isSection) this.moveSlice(Math.sign(notches) * Math.max(1, Math.round(Math.abs(notches))), view);
      else if (this.model.view.camera === 0) this.zoom(notches);
    }, { passive: false });
  }

  // Sections

  pointAt(view, [x, y]) {
    const { sections_mm, sections_follow_tool } = this.model.view, tip = this.model.state?.tool?.tip_mm;
    const stand = sections_follow_tool && tip ? tip : sections_mm;
    const p = view.map().position(x, y, stand[PLANES[view.name].normal]);
    this.model.edit({ sections_mm: this.inside(p), sections_follow_tool: false });
  }

  // One slice is the spacing along the patient axis that is nearest to it.
  moveSlice(count, view = this.over) {
    if (!view?.isSection || !this.model.view) return false;
    const c = PLANES[view.name].normal, { facts } = this.model, at = [...this.model.view.sections_mm];
    if (this.model.view.sections_follow_tool && this.model.state?.tool) at.splice(0, 3, ...this.model.state.tool.tip_mm);
    at[c] += count * Math.min(...facts.spacing_mm);
    this.model.edit({ sections_mm: this.inside(at), sections_follow_tool: false });
    return true;
  }

  inside(p) { const { low_mm, high_mm } = this.model.facts; return p.map((v, c) => clamp(v, low_mm[c], high_mm[c])); }

  window([dx, dy]) {
    const v = this.model.view, fine = Math.max(v.window_width_hu / 400, 0.5);
    this.model.edit({ window_width_hu: clamp(v.window_width_hu + dx * fine, 10, 4000), window_center_hu: clamp(v.window_center_hu - dy * fine, -1000, 3000) });
  }

  // Camera

  turn([dx, dy]) {
    const v = this.model.view, up = unit(v.up);
    let arm = rotate(sub(v.eye_mm, v.target_mm), up, -dx * TURN);
    const tilted = rotate(arm, unit(cross(up, arm)), -dy * TURN);
    if (Math.abs(dot(unit(tilted), up)) < STEEPEST) arm = tilted;
    this.model.edit({ eye_mm: add(v.target_mm, arm) });
  }

  shift(view, [dx, dy]) {
    const v = this.model.view, step = view.map().step(-dx, -dy, norm(sub(v.eye_mm, v.target_mm)));
    this.model.edit({ eye_mm: add(v.eye_mm, step), target_mm: add(v.target_mm, step) });
  }

  zoom(notches) {
    const v = this.model.view, arm = sub(v.eye_mm, v.target_mm), { low_mm, high_mm } = this.model.facts;
    const length = clamp(norm(arm) * Math.exp(-0.12 * notches), 2, 12 * norm(sub(high_mm, low_mm)));
    this.model.edit({ eye_mm: add(v.target_mm, unit(arm), length) });
  }

  hello({ view }) { this.first ??= structuredClone(view); }

  resetCamera() {
    const { eye_mm, target_mm, up, fov_deg } = this.first ?? this.model.view;
    this.model.edit({ eye_mm, target_mm, up, fov_deg, camera: 0 });
  }

  // Tool: in a section's plane, or parallel to the screen at the tip's depth

  dragTool(view, [dx, dy]) {
    const map = view.map(), { held, facts, view: state } = this.model;
    if (!held) return;
    if (view.isSection) return this.tool.move(map.step(dx, dy));
    // at the tip itself there is no depth: a hundredth of the box is a comfortable hand
    const depth = state.camera === 1 ? norm(sub(facts.high_mm, facts.low_mm)) / 10 : map.pixel(held)?.[2];
    if (depth) this.tool.move(map.step(dx, dy, depth));
  }

  pushTool(view, notches) { this.tool.move(view.map().forward.map((v) => v * notches)); }
}
