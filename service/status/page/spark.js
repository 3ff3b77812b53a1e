// Bob's success of each run in the list, as a small curve and a number.

import { get } from "./api.js";
import { el, svg } from "./dom.js";
import { isActive } from "./follow.js";
import { percent } from "./format.js";

const NAME = "bob/success_rate";
const NUM_POINTS = 40;
const AGAIN_MS = 10_000;
const [WIDTH, HEIGHT] = [96, 24];

/** Asks for one run after the other, and again only for those that have gone on. */
export class Sparks {
  constructor() {
    this.known = new Map();
  }

  /** Bring what is known up to date; ``shown`` is called after each run. */
  async refresh(runs, signal, shown) {
    for (const run of runs) {
      const known = this.known.get(run.run_id);
      const same = known && known.iteration === run.iteration && known.started === run.started;
      if (same || (known && isActive(run) && Date.now() - known.atMs < AGAIN_MS)) continue;
      const query = [["names", NAME], ["max_points", NUM_POINTS]];
      const history = await get(["v1", "runs", run.run_id, "metrics"], query, signal).catch(() => null);
      if (signal.aborted) return;
      const values = history?.metrics[NAME] ?? known?.values ?? [];
      this.known.set(run.run_id, { iteration: run.iteration, started: run.started, values, atMs: Date.now() });
      shown();
    }
  }

  /** Says whether `node` would be another one. */
  changed(run) {
    return this.values(run).join();
  }

  node(run) {
    const values = this.values(run);
    const newest = values.findLast((value) => value !== null);
    return el("span", { class: "spark" }, curve(values), percent(newest));
  }

  values(run) {
    return this.known.get(run.run_id)?.values ?? [];
  }
}

function curve(values) {
  const points = values
    .map((value, i) => [(i / Math.max(1, values.length - 1)) * WIDTH, value])
    .filter(([, value]) => value !== null)
    .map(([x, value]) => `${x.toFixed(1)},${(HEIGHT - 2 - value * (HEIGHT - 4)).toFixed(1)}`);
  const size = { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, width: WIDTH, height: HEIGHT, "aria-hidden": "true" };
  return svg("svg", size, svg("polyline", { points: points.join(" ") }));
}
