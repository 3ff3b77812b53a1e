// The page of all runs, with a small curve of Bob's success for each.

import { ApiError, get, sentence } from "./api.js";
import { el, note, runLink, setText, svg } from "./dom.js";
import { every, isActive } from "./follow.js";
import { count, counted, percent } from "./format.js";
import { age, progressBar, stateChip, Table } from "./widgets.js";

const EVERY_MS = 2000;
const NAME = "bob/success_rate";
const NUM_POINTS = 40;
const AGAIN_MS = 10_000;
const [WIDTH, HEIGHT] = [96, 24];

/** Runs, newest start first. */
export function runsView(root, signal) {
  const sparks = new Sparks();
  const table = new Table("Runs", columns(sparks), (run) => run.run_id);
  const summary = el("p", { class: "summary", "aria-live": "polite" }, "Asking \u2026");
  const list = el("div", { class: "scroll" });
  root.replaceChildren(el("h1", {}, "Runs"), summary, list);
  let asking = false;
  return every(EVERY_MS, signal, async () => {
    const found = await listed(summary, signal);
    if (!found) return;
    setText(summary, sum(found));
    const shown = found.runs.length ? table.root : nothing();
    if (list.firstChild !== shown) list.replaceChildren(shown);
    table.update(found.runs);
    if (asking) return;
    asking = true; // not awaited: runs are shown while their curves are loaded
    sparks.refresh(found.runs, signal, () => table.update(found.runs)).finally(() => (asking = false));
  });
}

async function listed(summary, signal) {
  try {
    return await get(["v1", "runs"], [], signal);
  } catch (error) {
    if (error instanceof ApiError && error.status) setText(summary, sentence(error.message));
    return null;
  }
}

function sum({ runs, num_runs: numRuns }) {
  const active = counted(runs.filter(isActive).length, "active run");
  return `${active}, ${counted(numRuns, "run")} in all${numRuns > runs.length ? `, the newest ${runs.length} here` : ""}.`;
}

function columns(sparks) {
  return [
    { label: "Run", changed: (run) => [run.run_id, run.name, run.runtime], node: title },
    { label: "State", changed: (run) => [run.state, run.condition, run.stopping, run.last_error, run.warnings], node: state },
    { label: "Env steps", changed: (run) => [run.num_env_steps, run.total_env_steps], node: progressBar },
    { label: "Env steps/s", text: (run) => (isActive(run) ? count(run.env_steps_per_s) : "\u2013"), number: true },
    { label: "Bob's success", changed: (run) => sparks.changed(run), node: (run) => sparks.node(run) },
    { label: "Started", changed: (run) => run.started, node: (run) => age(run.started) },
    { label: "Heard of", changed: (run) => run.heartbeat, node: (run) => age(run.heartbeat) },
  ];
}

function title(run) {
  return el("span", { class: "two" }, runLink(run.run_id), el("small", {}, `${run.name}, ${run.runtime}`));
}

function state(run) {
  const bad = run.condition !== "well" ? run.condition : null;
  const trouble = bad ?? (run.last_error ? "error" : run.warnings.length ? counted(run.warnings.length, "warning") : null);
  return el("span", { class: "chips" }, stateChip(run), trouble && el("span", { class: "chip warn" }, trouble));
}

function nothing() {
  const command = el("code", {}, "tandem pretrain --config configs/pretrain/panda_cube.yaml --run-dir runs/cube");
  return note("No runs yet. Start one with ", command, ": it appears here when it has started.");
}

/** The small curves; asks for one run at a time, and again only for runs with new iterations. */
class Sparks {
  constructor() {
    this.known = new Map();
  }

  /** Load new values; ``shown`` is called after each run. */
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

  /** Key of the curve: `node` differs where it differs. */
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
