// How far a run is.

import { el } from "./dom.js";
import { isActive } from "./follow.js";
import { count, duration, percent } from "./format.js";

/** A bar, and under it the env steps. */
export function progressBar(run) {
  const label = `${percent(share(run))} of the env steps`;
  return el(
    "span",
    { class: "progress" },
    el("progress", { max: 1, value: share(run), "aria-label": label }),
    el("span", {}, `${count(run.num_env_steps)} of ${count(run.total_env_steps)}`),
  );
}

/** From 0 to 1. */
export function share(run) {
  return Math.min(1, run.num_env_steps / run.total_env_steps);
}

/** How long it still takes at the present rate; null where nobody can say. */
export function timeLeft(run) {
  const left = run.total_env_steps - run.num_env_steps;
  if (!isActive(run) || !(run.env_steps_per_s > 0) || left <= 0) return null;
  return duration(left / run.env_steps_per_s);
}

/** The state in a word. */
export function stateChip(run) {
  const word = run.stopping && isActive(run) ? "stopping" : run.state;
  return el("span", { class: `chip ${word}` }, word);
}
