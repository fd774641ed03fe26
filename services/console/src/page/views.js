// The views: the newest picture, and over it what the page knows better than the picture (letters, lines, tool, scale).

import { PLANES, SectionMap, CameraMap, letter, add, dot } from "/geometry.js";

const TITLES = { "3d": "3D", axial: "Axial", coronal: "Coronal", sagittal: "Sagittal", ultrasound: "Ultrasound", "x-ray": "X-ray" };
const AXIS_COLOURS = ["#e57373", "#81c784", "#64b5f6"]; // sagittal x, coronal y, axial z
const SILENT_MS = 1000;

export class Views {
  constructor(model) {
    this.model = model;
    this.list = [...document.querySelectorAll(".view")].map((element) => new View(element, model));
    this.byName = Object.fromEntries(this.list.map((v) => [v.name, v]));
    addEventListener("resize", () => this.draw());
    setInterval(() => this.notice(), 250);
  }

  async show(frame) {
    await Promise.all(Object.entries(frame.views).map(async ([name, v]) => this.byName[name].put(await createImageBitmap(v.jpeg))));
    for (const view of this.list) if (!(view.name in frame.views)) view.clear();
    this.draw();
  }

  // What the scene does not call for has no place.
  hello({ facts }) { for (const v of this.list) if (!facts.panels.includes(v.name)) v.element.hidden = true; }

  state() { this.draw(); }
  draw() {
    if (this.scheduled) return;
    this.scheduled = requestAnimationFrame(() => { this.scheduled = 0; for (const v of this.list) v.draw(); });
  }

  // What to say over a picture that stands still.
  notice() {
    const { model } = this, rendering = model.service("rendering");
    let text = "";
    if (!model.online) text = model.facts ? "console restarts…" : "connecting…";
    else if (rendering && rendering.state !== "ready") text = rendering.state === "ended" ? "rendering has ended" : "rendering restarts…";
    else if (performance.now() - model.frameAt > SILENT_MS) text = model.frame ? "waiting for rendering…" : "waiting for the first picture…";
    const shown = text && model.frame ? `${text} last picture shown` : text;
    for (const v of this.list) v.notice.textContent = v.name === "3d" ? shown : text;
  }
}

export class View {
  constructor(element, model) {
    this.element = element; this.model = model; this.name = element.dataset.view;
    const make = (tag, className) => { const e = document.createElement(tag); e.className = className; element.append(e); return e; };
    this.image = make("canvas", "image");
    this.image.id = `image-${this.name}`;
    this.overlay = make("canvas", "overlay");
    this.title = make("div", "title");
    this.note = make("div", "note");
    this.notice = make("div", "notice");
    this.image.width = 4; this.image.height = 3;
    this.pixels = this.image.getContext("2d", { willReadFrequently: false });
  }

  put(bitmap) {
    if (this.image.width !== bitmap.width || this.image.height !== bitmap.height) { this.image.width = bitmap.width; this.image.height = bitmap.height; }
    this.pixels.drawImage(bitmap, 0, 0);
    this.element.hidden = false; // a view that few scenes have is there once it has a picture
    bitmap.close();
  }

  // The scene has no such view, or it is switched off: nothing of it is kept, and its place goes to the others.
  clear() {
    if (this.image.width > 4) { this.image.width = 4; this.image.height = 3; }
    this.element.hidden = this.name !== "3d";
  }

  get isSection() { return this.name in PLANES; }

  // The fan of a probe, and a radiograph: nothing is drawn over them, and the mouse does nothing in them.
  get isPlain() { return this.element.classList.contains("plain"); }

  // Mapping between patient and the picture's pixels.
  map() {
    const { facts, view, state } = this.model, { width, height } = this.image;
    if (this.isSection) return new SectionMap(this.name, facts.low_mm, facts.high_mm, width, height);
    if (view.camera === 1 && state?.tool) {
      const { tip_mm, direction } = state.tool;
      const up = Math.abs(direction[2]) > 0.99 ? [0, -1, 0] : [0, 0, 1];
      return new CameraMap({ eye: tip_mm, target: add(tip_mm, direction), up, fov: facts.endoscope_fov_deg }, width, height);
    }
    return new CameraMap({ eye: view.eye_mm, target: view.target_mm, up: view.up, fov: view.fov_deg }, width, height);
  }

  // How the picture lies in the element: it is fitted, with black bars.
  fit() {
    const box = this.element.getBoundingClientRect();
    const scale = Math.min(box.width / this.image.width, box.height / this.image.height) || 1;
    return { scale, left: (box.width - this.image.width * scale) / 2, top: (box.height - this.image.height * scale) / 2, box };
  }

  // Pixel of the picture under a mouse event.
  at(event) {
    const { scale, left, top, box } = this.fit();
    return [(event.clientX - box.left - left) / scale - 0.5, (event.clientY - box.top - top) / scale - 0.5];
  }

  // Where this section lies along its normal [mm].
  position() {
    const { view, state } = this.model, c = PLANES[this.name].normal;
    return view.sections_follow_tool && state?.tool ? state.tool.tip_mm[c] : view.sections_mm[c];
  }

  draw() {
    const { facts, view } = this.model;
    if (!facts || !view) return;
    const ratio = devicePixelRatio || 1, { scale, left, top, box } = this.fit();
    const [w, h] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
    if (this.overlay.width !== w || this.overlay.height !== h) { this.overlay.width = w; this.overlay.height = h; }
    const g = this.overlay.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, box.width, box.height);
    g.font = "600 12px system-ui, sans-serif";
    if (this.isPlain) return void this.title.replaceChildren(TITLES[this.name]);
    const map = this.map();
    const screen = ([x, y]) => [(x + 0.5) * scale + left, (y + 0.5) * scale + top];
    if (this.isSection) { this.lines(g, map, screen, box); this.scaleBar(g, scale / map.mm, box); }
    this.letters(g, map, box);
    this.tool(g, map, screen, scale);
    this.words();
  }

  words() {
    const { view, frame } = this.model;
    let small = "";
    if (this.isSection) {
      const c = PLANES[this.name].normal;
      small = `${"xyz"[c]} = ${this.position().toFixed(1)} mm`;
      this.note.textContent = `C ${view.window_center_hu.toFixed(0)} · W ${view.window_width_hu.toFixed(0)} HU`;
    } else {
      small = `${view.mode ? `surface at ${view.threshold_hu.toFixed(0)} HU` : "volume"}${view.camera ? " · at the endoscope's tip" : ""}`;
      this.note.textContent = frame ? `${this.image.width} × ${this.image.height} · ${frame.renderMs.toFixed(1)} ms` : "";
    }
    this.title.replaceChildren(TITLES[this.name], Object.assign(document.createElement("small"), { textContent: small }));
  }

  // The other two sections cross this one.
  lines(g, map, screen, box) {
    const { view, state } = this.model;
    const at = view.sections_follow_tool && state?.tool ? state.tool.tip_mm : view.sections_mm;
    const [x, y] = screen(map.pixel(at));
    const axis = (d) => d.findIndex((v) => v !== 0);
    g.lineWidth = 1;
    for (const [colour, from, to] of [[AXIS_COLOURS[axis(map.right)], [x, 0], [x, box.height]], [AXIS_COLOURS[axis(map.down)], [0, y], [box.width, y]]]) {
      g.strokeStyle = colour; g.globalAlpha = 0.45;
      g.beginPath(); g.moveTo(...from); g.lineTo(...to); g.stroke();
    }
    g.globalAlpha = 1;
    // the frame's corner says which line elsewhere is this section
    g.fillStyle = AXIS_COLOURS[map.normal];
    g.fillRect(0, 0, 3, 22);
  }

  letters(g, map, box) {
    const down = map.down ?? map.up.map((v) => -v);
    const flip = (d) => d.map((v) => -v);
    g.fillStyle = "#e9dfa8"; g.shadowColor = "#000"; g.shadowBlur = 3; g.textAlign = "center"; g.textBaseline = "middle";
    g.fillText(letter(flip(map.right)), 12, box.height / 2);
    g.fillText(letter(map.right), box.width - 12, box.height / 2);
    g.fillText(letter(flip(down)), box.width / 2, 13);
    g.fillText(letter(down), box.width / 2, box.height - 12);
    g.shadowBlur = 0;
  }

  scaleBar(g, pixelsPerMm, box) {
    const mm = [100, 50, 20, 10, 5, 2, 1].find((v) => v * pixelsPerMm < box.width * 0.25);
    if (!mm) return;
    const length = mm * pixelsPerMm, right = box.width - 10, y = box.height - 9;
    g.strokeStyle = g.fillStyle = "#d7dee5"; g.lineWidth = 1.5; g.textAlign = "right"; g.textBaseline = "bottom";
    g.beginPath(); g.moveTo(right - length, y - 4); g.lineTo(right - length, y); g.lineTo(right, y); g.lineTo(right, y - 4); g.stroke();
    g.font = "10px system-ui, sans-serif";
    g.fillText(`${mm} mm`, right, y - 4);
    g.font = "600 12px system-ui, sans-serif";
  }

  tool(g, map, screen, scale) {
    const { view, state, held } = this.model, tool = state?.tool;
    if (!tool || (!this.isSection && view.camera === 1)) return;
    const colour = tool.taken_over || held ? "#f0a64a" : tool.in_contact ? "#5cc8c2" : "#e8eef3";
    const tip = map.pixel(tool.tip_mm);
    if (!tip) return;
    const perMm = this.isSection ? scale / map.mm : (scale * map.focal) / tip[2];
    const [x, y] = screen(tip), radius = Math.max(3, tool.radius_mm * perMm);
    const away = this.isSection ? Math.abs(tool.tip_mm[map.normal] - this.position()) : 0;
    g.globalAlpha = away > 2 * tool.radius_mm ? 0.4 : 1;
    g.strokeStyle = g.fillStyle = colour; g.lineWidth = 1.6;
    const back = this.isSection && map.pixel(add(tool.tip_mm, tool.direction, -40)); // the 3D picture has the shaft itself
    if (back) { g.beginPath(); g.moveTo(x, y); g.lineTo(...screen(back)); g.globalAlpha *= 0.7; g.stroke(); g.globalAlpha /= 0.7; }
    if (this.isSection) { g.beginPath(); g.arc(x, y, radius, 0, 7); g.stroke(); }
    g.beginPath(); g.arc(x, y, 1.5, 0, 7); g.fill();
    // the force on the hand, 10 mm a newton
    const end = map.pixel(add(tool.tip_mm, tool.force_n, 10));
    if (end && dot(tool.force_n, tool.force_n) > 1e-4) { g.strokeStyle = "#f0655b"; g.lineWidth = 2; g.beginPath(); g.moveTo(x, y); g.lineTo(...screen(end)); g.stroke(); }
    if (held) {
      const target = map.pixel(held);
      if (target) { const [tx, ty] = screen(target); g.strokeStyle = "#f0a64a"; g.lineWidth = 1.5; g.beginPath(); g.moveTo(tx - 7, ty); g.lineTo(tx + 7, ty); g.moveTo(tx, ty - 7); g.lineTo(tx, ty + 7); g.stroke(); }
    }
    g.globalAlpha = 1;
  }
}
