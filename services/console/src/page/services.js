// Panel "Services": what runs, and how well.

const $ = (id) => document.getElementById(id);
const time = (us) => (us >= 1000 ? `${(us / 1000).toFixed(1)} ms` : `${us.toFixed(0)} µs`);

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
      cell(s.p50_us > 0 ? `${time(s.p50_us)} / ${time(s.p99_us)}` : "–").title = s.p50_us > 0 ? `largest ${time(s.max_us)}, ${s.overruns} overruns` : "";
      return row;
    }));
    $("refused").textContent = state.refused > 0 ? `${state.refused} requests refused` : "";
  }
}
