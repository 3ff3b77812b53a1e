// Which curves there are, and the one cursor that all of them share.

import { Chart } from "./chart.js";
import { el } from "./dom.js";
import { percent, quantity } from "./format.js";
import { Series } from "./series.js";

const FRACTION = { text: percent, top: () => 1 };
const PANELS = [
  {
    title: "Alice's proposals",
    hint: "valid settles high, lifted grows",
    ...FRACTION,
    curves: [
      { name: "alice/valid_fraction", label: "valid" },
      { name: "alice/lifted_fraction", label: "lifted" },
    ],
  },
  {
    title: "Bob on Alice's goals",
    hint: "holds up while the goals get harder",
    ...FRACTION,
    curves: [
      { name: "bob/success_rate", label: "all" },
      { name: "bob/success_rate_air", label: "air" },
      { name: "bob/success_rate_table", label: "table" },
    ],
  },
  {
    title: "Bob on random goals",
    hint: "evaluations, there at the last step: grows",
    ...FRACTION,
    curves: [
      { name: "evaluation/mixed_success_last", label: "mixed", sparse: true },
      { name: "evaluation/air_success_last", label: "air", sparse: true },
      { name: "evaluation/table_success_last", label: "table", sparse: true },
    ],
  },
  {
    title: "Goals",
    hint: "Alice raises the bar",
    text: (value) => quantity(value, "m"),
    curves: [
      { name: "alice/goal_distance_m", label: "distance" },
      { name: "alice/goal_height_m", label: "height" },
    ],
  },
  {
    title: "Throughput",
    hint: "env steps a second",
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

/** What the service is asked for. */
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

  /** Show the numbers of one point in every panel; the newest ones for null. */
  point(index) {
    this.cursor = index;
    this.charts.forEach((chart) => chart.point(this.cursor));
  }

  /** Once a frame, however many records came. */
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
