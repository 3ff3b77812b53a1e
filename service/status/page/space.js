// Goals in three dimensions, coloured by difficulty: turned with the pointer, and played over the run.

import { el, note, setText } from "./dom.js";
import { count, counted, percent } from "./format.js";
import { library, onTheme, theme } from "./library.js";

const STEP_MS = 700;
const SIZES = [4, 14];
const SCALE = "Viridis";
const HEIGHT = 420;
const EYE = { x: 1.3, y: -1.56, z: 0.7 }; // so far away that the titles of the axes are in the picture

export class GoalSpace {
  constructor(signal) {
    this.frames = [];
    this.signal = signal;
    this.canvas = el("div", { class: "space", role: "img", "aria-label": "Goals in three dimensions" });
    this.slider = el("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "Part of the run" });
    this.slider.addEventListener("input", () => this.show(Number(this.slider.value)));
    this.button = el("button", { type: "button" }, "Play");
    this.button.addEventListener("click", () => (this.timer ? this.stop() : this.play()));
    this.text = el("output", {});
    const legend = el("p", { class: "scale" }, "dark: Bob never reaches it, yellow: always. Larger: more goals. Drag to turn.");
    this.parts = [el("p", { class: "controls" }, this.button, this.slider, this.text), this.canvas, legend];
    this.root = el("div", {});
    onTheme(() => this.draw(), signal);
    signal.addEventListener("abort", () => {
      this.stop();
      window.Plotly?.purge(this.canvas);
    });
  }

  /** ``frames`` of GoalFrames; the newest is shown, unless another was chosen. */
  update({ frames, cell_size_m: cellSize }) {
    const newest = this.at === undefined || this.at >= this.frames.length - 1;
    Object.assign(this, { frames, cellSize });
    this.slider.max = Math.max(0, frames.length - 1);
    if (!frames.length) return this.root.replaceChildren(note("No goals are recorded yet."));
    if (!this.root.contains(this.canvas)) this.root.replaceChildren(...this.parts); // a run that has just begun had none
    return this.show(newest ? frames.length - 1 : this.at);
  }

  play() {
    setText(this.button, "Pause");
    if (this.at >= this.frames.length - 1) this.show(0);
    this.timer = setInterval(() => (this.at < this.frames.length - 1 ? this.show(this.at + 1) : this.stop()), STEP_MS);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    setText(this.button, "Play");
  }

  show(at) {
    this.at = at;
    this.slider.value = at;
    const frame = this.frames[at];
    const mean = frame.success_rate.reduce((sum, rate, i) => sum + rate * frame.num_tries[i], 0) / frame.num_goals;
    setText(this.text, `${count(frame.first_env_steps)} to ${count(frame.last_env_steps)} env steps: ${counted(frame.num_goals, "goal")} of the sample in ${counted(frame.centers_m.length, "cell")}, Bob reaches ${percent(mean)}`);
    return this.draw();
  }

  async draw() {
    if (this.at === undefined || !this.frames.length) return;
    try {
      const Plotly = await library();
      if (!this.canvas.isConnected) return;
      const frame = this.frames[this.at];
      await Plotly.react(this.canvas, [this.trace(frame)], this.layout(), { displayModeBar: false, responsive: true });
      if (!this.canvas.querySelector("canvas")) throw new Error("This browser has no WebGL; the map below shows the same from above.");
      this.canvas.dataset.cells = frame.centers_m.length;
    } catch (error) {
      this.canvas.replaceChildren(note(error.message ?? String(error)));
    }
  }

  trace(frame) {
    const most = Math.max(1, ...this.frames.flatMap((each) => each.num_tries));
    const size = frame.num_tries.map((tries) => SIZES[0] + (SIZES[1] - SIZES[0]) * Math.sqrt(tries / most));
    const axis = (i) => frame.centers_m.map((center) => center[i]);
    const spoken = frame.centers_m.map((center, i) => `${percent(frame.success_rate[i])} of ${frame.num_tries[i]}`);
    const marker = { size, color: frame.success_rate, cmin: 0, cmax: 1, colorscale: SCALE, symbol: "circle", opacity: 0.9, line: { width: 0 } };
    return { type: "scatter3d", mode: "markers", x: axis(0), y: axis(1), z: axis(2), text: spoken, hovertemplate: "x %{x:.3f}, y %{y:.3f}, z %{z:.3f} m<br>Bob reaches %{text}<extra></extra>", marker };
  }

  layout() {
    const colours = theme();
    const all = this.frames.flatMap((frame) => frame.centers_m);
    const range = (i) => [Math.min(...all.map((center) => center[i])) - this.cellSize, Math.max(...all.map((center) => center[i])) + this.cellSize];
    const axis = (title, i) => ({ title: { text: title }, range: i === 2 ? [0, range(2)[1]] : range(i), color: colours.soft, gridcolor: colours.line, zerolinecolor: colours.line, backgroundcolor: "rgba(0,0,0,0)" });
    const scene = { xaxis: axis("x (m)", 0), yaxis: axis("y (m)", 1), zaxis: axis("height (m)", 2), aspectmode: "data", camera: this.camera(), dragmode: "turntable" };
    return { uirevision: "turned", scene, height: HEIGHT, margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: "rgba(0,0,0,0)", font: { color: colours.soft, size: 11 } };
  }

  /** Where one looks from at first: further away where the picture is narrow, as on a phone. */
  camera() {
    const far = Math.max(1, (1.25 * HEIGHT) / (this.canvas.clientWidth || HEIGHT));
    const eye = Object.fromEntries(Object.entries(EYE).map(([axis, value]) => [axis, far * value]));
    return { eye, center: { x: 0, y: 0, z: -0.12 } };
  }
}
