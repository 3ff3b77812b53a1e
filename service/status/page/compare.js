// Several runs side by side: their curves over one another, what differs in their configurations, and how far each is.

import { ApiError, get, sentence } from "./api.js";
import { Board } from "./board.js";
import { differences } from "./config.js";
import { el, note, runLink, section, setText } from "./dom.js";
import { every, isActive, sleep, visible } from "./follow.js";
import { count, counted, percent } from "./format.js";
import { NUM_COLOURS } from "./library.js";
import { comparedPanels } from "./metrics.js";
import { stateChip, Table, trialText } from "./widgets.js";

const EVERY_MS = 5000;
const LIMIT = 1000;
const SUCCESS = ["bob/success_rate", "evaluation/success_last"];

/** Compare the runs with these ids until ``signal`` aborts. */
export async function compareView(root, ids, signal) {
  document.title = `${counted(ids.length, "run")} \u00b7 Tandem`;
  root.replaceChildren(el("h1", {}, counted(ids.length, "run")), note("Asking \u2026"));
  const statuses = await asked(root, ids, signal);
  if (!statuses) return;
  const runs = ids.map((id) => ({ id, label: id, study: studyOf(statuses.get(id)), hidden: false }));
  const board = new Board(runs, comparedPanels(ids.map((id) => statuses.get(id)).filter(Boolean)), signal);
  const table = runTable(board);
  const [curves, setups] = [section("Curves", "wide"), section("What differs", "wide")];
  curves.body.append(board.root);
  root.replaceChildren(el("h1", {}, `${counted(ids.length, "run")} compared`), el("div", { class: "scroll" }, table.root), curves.root, setups.root);
  const row = (run, status, success) => ({ ...run, run, status, success: status?.trial?.success ?? success });
  const show = (found, newest) => table.update(runs.map((run) => row(run, found.get(run.id), newest.get(run.id))));
  let newest = new Map();
  show(statuses, newest);
  compareConfigurations(setups.body, ids, signal);
  await every(EVERY_MS, signal, async () => {
    try {
      await board.refresh();
      newest = await board.newest(SUCCESS);
    } catch (error) {
      board.fail(error);
    }
    show(await statusesOf(ids, signal), newest);
  });
}

/** What runs that differ in their seed alone have in common: their study, or their task. */
function studyOf(run) {
  return run?.study ?? (run?.trial ? trialText({ ...run.trial, seed: null }) : null);
}

/** Ask for the runs until there is an answer; null if the view is left before. */
async function asked(root, ids, signal) {
  const trouble = note();
  while (!signal.aborted) {
    await visible(signal);
    try {
      return await statusesOf(ids, signal);
    } catch (error) {
      if (signal.aborted) return null;
      setText(trouble, error instanceof ApiError ? sentence(error.message) : String(error));
      root.append(trouble);
    }
    await sleep(EVERY_MS, signal);
  }
  return null;
}

/** The runs with these ids, by their ids, without those that are not there. */
async function statusesOf(ids, signal) {
  const { runs, num_runs: numRuns } = await get(["v1", "runs"], [["limit", LIMIT]], signal);
  const newest = new Map(runs.map((run) => [run.run_id, run]));
  const older = numRuns > runs.length ? ids.filter((id) => !newest.has(id)) : [];
  const found = await Promise.all(older.map((id) => statusOf(id, signal)));
  return new Map([...newest, ...found.filter(Boolean).map((run) => [run.run_id, run])]);
}

/** One run; null if it is not there. */
async function statusOf(id, signal) {
  try {
    return await get(["v1", "runs", id], [], signal);
  } catch (error) {
    if ([404, 422].includes(error.status)) return null;
    throw error;
  }
}

async function compareConfigurations(body, ids, signal) {
  const one = (id) => get(["v1", "runs", id, "setup"], [], signal).catch(() => ({ run_id: id, config: null }));
  const setups = await Promise.all(ids.map(one));
  if (!signal.aborted) body.replaceChildren(differences(setups));
}

function runTable(board) {
  const columns = [
    { label: "Run", changed: ({ id }) => id, node: ({ run }) => chooser(run, board) },
    { label: "State", changed: ({ status }) => [status?.state, status?.stopping], node: ({ status }) => (status ? stateChip(status) : el("span", { class: "chip lost" }, "not there")) },
    { label: "Study or task", text: ({ study }) => study ?? "\u2013" },
    { label: "Env steps", text: ({ status }) => count(status?.num_env_steps), number: true },
    { label: "Env steps/s", text: ({ status }) => (status && isActive(status) ? count(status.env_steps_per_s) : "\u2013"), number: true },
    { label: "Success", text: ({ success }) => percent(success), number: true },
    { label: "Published", text: ({ status }) => status?.published ?? "\u2013" },
  ];
  return new Table("Compared runs", columns, (row) => row.id);
}

/** The run's colour and name, and a box that takes its curves away and brings them back. */
function chooser(run, board) {
  const input = el("input", { type: "checkbox", checked: !run.hidden, "aria-label": `Show ${run.id}` });
  input.addEventListener("change", () => {
    run.hidden = !input.checked;
    board.draw();
  });
  const colour = `c${board.runs.indexOf(run) % NUM_COLOURS}`;
  return el("span", { class: `chooser ${colour}` }, input, el("span", { class: "swatch", "aria-hidden": "true" }), runLink(run.id));
}
