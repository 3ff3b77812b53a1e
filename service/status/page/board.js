// All curves of one run or of several: which panels there are, their data, and what they share: axis, smoothing, zoom, cursor.

import { address, get } from "./api.js";
import { el, mark, note, setText } from "./dom.js";
import { counted } from "./format.js";
import { library, onTheme } from "./library.js";
import { grouped, panelsOf } from "./metrics.js";
import { Panel, placeText } from "./panel.js";
import { SPANS, usualPlace } from "./smoothing.js";

const MAX_POINTS = 1000;
const MAX_NAMES = 60;
/** Most metrics of a run without panels of its own whose groups are open from the start. */
const MANY = 24;
/** Most runs that the service takes in one question. */
const MAX_RUNS = 200;
/** Characters that the runs of a question may take, and its metrics as many: nginx takes 8 KiB of URL. */
const MAX_LENGTH = 2800;
const AXES = [["env_steps", "env steps"], ["iteration", "iterations"], ["wall_s", "hours of learning"]];
const HOUR_S = 3600;
let boards = 0;

export class Board {
  /** ``runs`` are {id, label, study}; ``panels`` those that are always there; ``banded``: whether seeds may be a band. */
  constructor(runs, panels, signal) {
    Object.assign(this, { runs, signal, data: new Map(), names: [], cursor: null, range: null });
    Object.assign(this, { axis: "env_steps", place: null, log: false, banded: false, pending: false, asked: 0 });
    /** Whether the runs are of another kind than the panels, such as of a method of a user's. */
    this.isOther = false;
    this.number = ++boards;
    this.panels = panels.map((spec) => new Panel(spec, this));
    this.groups = el("div", { class: "groups" });
    this.opened = new Map();
    this.trouble = el("p", { class: "note", role: "status" });
    this.overview = el("div", { class: "charts" }, ...this.panels.map((panel) => panel.root));
    this.root = el("div", { class: "board" }, this.controls(), this.trouble, this.overview, this.groups);
    library().catch((error) => this.fail(error));
    onTheme(() => this.draw(), signal);
    signal.addEventListener("abort", () => {
      this.panels.forEach((panel) => panel.close());
      for (const group of this.opened.keys()) this.drop(group);
    });
  }

  controls() {
    const axis = el("select", {}, ...AXES.map(([value, text]) => el("option", { value }, text)));
    axis.addEventListener("change", () => {
      Object.assign(this, { axis: axis.value, range: null, cursor: null });
      this.refresh();
    });
    this.slider = el("input", { type: "range", min: 0, max: SPANS.length - 1, step: 1, value: 0 });
    this.slider.addEventListener("input", () => {
      this.place = Number(this.slider.value);
      this.draw();
    });
    this.spanText = el("output", {});
    const log = this.box("logarithmic", (on) => (this.log = on));
    const studies = this.runs.map((run) => run.study).filter(Boolean);
    const band = studies.length > new Set(studies).size ? this.box("seeds as a band", (on) => (this.banded = on)) : null;
    this.whole = el("button", { type: "button", hidden: true }, "Whole run");
    this.whole.addEventListener("click", () => this.zoom(null));
    this.filter = el("input", { type: "search", placeholder: "Find a metric", "aria-label": "Find a metric" });
    this.filter.addEventListener("input", () => this.list());
    return el(
      "div",
      { class: "controls", role: "group", "aria-label": "How curves are shown" },
      el("label", {}, "over ", axis), el("label", {}, "smooth ", this.slider, " ", this.spanText), log, band, this.whole, this.filter,
    );
  }

  box(text, changed) {
    const input = el("input", { type: "checkbox" });
    input.addEventListener("change", () => {
      changed(input.checked);
      this.draw();
    });
    return el("label", {}, input, ` ${text}`);
  }

  /** How many iterations a smooth curve is averaged over. */
  get span() {
    return SPANS[this.place ?? this.usual ?? 0];
  }

  /** Panels that are to be seen. */
  shown() {
    const open = [...this.opened.values()].filter(({ details }) => details.open);
    return [...this.panels.filter((panel) => !panel.root.hidden), ...open.flatMap(({ panels }) => panels)];
  }

  /** Ask for the curves of all panels that are to be seen, and draw them. */
  async refresh() {
    const asked = ++this.asked;
    const names = [...new Set(this.shown().flatMap((panel) => panel.names))];
    const data = await this.find(names, this.range);
    if (asked !== this.asked) return; // something else was asked for meanwhile
    this.data = data;
    this.learn();
    const stamp = JSON.stringify([this.axis, this.range, names, [...this.data.values()].map((run) => [run.run_id, run.last_iteration, run.x.length, run.problem])]);
    if (stamp === this.stamp) return; // ended runs are asked for again and again
    this.stamp = stamp;
    await this.draw();
  }

  /** Ask for the curves of some metrics in a part of the axis, null for all of it: by the runs' ids. */
  async find(names, range) {
    const unit = this.axis === "wall_s" ? HOUR_S : 1;
    const bounds = range ? [["start", range[0] * unit], ["end", range[1] * unit]] : [];
    const ask = (part, runs) => get(["v1", "series"], [...runs, ...part, ["axis", this.axis], ["max_points", MAX_POINTS], ...bounds], this.signal);
    const chunks = split("runs", this.runs.map((run) => run.id), MAX_RUNS);
    const answers = await Promise.all(split("names", names, MAX_NAMES).flatMap((part) => chunks.map((runs) => ask(part, runs))));
    const found = new Map();
    for (const run of answers.flatMap(({ runs }) => runs)) {
      const known = found.get(run.run_id);
      found.set(run.run_id, known ? { ...run, curves: { ...known.curves, ...run.curves } } : run);
    }
    return found;
  }

  /** The newest value of the first of some metrics that a run has, also while a part is shown: by the runs' ids. */
  async newest(names) {
    const data = this.range ? await this.find(names, null) : this.data;
    const last = (curve) => curve?.mean.findLast((value) => value !== null);
    return new Map([...data].map(([id, { curves }]) => [id, names.map((name) => last(curves[name])).find(Number.isFinite)]));
  }

  /** Take over what the answers say beside curves: names of metrics, and runs that cannot be read. */
  learn() {
    const found = [...this.data.values()];
    const names = [...new Set(found.flatMap((run) => run.names))].sort();
    if (names.join() !== this.names.join()) {
      this.names = names;
      const has = (panel) => panel.names.some((name) => names.includes(name));
      this.isOther = names.length > 0 && !this.panels.some((panel) => has(panel) && !panel.names[0].startsWith("time/"));
      for (const panel of this.panels) panel.root.hidden = this.isOther && !has(panel);
      this.list();
    }
    if (!this.range) this.usual = usualPlace(Math.max(0, ...found.map((run) => run.num_iterations)));
    setText(this.trouble, found.map((run) => run.problem).filter(Boolean).join("; "));
    this.trouble.hidden = !this.trouble.textContent;
  }

  /** A folded part for each group of metrics, with a panel for each of them once it is opened. */
  list() {
    const wanted = this.filter.value.trim().toLowerCase();
    const groups = grouped(this.names.filter((name) => name.toLowerCase().includes(wanted)));
    const parts = [...groups].map(([group, names]) => this.part(group, names, Boolean(wanted)));
    for (const group of this.opened.keys()) if (!groups.has(group)) this.drop(group);
    this.groups.replaceChildren(...parts, ...(wanted && !parts.length ? [note("No metric has this in its name.")] : []));
    if (wanted || this.isOther) this.refresh().catch((error) => this.fail(error));
  }

  part(group, names, open) {
    const known = this.opened.get(group);
    if (known && known.names === names.join()) {
      if (open) known.details.open = true;
      return known.details;
    }
    this.drop(group);
    const body = el("div", { class: "charts" });
    const few = this.isOther && this.names.length <= MANY && group !== "time"; // there is nothing else to see
    const details = el("details", { open: open || (known ? known.details.open : few) }, el("summary", {}, group, " ", el("small", {}, counted(names.length, "metric"))), body);
    const panels = panelsOf(names).map((spec) => new Panel(spec, this));
    body.append(...panels.map((panel) => panel.root));
    details.addEventListener("toggle", () => {
      this.stamp = null; // settings may have changed while it was closed
      if (details.open) this.refresh().catch((error) => this.fail(error));
    });
    this.opened.set(group, { details, panels, names: names.join() });
    return details;
  }

  /** Forget a group, and what the library keeps of its panels. */
  drop(group) {
    this.opened.get(group)?.panels.forEach((panel) => panel.close());
    this.opened.delete(group);
  }

  /** Show a part of the axis, asked for anew; null for all of it. */
  zoom(range) {
    this.range = range;
    this.whole.hidden = range === null;
    this.refresh().catch((error) => this.fail(error));
  }

  /** The range of the axis that panels show: the same in all of them. */
  shownRange() {
    if (this.range) return this.range;
    const ends = [...this.data.values()].filter((run) => run.x.length && !this.hides(run.run_id)).map((run) => run.x.at(-1));
    const last = Math.max(0, ...ends) / (this.axis === "wall_s" ? HOUR_S : 1);
    return [0, last > 0 ? 1.01 * last : 1];
  }

  hides(id) {
    return this.runs.find((run) => run.id === id)?.hidden;
  }

  /** Places on the axis as they are shown. */
  scaled(x) {
    return this.axis === "wall_s" ? x.map((value) => value / HOUR_S) : x;
  }

  placeText(value) {
    return placeText(this.axis, value);
  }

  /** Show the values at one place in every panel; the newest for null. */
  point(place) {
    this.cursor = place;
    if (this.pointing) return;
    this.pointing = requestAnimationFrame(() => {
      this.pointing = null;
      this.shown().forEach((panel) => panel.point(this.cursor));
    });
  }

  async draw() {
    this.slider.value = this.place ?? this.usual ?? 0;
    setText(this.spanText, this.span > 1 ? `${this.span} iterations` : "off");
    if (!this.data.size) return;
    try {
      for (const panel of this.shown()) await panel.draw();
    } catch (error) {
      this.fail(error);
    }
    requestAnimationFrame(() => mark("curves"));
  }

  /** The URL of all values of some metrics; null if it were too long for the service or a proxy. */
  tableUrl(names) {
    const runs = split("runs", this.runs.map((run) => run.id), MAX_RUNS);
    if (runs.length > 1) return null;
    const query = [...runs.flat(), ...names.map((name) => ["names", name])];
    return `${address("v1", "series.csv")}?${new URLSearchParams(query)}`;
  }

  fail(error) {
    if (this.signal.aborted) return;
    setText(this.trouble, error.message);
    this.trouble.hidden = false;
  }
}

/** Pairs of a query, of one key, in parts of ``most`` and of ``MAX_LENGTH`` characters at most. */
function split(key, values, most) {
  const parts = [];
  let length = 0;
  for (const value of values) {
    const pair = [key, value];
    const more = `${new URLSearchParams([pair])}&`.length;
    length += more;
    if (!parts.length || parts.at(-1).length === most || length > MAX_LENGTH) {
      parts.push([]);
      length = more;
    }
    parts.at(-1).push(pair);
  }
  return parts;
}
