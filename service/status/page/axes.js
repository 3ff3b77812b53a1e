// Scales, ticks, and the grid behind a curve.

import { svg } from "./dom.js";

const STEPS = [1, 2, 2.5, 5, 10];

/** Round numbers from ``low`` to ``high``, about ``number`` of them. */
export function ticks(low, high, number) {
  const rough = (high - low) / Math.max(1, number);
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * STEPS.find((factor) => factor * power >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/** The next round number from a maximum on, so that the highest tick is the top. */
export function roundUp(value, number) {
  if (!(value > 0)) return 1;
  const [first, second = 2 * first] = ticks(0, value, number).slice(1);
  const step = second - first || value;
  return Math.ceil(value / step - 1e-9) * step;
}

/** A linear map from one interval to another. */
export function linear(from, to, low, high) {
  const factor = from === to ? 0 : (high - low) / (to - from);
  return (value) => low + (value - from) * factor;
}

/** Lines and numbers: ``frame`` has left, right, top, bottom in pixels; x and y are maps to pixels. */
export function drawAxes(frame, x, y, xTicks, yTicks, xText, yText) {
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
