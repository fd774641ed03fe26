// Charts: force over the last ten seconds, and the rates of the three loops over the last thirty.

const $ = (id) => document.getElementById(id);

class Chart {
  constructor(id, { seconds, colour, floor = 1, limit }) {
    Object.assign(this, { canvas: $(id), seconds, colour, floor, limit, points: [] });
  }

  push(time, value) {
    const last = this.points.at(-1);
    if (last && time < last[0]) this.points = []; // a new run
    if (!last || time > last[0]) this.points.push([time, value]);
    while (this.points.length > 2 && this.points[1][0] < time - this.seconds) this.points.shift();
  }

  draw(now) {
    const c = this.canvas, ratio = devicePixelRatio || 1, [w, h] = [c.clientWidth, c.clientHeight];
    if (!w || !h) return;
    if (c.width !== Math.round(w * ratio) || c.height !== Math.round(h * ratio)) { c.width = Math.round(w * ratio); c.height = Math.round(h * ratio); }
    const g = c.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    const highest = Math.max(this.floor, this.limit ?? 0, ...this.points.map((p) => p[1]));
    const top = niceTop(highest), left = 34, bottom = h - 12;
    const x = (t) => left + (1 - (now - t) / this.seconds) * (w - left - 2), y = (v) => bottom - (v / top) * (bottom - 5);
    g.font = "10px system-ui, sans-serif"; g.fillStyle = "#8593a0"; g.strokeStyle = "#222a31"; g.lineWidth = 1;
    g.textAlign = "right"; g.textBaseline = "middle";
    for (const v of [0, top / 2, top]) {
      g.fillText(Number(v.toPrecision(3)), left - 5, y(v));
      g.beginPath(); g.moveTo(left, Math.round(y(v)) + 0.5); g.lineTo(w, Math.round(y(v)) + 0.5); g.stroke();
    }
    g.textBaseline = "bottom"; g.textAlign = "left"; g.fillText(`−${this.seconds} s`, left, h + 1);
    g.textAlign = "right"; g.fillText("now", w - 2, h + 1);
    if (this.limit) { g.strokeStyle = "#f0655b"; g.globalAlpha = 0.5; g.setLineDash([4, 4]); g.beginPath(); g.moveTo(left, y(this.limit)); g.lineTo(w, y(this.limit)); g.stroke(); g.setLineDash([]); g.globalAlpha = 1; }
    if (this.points.length < 2) return;
    g.save();
    g.beginPath(); g.rect(left, 0, w - left, h); g.clip();
    g.beginPath();
    for (const [t, v] of this.points) g.lineTo(x(t), y(v));
    g.strokeStyle = this.colour; g.lineWidth = 1.5; g.lineJoin = "round"; g.stroke();
    g.lineTo(x(this.points.at(-1)[0]), bottom); g.lineTo(x(this.points[0][0]), bottom); g.closePath();
    g.globalAlpha = 0.14; g.fillStyle = this.colour; g.fill();
    g.restore();
  }
}

function niceTop(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10].find((m) => m * power >= value * 0.999);
}

export class Charts {
  constructor() {
    this.force = new Chart("chart-force", { seconds: 10, colour: "#f0655b", floor: 0.5 });
    this.haptic = new Chart("chart-haptic", { seconds: 30, colour: "#5cc8c2", floor: 100 });
    this.commits = new Chart("chart-commits", { seconds: 30, colour: "#f0a64a", floor: 10 });
    this.frames = new Chart("chart-frames", { seconds: 30, colour: "#64b5f6", floor: 10 });
  }

  hello({ facts }) { this.force.limit = facts.max_force_n || undefined; }

  state({ state }) {
    if (!state || state === this.seen) return;
    this.seen = state;
    for (const [t, f] of state.force) this.force.push(t, f);
    const r = state.rates, now = state.time_s;
    this.haptic.push(now, r.haptic_hz); this.commits.push(now, r.commits_hz); this.frames.push(now, r.frames_hz);
    for (const c of [this.force, this.haptic, this.commits, this.frames]) c.draw(now);
    const force = state.force.at(-1)?.[1] ?? this.force.points.at(-1)?.[1];
    if (force !== undefined) $("force-now").textContent = `${force.toFixed(2)} N`;
    $("haptic-now").textContent = `${r.haptic_hz.toFixed(0)} Hz · tick ${r.tick_p50_us.toFixed(0)} / ${r.tick_p99_us.toFixed(0)} µs`;
    $("haptic-now").title = `median and 99th percentile; ${r.overruns} overruns`;
    $("commits-now").textContent = `${r.commits_hz.toFixed(0)} /s`;
    $("frames-now").textContent = `${r.frames_hz.toFixed(0)} /s`;
  }
}
