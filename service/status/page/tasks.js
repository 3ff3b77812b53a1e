// The table of downstream tasks: a row per method, a column per task, success averaged over seeds. Cells lead to their runs.

import { ApiError, get, sentence } from "./api.js";
import { el, note, runsLink } from "./dom.js";
import { every } from "./follow.js";
import { counted, percent, setting } from "./format.js";
import { Table } from "./widgets.js";

const EVERY_MS = 5000;

/** Show the table until ``signal`` aborts. */
export function tasksView(root, signal) {
  const list = el("div", { class: "scroll" }, note("Asking \u2026"));
  const said = el("p", { class: "summary" }, "Success at the last step of an episode: the mean over seeds, with a 95 % interval. The interval of a single seed only says how far the share may be off because its episodes are few, not how far another seed would differ.");
  const problems = el("div", { class: "troubles", role: "status" });
  root.replaceChildren(el("h1", {}, "Tasks"), said, problems, list);
  let [table, columns] = [null, ""];
  return every(EVERY_MS, signal, async () => {
    try {
      const found = await get(["v1", "downstream"], [], signal);
      if (columns !== JSON.stringify(found.tasks)) {
        columns = JSON.stringify(found.tasks);
        table = new Table("Tasks", columnsOf(found.tasks), (row) => row.key);
      }
      if (!found.rows.length) list.replaceChildren(nothing());
      else if (list.firstChild !== table.root) list.replaceChildren(table.root);
      table.update(keyed(found.rows));
      const texts = found.problems.map((text) => el("p", { class: "warning" }, sentence(text)));
      if (problems.textContent !== texts.map((each) => each.textContent).join("")) problems.replaceChildren(...texts);
    } catch (error) {
      if (!(error instanceof ApiError) || !error.status) throw error;
      list.replaceChildren(note(sentence(error.message)));
    }
  });
}

/** Rows with a key each: a method may have several with the same primitives. */
function keyed(rows) {
  const seen = new Map();
  return rows.map((row) => {
    const name = JSON.stringify([row.method, row.primitives_digest]);
    seen.set(name, (seen.get(name) ?? 0) + 1);
    return { ...row, key: `${name} ${seen.get(name)}` };
  });
}

function columnsOf(tasks) {
  const versions = (task) => tasks.filter((each) => each.task === task).length;
  return [
    { label: "Method", changed: (row) => [row.primitives, row.cells.flatMap((each) => [...each.run_ids, ...each.unfinished])], node: method },
    ...tasks.map(({ task, version, title }) => {
      const of = (row) => row.cells.find((each) => each.task === task && each.version === version);
      return { label: versions(task) > 1 ? `${title} v${version}` : title, changed: (row) => JSON.stringify(of(row) ?? null), node: (row) => cell(of(row)) };
    }),
  ];
}

function method(row) {
  const ids = row.cells.flatMap((each) => [...each.run_ids, ...each.unfinished]);
  return el("span", { class: "two" }, row.title, el("small", {}, row.primitives ?? "no primitives"), el("small", {}, runsLink(ids, counted(ids.length, "run"))));
}

function cell(found) {
  if (!found) return el("span", { class: "none" }, "\u2013");
  const { success, low, high, num_seeds: seeds, run_ids: ids, unfinished } = found;
  const settings = Object.entries(found.differs).map(([key, value]) => el("small", {}, setting(key, value)));
  return el(
    "span",
    { class: "lines" },
    success === null ? "\u2013" : runsLink(ids, percent(success), percent(success)),
    success === null ? null : el("small", {}, `${(100 * low).toFixed(0)} to ${(100 * high).toFixed(0)}, ${counted(seeds, "seed")}`),
    ...settings,
    unfinished.length ? el("small", {}, runsLink(unfinished, `${unfinished.length} not ended`, "1 not ended")) : null,
  );
}

function nothing() {
  const command = el("code", {}, "tandem train push --method ours");
  return note("No run has learned a task yet. Start one with ", command, ": it appears here, and under Runs, when it has started.");
}
