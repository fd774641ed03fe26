// Panel "Transfer function": colour and opacity over HU, points to be dragged.
//
// The HU axis is stretched where tissue lies. Opacity is over 1 mm and drawn by its square root, so that thin veils can be seen.

import { clamp } from "/geometry.js";

const $ = (id) => document.getElementById(id);
const KNOTS = [[-1024, 0], [-200, 0.22], [400, 0.68], [1500, 0.9], [3071, 1]];
const TICKS = [-1000, -200, 0, 200, 400, 1000, 3000];
const LINE = 15; // pixels for the ticks
const EDGE = 6;
const GRIP = 9;

const along = (v, from, to) => {
  const n = KNOTS.findIndex((k, i) => i > 0 && (v <= k[from] || i === KNOTS.length - 1));
  const [a, b] = [KNOTS[n - 1], KNOTS[n]];
  return a[to] + ((v - a[from]) / (b[from] - a[from])) * (b[to] - a[to]);
};

export class TransferEditor {
  constructor(model) {
    this.model = model; this.chosen = -1;
    this.canvas = $("transfer");
    const c = this.canvas;
    c.onpointerdown = (e) => { this.chosen = this.hit(e); this.dragging = this.chosen >= 0; if (this.dragging) c.setPointerCapture(e.pointerId); this.state(); };
    c.onpointermove = (e) => { if (this.dragging) this.drag(e); else c.classList.toggle("grip", this.hit(e) >= 0); };
    c.onpointerup = c.onpointercancel = () => { this.dragging = false; };
    c.ondblclick = (e) => this.addOrRemove(e);
    c.onkeydown = (e) => { if (e.key === "Delete" || e.key === "Backspace") this.remove(this.chosen); };
    $("transfer-color").oninput = (e) => this.colour(e.target.value);
    addEventListener("resize", () => this.state());
  }

  hello({ presets, facts }) {
    const choices = facts.transfer_points.length > 0 && !presets.some((p) => p.name === facts.transfer)
      ? [{ name: "", label: "Scene's", points: facts.transfer_points }, ...presets] : presets;
    if (this.choices?.length === choices.length) return;
    this.choices = choices;
    $("presets").replaceChildren(...choices.map((p) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: p.label });
      button.onclick = () => { this.chosen = -1; this.model.edit({ transfer: structuredClone(p.points) }); };
      return button;
    }));
  }

  // The points in use: those sent, else the scene's own.
  points() {
    const { view, facts } = this.model;
    if (!view || !facts) return [];
    if (view.transfer.length > 0) return view.transfer;
    if (facts.transfer_points.length > 0) return facts.transfer_points;
    return this.model.presets.find((p) => p.name === facts.transfer)?.points ?? [];
  }

  size() { const { clientWidth: w, clientHeight: h } = this.canvas; return { w, h: h - LINE }; }
  x(hu) { return EDGE + along(hu, 0, 1) * (this.size().w - 2 * EDGE); }
  y(a) { const { h } = this.size(); return h - 4 - Math.sqrt(a) * (h - 12); }
  hu(x) { return clamp(along(clamp((x - EDGE) / (this.size().w - 2 * EDGE), 0, 1), 1, 0), -1024, 3071); }
  alpha(y) { const { h } = this.size(); return clamp((h - 4 - y) / (h - 12), 0, 1) ** 2; }

  hit(e) {
    const near = this.points().map((p) => Math.hypot(this.x(p[0]) - e.offsetX, this.y(p[4]) - e.offsetY));
    const n = near.indexOf(Math.min(...near));
    return near[n] < GRIP ? n : -1;
  }

  edit(points) { this.model.edit({ transfer: points }); }

  drag(e) {
    const points = structuredClone(this.points()), n = this.chosen;
    const low = n > 0 ? points[n - 1][0] + 1 : -1024, high = n < points.length - 1 ? points[n + 1][0] - 1 : 3071;
    points[n][0] = clamp(Math.round(this.hu(e.offsetX)), low, high);
    points[n][4] = this.alpha(e.offsetY);
    this.edit(points);
  }

  addOrRemove(e) {
    const n = this.hit(e), points = structuredClone(this.points());
    if (n >= 0) return this.remove(n);
    if (points.length >= this.model.pointsMax) return;
    const hu = Math.round(this.hu(e.offsetX)), after = points.findIndex((p) => p[0] > hu), at = after < 0 ? points.length : after;
    if (points.some((p) => p[0] === hu)) return;
    const [a, b] = [points[Math.max(at - 1, 0)], points[Math.min(at, points.length - 1)]];
    const t = b[0] > a[0] ? clamp((hu - a[0]) / (b[0] - a[0]), 0, 1) : 0;
    points.splice(at, 0, [hu, ...[1, 2, 3].map((c) => a[c] + t * (b[c] - a[c])), this.alpha(e.offsetY)]);
    this.chosen = at;
    this.edit(points);
  }

  remove(n) {
    const points = structuredClone(this.points());
    if (n < 0 || points.length <= 2) return;
    points.splice(n, 1);
    this.chosen = -1;
    this.edit(points);
  }

  colour(hex) {
    const points = structuredClone(this.points());
    if (!points[this.chosen]) return;
    [1, 3, 5].forEach((at, c) => { points[this.chosen][c + 1] = parseInt(hex.slice(at, at + 2), 16) / 255; });
    this.edit(points);
  }

  state() {
    const points = this.points(), same = (a, b) => a.length === b.length && a.flat().every((v, i) => Math.abs(v - b.flat()[i]) < 1e-9);
    [...$("presets").children].forEach((b, n) => b.setAttribute("aria-pressed", same(points, this.choices[n].points)));
    const chosen = points[this.chosen];
    $("transfer-color").disabled = !chosen;
    if (chosen) $("transfer-color").value = `#${chosen.slice(1, 4).map((v) => Math.round(v * 255).toString(16).padStart(2, "0")).join("")}`;
    $("transfer-hint").textContent = chosen ? `${chosen[0]} HU · opacity ${chosen[4].toFixed(3)} over 1 mm` : "Drag points · double-click adds or removes one";
    const volume = !this.model.view?.mode;
    $("transfer-name").textContent = volume ? "" : "volume only";
    const key = JSON.stringify([points, this.chosen, this.model.view?.threshold_hu, this.canvas.clientWidth]);
    if (key !== this.drawn) { this.drawn = key; this.draw(points); }
  }

  draw(points) {
    const ratio = devicePixelRatio || 1, c = this.canvas, { w, h } = this.size();
    c.width = Math.round(c.clientWidth * ratio); c.height = Math.round(c.clientHeight * ratio);
    const g = c.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.font = "10px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "top";
    for (const t of TICKS) {
      const x = this.x(t);
      g.strokeStyle = "#1c242b"; g.beginPath(); g.moveTo(x, 0); g.lineTo(x, h); g.stroke();
      g.fillStyle = "#8593a0"; g.fillText(t, clamp(x, 14, w - 14), h + 3);
    }
    if (points.length > 1) {
      // the area under the curve, in the curve's own colours
      for (let x = EDGE; x < w - EDGE; x++) {
        const hu = this.hu(x), n = points.findIndex((p) => p[0] >= hu);
        if (n === 0 && points[0][0] > hu) continue;
        const b = points[n < 0 ? points.length - 1 : n], a = points[n <= 0 ? (n < 0 ? points.length - 1 : 0) : n - 1];
        const t = b[0] > a[0] ? (hu - a[0]) / (b[0] - a[0]) : 0;
        const [r, gr, bl, al] = [1, 2, 3, 4].map((k) => a[k] + t * (b[k] - a[k]));
        g.fillStyle = `rgb(${r * 255} ${gr * 255} ${bl * 255} / .8)`;
        const y = this.y(al);
        g.fillRect(x, y, 1, h - y);
      }
    }
    const threshold = this.model.view?.threshold_hu;
    if (threshold !== undefined) {
      g.strokeStyle = "#f0a64a"; g.setLineDash([3, 3]); g.beginPath(); g.moveTo(this.x(threshold), 0); g.lineTo(this.x(threshold), h); g.stroke(); g.setLineDash([]);
    }
    g.strokeStyle = "#d7dee5"; g.lineWidth = 1.2; g.beginPath();
    points.forEach((p, n) => g[n ? "lineTo" : "moveTo"](this.x(p[0]), this.y(p[4])));
    g.stroke();
    points.forEach((p, n) => {
      g.beginPath(); g.arc(this.x(p[0]), this.y(p[4]), n === this.chosen ? 6 : 4.5, 0, 7);
      g.fillStyle = `rgb(${p[1] * 255} ${p[2] * 255} ${p[3] * 255})`; g.fill();
      g.strokeStyle = n === this.chosen ? "#5cc8c2" : "#eef3f6"; g.lineWidth = n === this.chosen ? 2 : 1.2; g.stroke();
    });
  }
}
