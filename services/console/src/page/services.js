// Panel "Services": what runs, and how well.

const $ = (id) => document.getElementById(id);
// Times in one unit, the last one's.
const times = (...us) => {
  const ms = us.at(-1) >= 1000;
  return `${us.map((v) => (ms ? v / 1000 : v)).map((v) => v.toFixed(v < 10 ? 1 : 0)).join(" / ")} ${ms ? "ms" : "µs"}`;
};

export class Services {
  hello({ facts }) { $("domain").textContent = facts.domain; }

  state({ state, online }) {
    if (!state || (state === this.seen && online === this.online)) return;
    this.seen = state; this.online = online;
    $("services").tBodies[0].replaceChildren(...state.services.map((s) => {
      const row = document.createElement("tr");
      const shown = online ? s.state : "unknown";
      const cell = (text, className = "n") => { const td = row.insertCell(); td.textContent = text; td.className = className; return td; };
      cell(s.role, "");
      cell(shown, "state").dataset.state = shown;
      cell(s.pid || "–"); cell(s.restarts);
      cell(s.p50_us > 0 ? times(s.p50_us, s.p99_us) : "–").title = s.p50_us > 0 ? `largest ${times(s.max_us)}, ${s.overruns} overruns` : "";
      return row;
    }));
    const given = state.given_up;
    $("governor").hidden = !given;
    if (given) $("governor").textContent = "accuracy auto: " + (given.map(([knob, value]) => `${knob} = ${+value.toPrecision(3)}`).join(", ") || "nothing given up");
    $("refused").textContent = state.refused > 0 ? `${state.refused} requests refused` : "";
  }
}
