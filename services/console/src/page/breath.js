// The breath: how deep it is, its place in the cycle, and who leads it.

const $ = (id) => document.getElementById(id);
const SECONDS = 15;

export class Breath {
  constructor(model) {
    this.model = model;
    this.points = [];
    this.held = false;
    this.level = null; // what the slider asks for while it leads
    $("breath-hold").onclick = () => this.say({ held: !this.held });
    $("breath-free").onclick = () => this.say({ held: false, level: null });
    $("breath-level").addEventListener("input", (e) => this.say({ held: false, level: e.target.valueAsNumber }));
  }

  say(change) {
    Object.assign(this, change);
    this.saidAt = performance.now();
    this.model.link.send({ type: "breath", held: this.held, level: this.level });
    this.show();
  }

  hello({ facts }) {
    $("panel-breath").hidden = !facts.breathing;
    if (facts.breathing) $("breath-name").textContent = facts.breathing;
  }

  show() {
    $("breath-hold").setAttribute("aria-pressed", this.held);
    $("breath-hold").textContent = this.held ? "Breathe on" : "Hold the breath";
    $("breath-free").disabled = this.level === null && !this.held;
  }

  state({ state }) {
    const breath = state?.breath;
    if (!breath || state === this.seen) return;
    this.seen = state;
    // somebody else's word counts when this page has said nothing for a while
    if (performance.now() - (this.saidAt ?? -Infinity) > 500) {
      this.held = breath.held;
      if (!breath.led) this.level = null;
      else if (this.level === null) this.level = breath.level;
    }
    const last = this.points.at(-1);
    if (last && state.time_s < last[0]) this.points = [];
    this.points.push([state.time_s, breath.level]);
    while (this.points[0][0] < state.time_s - SECONDS) this.points.shift();
    if (document.activeElement !== $("breath-level") || this.level === null) $("breath-level").value = breath.level;
    $("breath-now").textContent = `${(100 * breath.level).toFixed(0)} %`;
    const word = breath.held ? "held" : breath.led ? "led" : breath.rate > 0.05 ? "in" : breath.rate < -0.05 ? "out" : "rest";
    $("breath-state").textContent = `${word} · phase ${breath.phase.toFixed(2)}`;
    document.body.dataset.breath = word;
    document.body.dataset.level = breath.level.toFixed(4);
    this.show();
    this.draw(state.time_s, breath);
  }

  draw(now, breath) {
    const c = $("breath-trace"), ratio = devicePixelRatio || 1, [w, h] = [c.clientWidth, c.clientHeight];
    if (!w || !h) return;
    if (c.width !== Math.round(w * ratio) || c.height !== Math.round(h * ratio)) { c.width = Math.round(w * ratio); c.height = Math.round(h * ratio); }
    const g = c.getContext("2d"), low = -0.4, high = 1.4, right = w - h - 6;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    const x = (t) => right * (1 - (now - t) / SECONDS), y = (v) => h - 3 - ((v - low) / (high - low)) * (h - 6);
    g.strokeStyle = "#2a333c"; g.lineWidth = 1;
    for (const v of [0, 1]) { g.beginPath(); g.moveTo(0, Math.round(y(v)) + 0.5); g.lineTo(right, Math.round(y(v)) + 0.5); g.stroke(); }
    g.strokeStyle = "#5cc8c2"; g.lineWidth = 1.5; g.lineJoin = "round";
    g.beginPath();
    for (const [t, v] of this.points) g.lineTo(x(t), y(v));
    g.stroke();
    // the place in the cycle: inspiration's end at the top, round to the right
    const r = h / 2 - 5, cx = w - h / 2, cy = h / 2, a = 2 * Math.PI * breath.phase - Math.PI / 2;
    g.strokeStyle = "#2a333c"; g.beginPath(); g.arc(cx, cy, r, 0, 2 * Math.PI); g.stroke();
    g.fillStyle = breath.held || breath.led ? "#f0a64a" : "#5cc8c2";
    g.beginPath(); g.arc(cx + r * Math.cos(a), cy + r * Math.sin(a), 4, 0, 2 * Math.PI); g.fill();
    g.fillStyle = "#8593a0"; g.font = "9px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "middle";
    g.fillText("in", cx, cy - r + 9); g.fillText("out", cx, cy + r - 9);
  }
}
