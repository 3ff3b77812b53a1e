// The curves of a run: which there are, their data, and the cursor that all of them share.

import { Chart } from "./chart.js";
import { el } from "./dom.js";
import { percent, quantity } from "./format.js";

const FRACTION = { text: percent, top: () => 1 };
const PANELS = [
  {
    title: "Alice's proposals",
    hint: "valid stays high, lifted grows",
    ...FRACTION,
    curves: [
      { name: "alice/valid_fraction", label: "valid" },
      { name: "alice/lifted_fraction", label: "lifted" },
    ],
  },
  {
    title: "Bob on Alice's goals",
    hint: "stays high while the goals get harder",
    ...FRACTION,
    curves: [
      { name: "bob/success_rate", label: "all" },
      { name: "bob/success_rate_air", label: "air" },
      { name: "bob/success_rate_table", label: "table" },
    ],
  },
  {
    title: "Bob on random goals",
    hint: "success at the last step of an evaluation; grows",
    ...FRACTION,
    curves: [
      { name: "evaluation/mixed_success_last", label: "mixed", sparse: true },
      { name: "evaluation/air_success_last", label: "air", sparse: true },
      { name: "evaluation/table_success_last", label: "table", sparse: true },
    ],
  },
  {
    title: "Goals",
    hint: "grow while Alice proposes harder goals",
    text: (value) => quantity(value, "m"),
    curves: [
      { name: "alice/goal_distance_m", label: "distance" },
      { name: "alice/goal_height_m", label: "height" },
    ],
  },
  {
    title: "Throughput",
    hint: "env steps per second",
    text: (value) => quantity(value),
    curves: [{ name: "time/env_steps_per_s", label: "env steps/s" }],
  },
  {
    title: "Policy lag",
    hint: "versions between acting and learning",
    text: (value) => quantity(value),
    top: (greatest) => Math.max(2, Math.ceil(greatest)),
    curves: [{ name: "learner/policy_lag", label: "versions" }],
  },
];

/** Names of the metrics to ask for. */
export const NAMES = PANELS.flatMap((panel) => panel.curves.map((curve) => curve.name));

/** All curves of a run, over env steps. */
export class Panels {
  constructor(signal) {
    this.series = new Series(NAMES);
    this.cursor = null;
    this.pending = false;
    this.charts = PANELS.map((panel) => new Chart(panel, this.series, (index) => this.point(index)));
    this.root = el("div", { class: "charts" }, ...this.charts.map((chart) => chart.root));
    const observer = new ResizeObserver(() => this.draw());
    observer.observe(this.root);
    signal.addEventListener("abort", () => observer.disconnect());
  }

  load(history) {
    this.series.load(history);
    this.draw();
  }

  append(record) {
    this.series.append(record);
    this.draw();
  }

  /** Show the numbers of one point in every panel; of the newest for null. */
  point(index) {
    this.cursor = index;
    this.charts.forEach((chart) => chart.point(this.cursor));
  }

  /** Draw once per frame, however many records came. */
  draw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      if (this.cursor !== null && this.cursor >= this.series.size) this.cursor = null;
      this.charts.forEach((chart) => chart.draw(this.cursor));
    });
  }
}

/** A run's metrics over iterations: {iteration, steps, values: {name: [number or null]}}. */
class Series {
  constructor(names) {
    this.names = names;
    this.clear();
  }

  clear() {
    this.iteration = [];
    this.steps = [];
    this.values = Object.fromEntries(this.names.map((name) => [name, []]));
  }

  get size() {
    return this.steps.length;
  }

  /** Replace all points with the service's history. */
  load(history) {
    this.iteration = [...history.iteration];
    this.steps = [...history.env_steps];
    for (const name of this.names) this.values[name] = [...(history.metrics[name] ?? this.steps.map(() => null))];
  }

  /** Add an iteration unless it is known already. */
  append(record) {
    if (this.size && record.iteration <= this.iteration[this.size - 1]) return;
    this.iteration.push(record.iteration);
    this.steps.push(record.env_steps);
    for (const name of this.names) this.values[name].push(record[name] ?? null);
  }

  /** The newest number at or before a point; null if there is none. */
  valueAt(name, index) {
    const values = this.values[name];
    for (let i = Math.min(index, values.length - 1); i >= 0; i--) if (values[i] !== null) return values[i];
    return null;
  }

  /** The newest number. */
  latest(name) {
    return this.valueAt(name, this.size - 1);
  }

  /** The point whose env steps are nearest. */
  nearest(steps) {
    let best = 0;
    for (let i = 1; i < this.size; i++) if (Math.abs(this.steps[i] - steps) < Math.abs(this.steps[best] - steps)) best = i;
    return best;
  }

  /**
   * A moving average with exponential weights and Adam's correction for its start. The span counts iterations, not
   * points: in a long history, a point is the mean over several iterations.
   */
  smoothed(name) {
    const last = this.iteration[this.size - 1] ?? 0;
    const span = Math.min(30, Math.max(1, last / 20));
    const decay = 1 - 2 / (span + 1);
    let [average, weight, before] = [0, 0, 0];
    return this.values[name].map((value, i) => {
      if (value === null) return null;
      const kept = decay ** (this.iteration[i] - before);
      before = this.iteration[i];
      average = kept * average + (1 - kept) * value;
      weight = kept * weight + (1 - kept);
      return average / weight;
    });
  }
}
