// The page of all runs.

import { ApiError, get, sentence } from "./api.js";
import { el, note, runLink, setText } from "./dom.js";
import { isActive } from "./follow.js";
import { count, counted } from "./format.js";
import { progressBar, stateChip } from "./progress.js";
import { Sparks } from "./spark.js";
import { Table } from "./table.js";
import { age, every } from "./times.js";

const EVERY_MS = 2000;

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
    asking = true; // not waited for: runs are shown while their curves are still read
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
    { label: "State", changed: (run) => [run.state, run.stopping, run.last_error, run.warnings], node: state },
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
  const trouble = run.last_error ? "error" : run.warnings.length ? counted(run.warnings.length, "warning") : null;
  return el("span", { class: "chips" }, stateChip(run), trouble && el("span", { class: "chip warn" }, trouble));
}

function nothing() {
  const command = el("code", {}, "tandem pretrain --config configs/pretrain/panda_cube.yaml --run-dir runs/cube");
  return note("No runs yet. Start one with ", command, ": it is here as soon as it has begun.");
}
