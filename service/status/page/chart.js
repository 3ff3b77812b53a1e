// One panel of curves: values as thin lines, smoothed as thick lines; a legend with the numbers at the cursor, or the
// newest; and its axes.

import { el, setText, svg } from "./dom.js";
import { count } from "./format.js";

const HEIGHT = 190;
const MARGIN = { left: 50, right: 22, top: 8, bottom: 24 };
const NUM_Y_TICKS = 4;
const PIXELS_PER_X_TICK = 80;
const STEPS = [1, 2, 2.5, 5, 10];

export class Chart {
  /** ``point`` is called with the index of the point under the cursor, or null. */
  constructor(panel, series, point) {
    Object.assign(this, { panel, series, pointAt: point });
    this.where = el("span", { class: "where" });
    this.values = panel.curves.map(() => el("output", {}));
    // a slider along the curve, for keyboards and screen readers
    this.plot = el("div", { class: "plot", tabindex: 0, role: "slider", "aria-label": panel.title, "aria-valuemin": 0 });
    const legend = panel.curves.map((curve, i) =>
      el("li", { class: `c${i}` }, el("span", { class: "swatch", "aria-hidden": "true" }), `${curve.label} `, this.values[i]),
    );
    const head = el("figcaption", {}, el("h3", {}, panel.title), this.where, el("span", { class: "hint" }, panel.hint));
    this.root = el("figure", { class: "chart" }, head, this.plot, el("ul", { class: "legend" }, ...legend));
    this.listen();
  }

  listen() {
    const look = (event) => this.series.size && this.pointAt(this.series.nearest(this.stepsAt(event)));
    this.plot.addEventListener("pointermove", look);
    this.plot.addEventListener("pointerdown", look);
    this.plot.addEventListener("pointerleave", () => this.pointAt(null));
    this.plot.addEventListener("blur", () => this.pointAt(null));
    this.plot.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    const last = this.series.size - 1;
    const from = this.cursor ?? last;
    const far = event.shiftKey ? 10 : 1;
    const to = { ArrowLeft: from - far, ArrowRight: from + far, Home: 0, End: last, Escape: null }[event.key];
    if (to === undefined || last < 0) return;
    event.preventDefault();
    this.pointAt(to === null ? null : Math.min(last, Math.max(0, to)));
  }

  stepsAt(event) {
    const left = this.plot.getBoundingClientRect().left;
    return linear(this.frame.left, this.frame.right, 0, this.greatest)(event.clientX - left);
  }

  /** Draw everything, in pixels, so that text keeps its size. */
  draw(cursor) {
    const width = this.plot.clientWidth;
    if (!width) return;
    const { series, panel } = this;
    this.frame = { left: MARGIN.left, right: width - MARGIN.right, top: MARGIN.top, bottom: HEIGHT - MARGIN.bottom };
    this.greatest = series.steps.at(-1) || 1;
    const top = this.top();
    this.x = linear(0, this.greatest, this.frame.left, this.frame.right);
    this.y = linear(0, top, this.frame.bottom, this.frame.top);
    const xTicks = ticks(0, this.greatest, Math.floor((this.frame.right - this.frame.left) / PIXELS_PER_X_TICK));
    const axes = drawAxes(this.frame, this.x, this.y, xTicks, ticks(0, top, NUM_Y_TICKS), count, this.tickText);
    this.marks = svg("g", { class: "marks" });
    const curves = panel.curves.map((curve, i) => this.curve(curve, i));
    const empty = curves.some(Boolean) ? null : this.nothing();
    const size = { viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT, "aria-hidden": "true" };
    this.plot.replaceChildren(svg("svg", size, axes, ...curves, this.marks, empty));
    this.point(cursor);
  }

  get tickText() {
    return this.panel.top?.(0) === 1 ? (value) => `${Math.round(100 * value)}\u00a0%` : this.panel.text;
  }

  top() {
    const greatest = Math.max(0, ...this.panel.curves.flatMap(({ name }) => this.series.values[name]));
    return this.panel.top ? this.panel.top(greatest) : roundUp(greatest, NUM_Y_TICKS);
  }

  curve(curve, i) {
    const values = this.series.values[curve.name];
    if (values.every((value) => value === null)) return null;
    const group = svg("g", { class: `curve c${i}`, "data-name": curve.name });
    if (curve.sparse) {
      const known = this.pixels(values).filter(Boolean);
      group.append(line("smooth", known), ...known.map(([x, y]) => svg("circle", { cx: x, cy: y, r: 2.5 })));
    } else {
      group.append(line("raw", this.pixels(values)), line("smooth", this.pixels(this.series.smoothed(curve.name))));
    }
    return group;
  }

  /** [x, y] of each value, null if there is none. */
  pixels(values) {
    return values.map((value, i) => (value === null ? null : [round(this.x(this.series.steps[i])), round(this.y(value))]));
  }

  nothing() {
    const middle = { x: (this.frame.left + this.frame.right) / 2, y: (this.frame.top + this.frame.bottom) / 2 };
    return svg("text", { class: "nothing", ...middle }, "no values yet");
  }

  /** Show the numbers of one point; of the newest for null. */
  point(index) {
    this.cursor = index;
    const { series, panel } = this;
    const at = index ?? series.size - 1;
    const texts = panel.curves.map((curve) => panel.text(series.valueAt(curve.name, at)));
    texts.forEach((text, i) => setText(this.values[i], text));
    setText(this.where, index === null ? "" : `at ${count(series.steps[at])} env steps`);
    const spoken = panel.curves.map((curve, i) => `${curve.label} ${texts[i]}`).join(", ");
    this.plot.setAttribute("aria-valuemax", Math.max(0, series.size - 1));
    this.plot.setAttribute("aria-valuenow", Math.max(0, at));
    this.plot.setAttribute("aria-valuetext", series.size ? `${count(series.steps[at])} env steps: ${spoken}` : "no values yet");
    this.marks?.replaceChildren(...(index === null ? [] : this.cursorMarks(at)));
  }

  cursorMarks(at) {
    const x = this.x(this.series.steps[at]);
    const rule = svg("line", { class: "rule", x1: x, x2: x, y1: this.frame.top, y2: this.frame.bottom });
    const dots = this.panel.curves.map(({ name }, i) => {
      const value = this.series.values[name][at];
      return value === null ? null : svg("circle", { class: `c${i}`, cx: x, cy: this.y(value), r: 3.5 });
    });
    return [rule, ...dots.filter(Boolean)];
  }
}

/** A line through points, with gaps at null. */
function line(className, points) {
  const parts = points.map((point, i) => (point ? `${points[i - 1] ? "L" : "M"}${point[0]} ${point[1]}` : ""));
  return svg("path", { class: className, d: parts.join("") });
}

function round(pixels) {
  return Math.round(100 * pixels) / 100;
}

/** Round numbers from ``low`` to ``high``, about ``number`` of them. */
function ticks(low, high, number) {
  const rough = (high - low) / Math.max(1, number);
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * STEPS.find((factor) => factor * power >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/** Round a maximum up to the next tick, so that the highest tick is the top. */
function roundUp(value, number) {
  if (!(value > 0)) return 1;
  const [first, second = 2 * first] = ticks(0, value, number).slice(1);
  const step = second - first || value;
  return Math.ceil(value / step - 1e-9) * step;
}

/** A linear map from one interval to another. */
function linear(from, to, low, high) {
  const factor = from === to ? 0 : (high - low) / (to - from);
  return (value) => low + (value - from) * factor;
}

/** Grid lines and numbers: ``frame`` has left, right, top, bottom in pixels; x and y are maps to pixels. */
function drawAxes(frame, x, y, xTicks, yTicks, xText, yText) {
  const horizontal = yTicks.flatMap((value) => [
    svg("line", { class: "grid", x1: frame.left, x2: frame.right, y1: y(value), y2: y(value) }),
    svg("text", { class: "tick y", x: frame.left - 6, y: y(value), dy: "0.32em", "data-value": value }, yText(value)),
  ]);
  const vertical = xTicks.map((value) =>
    svg("text", { class: "tick x", x: x(value), y: frame.bottom + 16, "data-value": value }, xText(value)),
  );
  const base = svg("line", { class: "base", x1: frame.left, x2: frame.right, y1: frame.bottom, y2: frame.bottom });
  return svg("g", { class: "axes" }, ...horizontal, base, ...vertical);
}
