// The page of all runs, with a small curve of success for each: search, filter, sort, and choose some to compare.

import { ApiError, get, sentence } from "./api.js";
import { el, mark, note, runLink, setText, svg } from "./dom.js";
import { every, isActive } from "./follow.js";
import { count, counted, percent } from "./format.js";
import { age, progressBar, share, stateChip, Table, trialText } from "./widgets.js";

const EVERY_MS = 2000;
const SPARKLINES = ["bob/success_rate", "rollout/success_last"].map((name) => ["sparkline", name]);
const LIMIT = 1000;
const [WIDTH, HEIGHT] = [96, 24];
const SORTS = {
  "newest start": (a, b) => Date.parse(b.started) - Date.parse(a.started),
  name: (a, b) => a.run_id.localeCompare(b.run_id, "en", { numeric: true }),
  success: (a, b) => (success(b) ?? -1) - (success(a) ?? -1),
  "env steps": (a, b) => b.num_env_steps - a.num_env_steps,
  progress: (a, b) => share(b) - share(a),
};
const FILTERS = {
  "all runs": () => true,
  "pre-training": (run) => !run.trial,
  downstream: (run) => Boolean(run.trial),
  active: isActive,
  ended: (run) => !isActive(run),
  failed: (run) => run.state === "failed",
  "with trouble": (run) => trouble(run) !== null,
};

/** Runs, newest start first. */
export function runsView(root, signal) {
  return new RunsPage(root).follow(signal);
}

class RunsPage {
  constructor(root) {
    Object.assign(this, { found: null, chosen: new Set() });
    this.summary = el("p", { class: "summary", "aria-live": "polite" }, "Asking \u2026");
    this.table = new Table("Runs", columns(this), (run) => run.run_id);
    this.list = el("div", { class: "scroll" });
    this.search = el("input", { type: "search", placeholder: "Find a run", "aria-label": "Find a run" });
    [this.filter, this.sort] = [choice("Show", FILTERS), choice("Sort by", SORTS)];
    this.compare = el("a", { class: "button", href: "#/", hidden: true });
    this.all = el("button", { type: "button" }, "Choose all shown");
    this.all.addEventListener("click", () => this.chooseAll());
    for (const control of [this.search, this.filter, this.sort]) control.addEventListener("input", () => this.show());
    this.controls = el("div", { class: "controls", role: "group", "aria-label": "Which runs", hidden: true }, this.search, this.filter, this.sort, this.all, this.compare);
    root.replaceChildren(el("h1", {}, "Runs"), this.summary, this.controls, this.list);
  }

  follow(signal) {
    return every(EVERY_MS, signal, async () => {
      try {
        this.found = await get(["v1", "runs"], [["limit", LIMIT], ...SPARKLINES], signal);
      } catch (error) {
        if (error instanceof ApiError && error.status) setText(this.summary, sentence(error.message));
        return;
      }
      this.show();
      requestAnimationFrame(() => mark("runs"));
    });
  }

  show() {
    if (!this.found) return;
    const { runs, sparklines, num_runs: numRuns } = this.found;
    const active = counted(runs.filter(isActive).length, "active run");
    const more = numRuns > runs.length ? `, the newest ${runs.length} here` : "";
    const matching = this.matching(runs.map((run) => ({ ...run, values: sparklines[run.run_id] ?? [] })));
    const hidden = matching.length < runs.length ? ` ${counted(matching.length, "run")} shown.` : "";
    setText(this.summary, `${active}, ${counted(numRuns, "run")} in all${more}.${hidden}`);
    this.controls.hidden = !runs.length;
    const shown = runs.length ? this.table.root : nothing();
    if (this.list.firstChild !== shown) this.list.replaceChildren(shown);
    this.shown = matching;
    this.table.update(matching);
    this.offer();
  }

  matching(runs) {
    const words = this.search.value.trim().toLowerCase().split(/\s+/);
    const has = (run) => words.every((word) => [run.run_id, run.name, run.study, run.published, run.state, run.trial?.primitives].join(" ").toLowerCase().includes(word));
    return runs.filter(has).filter(FILTERS[this.filter.value]).sort(SORTS[this.sort.value]);
  }

  choose(id, on) {
    if (on) this.chosen.add(id);
    else this.chosen.delete(id);
    this.offer();
  }

  chooseAll() {
    const ids = this.shown.map((run) => run.run_id);
    const on = ids.some((id) => !this.chosen.has(id));
    ids.forEach((id) => (on ? this.chosen.add(id) : this.chosen.delete(id)));
    for (const box of this.table.root.querySelectorAll("input")) box.checked = on; // the table has those shown alone
    this.offer();
  }

  offer() {
    const ids = [...this.chosen];
    setText(this.all, this.shown.every((run) => this.chosen.has(run.run_id)) ? "Choose none" : "Choose all shown");
    this.compare.hidden = !ids.length;
    this.compare.href = `#/compare/${ids.map(encodeURIComponent).join(",")}`;
    setText(this.compare, `Compare ${counted(ids.length, "run")}`);
  }
}

function choice(label, options) {
  return el("select", { "aria-label": label }, ...Object.keys(options).map((name) => el("option", { value: name }, name)));
}

function columns(page) {
  return [
    { label: "Run", changed: (run) => [run.run_id, run.name, run.runtime], node: (run) => title(run, page) },
    { label: "State", changed: (run) => [run.state, run.condition, run.stopping, run.last_error, run.warnings], node: state },
    { label: "Env steps", changed: (run) => [run.num_env_steps, run.total_env_steps], node: progressBar },
    { label: "Env steps/s", text: (run) => (isActive(run) ? count(run.env_steps_per_s) : "\u2013"), number: true },
    { label: "Success", changed: (run) => [run.values, run.trial?.success], node: (run) => el("span", { class: "spark" }, curve(run.values), percent(success(run))) },
    { label: "Started", changed: (run) => run.started, node: (run) => age(run.started) },
    { label: "Heard of", changed: (run) => run.heartbeat, node: (run) => age(run.heartbeat) },
  ];
}

function title(run, page) {
  const box = el("input", { type: "checkbox", checked: page.chosen.has(run.run_id), "aria-label": `Choose ${run.run_id}` });
  box.addEventListener("change", () => page.choose(run.run_id, box.checked));
  return el("span", { class: "chooser" }, box, el("span", { class: "two" }, runLink(run.run_id), el("small", {}, run.trial ? trialText(run.trial) : `${run.name}, ${run.runtime}`)));
}

/** Bob's on Alice's goals; of a run that learns a task that of its final evaluation, until then with noise. */
function success(run) {
  return run.trial?.success ?? run.values.findLast((value) => value !== null);
}

function trouble(run) {
  const bad = run.condition !== "well" ? run.condition : null;
  return bad ?? (run.last_error ? "error" : run.warnings.length ? counted(run.warnings.length, "warning") : null);
}

function state(run) {
  const text = trouble(run);
  return el("span", { class: "chips" }, stateChip(run), text && el("span", { class: "chip warn" }, text));
}

function nothing() {
  const command = el("code", {}, "tandem train --run-dir runs/cube");
  return note("No runs yet. Start one with ", command, ": it appears here when it has started. Runs that are somewhere else are shown by ", el("code", {}, "tandem serve --runs DIR"), ".");
}

function curve(values) {
  const points = values
    .map((value, i) => [(i / Math.max(1, values.length - 1)) * WIDTH, value])
    .filter(([, value]) => value !== null)
    .map(([x, value]) => `${x.toFixed(1)},${(HEIGHT - 2 - value * (HEIGHT - 4)).toFixed(1)}`);
  const size = { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, width: WIDTH, height: HEIGHT, "aria-hidden": "true" };
  return svg("svg", size, svg("polyline", { points: points.join(" ") }));
}
