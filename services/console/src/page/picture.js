// Panel "Picture": mode, camera, threshold, window, sections.

const $ = (id) => document.getElementById(id);

// For so long after a click the server's word on a switch may be older than the click.
const OWN_SWITCH_MS = 700;

export class Picture {
  switched = {}; // when each effect was switched here

  constructor(model, mouse) {
    this.mouse = mouse;
    const on = (id, event, patch) => $(id).addEventListener(event, (e) => { const p = patch(e.target); if (Object.values(p).every((v) => v === v)) model.edit(p); });
    on("mode-volume", "click", () => ({ mode: 0 }));
    on("mode-surface", "click", () => ({ mode: 1 }));
    on("camera-free", "click", () => ({ camera: 0 }));
    on("camera-tip", "click", () => ({ camera: 1 }));
    // the surface is what shows a threshold, so whoever moves it sees the surface
    on("threshold", "input", (e) => ({ threshold_hu: e.valueAsNumber, mode: 1 }));
    on("threshold-number", "change", (e) => ({ threshold_hu: e.valueAsNumber, mode: 1 }));
    on("window-center", "input", (e) => ({ window_center_hu: e.valueAsNumber }));
    on("window-width", "input", (e) => ({ window_width_hu: e.valueAsNumber }));
    on("follow", "change", (e) => ({ sections_follow_tool: e.checked }));
    // an organ alone is shown as a volume: a surface at one value has none
    on("organ-alone", "change", (e) => (+e.value ? { organ_alone: +e.value, mode: 0 } : { organ_alone: 0 }));
    // effects that the scene lets be switched, as the server names them
    $("effects").addEventListener("change", (e) => {
      this.switched[e.target.name] = performance.now();
      model.link.send({ type: "effect", name: e.target.name, on: e.target.checked });
    });
    $("reset-camera").onclick = () => mouse.resetCamera();
  }

  hello(model) {
    this.mouse.hello(model);
    $("camera-tip").disabled = $("follow").disabled = !model.facts.has_tool;
    $("organs").hidden = model.facts.organs.length === 0;
    $("organ-alone").replaceChildren(...["the whole patient", ...model.facts.organs].map((name, n) => new Option(n ? `${name} alone` : name, n)));
  }

  state({ view, state }) {
    if (!view) return;
    this.effects(state?.effects ?? []);
    const press = (id, on) => $(id).setAttribute("aria-pressed", on);
    press("mode-volume", view.mode === 0); press("mode-surface", view.mode === 1);
    press("camera-free", view.camera === 0); press("camera-tip", view.camera === 1);
    const put = (id, value) => { if (document.activeElement !== $(id) || $(id).type === "range") $(id).value = value; };
    put("organ-alone", view.organ_alone);
    put("threshold", view.threshold_hu); put("threshold-number", Math.round(view.threshold_hu));
    put("window-center", view.window_center_hu); put("window-width", view.window_width_hu);
    $("window-center-now").textContent = `${view.window_center_hu.toFixed(0)} HU`;
    $("window-width-now").textContent = `${view.window_width_hu.toFixed(0)} HU`;
    $("follow").checked = view.sections_follow_tool;
  }

  effects(list) {
    const names = list.map(([name]) => name).join();
    if (names !== this.names) {
      this.names = names;
      $("effects").hidden = list.length === 0;
      $("effects").replaceChildren(...list.map(([name]) => {
        const label = document.createElement("label"), box = document.createElement("input");
        box.type = "checkbox"; box.name = name; box.id = `effect-${name}`;
        label.append(box, ` ${name}`);
        return label;
      }));
    }
    // what was just clicked is not on its way back yet
    for (const [name, on] of list) if (!(performance.now() - this.switched[name] < OWN_SWITCH_MS)) $(`effect-${name}`).checked = on;
  }
}
