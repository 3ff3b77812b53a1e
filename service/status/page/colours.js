// A scale of colours that is read the same by everybody, in light and dark: viridis, by Smith and van der Walt.

import { svg } from "./dom.js";

const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/** The colour of a number from 0 to 1. */
export function colour(fraction) {
  const place = Math.min(1, Math.max(0, fraction)) * (STOPS.length - 1);
  const first = Math.min(STOPS.length - 2, Math.floor(place));
  const mixed = STOPS[first].map((from, i) => Math.round(from + (STOPS[first + 1][i] - from) * (place - first)));
  return `rgb(${mixed.join(", ")})`;
}

/** The scale as a bar. */
export function colourBar(number = 32) {
  const steps = Array.from({ length: number }, (_, i) =>
    svg("rect", { x: i, y: 0, width: 1.05, height: 1, fill: colour(i / (number - 1)) }),
  );
  const box = { class: "bar", viewBox: `0 0 ${number} 1`, preserveAspectRatio: "none", "aria-hidden": "true" };
  return svg("svg", box, ...steps);
}
