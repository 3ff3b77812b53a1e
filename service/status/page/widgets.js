// Parts that several pages share: tables, the progress and state of a run, and ages.

import { now } from "./api.js";
import { el, setText } from "./dom.js";
import { isActive } from "./follow.js";
import { count, duration, percent } from "./format.js";

/**
 * A table that keeps its rows while their cells change, so that focus, selection and scrolling stay; cards on narrow
 * screens. A column is {label, text(row)}, or {label, node(row), changed(row)}: the node is made again if ``changed``
 * differs. ``number: true`` aligns it right, ``short: true`` keeps it on one line.
 */
export class Table {
  constructor(label, columns, key) {
    this.columns = columns;
    this.key = key;
    this.rows = new Map();
    this.body = el("tbody", { role: "rowgroup" });
    const head = columns.map((column) => el("th", { scope: "col", role: "columnheader", class: kind(column) }, column.label));
    // explicit roles: for screen readers, a table that is shown as cards is no longer a table
    this.root = el(
      "table",
      { role: "table", "aria-label": label },
      el("thead", { role: "rowgroup" }, el("tr", { role: "row" }, ...head)),
      this.body,
    );
  }

  /** Show these rows, in this order. */
  update(items) {
    const rows = items.map((item) => this.row(item));
    const { children } = this.body;
    // a row that moves loses the focus within it, so move as few as possible
    rows.forEach((row, i) => row === children[i] || this.body.insertBefore(row, children[i] ?? null));
    while (children.length > rows.length) this.body.lastChild.remove();
    const known = new Set(items.map((item) => this.key(item)));
    for (const key of this.rows.keys()) if (!known.has(key)) this.rows.delete(key);
  }

  row(item) {
    const key = this.key(item);
    const row = this.rows.get(key) ?? el("tr", { role: "row" }, ...this.columns.map(cell));
    this.rows.set(key, row);
    this.columns.forEach((column, index) => fillCell(row.children[index], column, item));
    return row;
  }
}

function kind(column) {
  return column.number ? "number" : column.short ? "short" : null;
}

function cell(column) {
  return el("td", { role: "cell", class: kind(column), "data-label": column.label });
}

function fillCell(element, column, item) {
  if (column.text) return setText(element, column.text(item));
  const changed = String(column.changed(item));
  if (element.dataset.changed === changed) return undefined;
  element.dataset.changed = changed;
  return element.replaceChildren(column.node(item));
}

/** A progress bar, and the env steps under it. */
export function progressBar(run) {
  if (run.trial && run.state === "finished" && !run.num_env_steps) return el("small", {}, "learns nothing");
  const label = `${percent(share(run))} of the env steps`;
  return el(
    "span",
    { class: "progress" },
    el("progress", { max: 1, value: share(run), "aria-label": label }),
    el("span", {}, `${count(run.num_env_steps)} of ${count(run.total_env_steps)}`),
  );
}

/** What a downstream training learns, such as "push, ours-her, seed 0, with panda-cube@3"; without a seed of null. */
export function trialText({ task, method, seed, primitives }) {
  return [task, method, ...(seed === null ? [] : [`seed ${seed}`]), ...(primitives ? [`with ${primitives}`] : [])].join(", ");
}

/** The finished fraction of a run. */
export function share(run) {
  return Math.min(1, run.num_env_steps / run.total_env_steps);
}

/** Time left at the present rate; null if unknown. */
export function timeLeft(run) {
  const left = run.total_env_steps - run.num_env_steps;
  if (!isActive(run) || !(run.env_steps_per_s > 0) || left <= 0) return null;
  return duration(left / run.env_steps_per_s);
}

/** The state of a run. */
export function stateChip(run) {
  const word = run.stopping && isActive(run) ? "stopping" : run.state;
  return el("span", { class: `chip ${word}` }, word);
}

/** An age such as "3 min ago", which is updated every second. */
export function age(timestamp) {
  const element = el("time", { datetime: timestamp, "data-age": true, title: new Date(timestamp).toLocaleString() });
  updateAge(element);
  return element;
}

/** Seconds since a time, by the service's clock. */
export function secondsSince(timestamp) {
  return Math.max(0, (now() - Date.parse(timestamp)) / 1000);
}

/** Update all ages every second. */
export function startAges() {
  setInterval(() => document.querySelectorAll("time[data-age]").forEach(updateAge), 1000);
}

function updateAge(element) {
  setText(element, `${duration(secondsSince(element.dateTime))} ago`);
}
