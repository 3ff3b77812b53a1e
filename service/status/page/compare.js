// Several runs side by side: their curves over one another, what differs in their configurations, and how far each is.

import { ApiError, get, sentence } from "./api.js";
import { Board } from "./board.js";
import { differences } from "./config.js";
import { el, note, runLink, section } from "./dom.js";
import { every, isActive } from "./follow.js";
import { count, counted, percent } from "./format.js";
import { NUM_COLOURS } from "./library.js";
import { comparedPanels } from "./metrics.js";
import { stateChip, Table, trialText } from "./widgets.js";

const EVERY_MS = 5000;
const SUCCESS = ["bob/success_rate", "evaluation/success_last"];

/** Compare the runs with these ids until ``signal`` aborts. */
export async function compareView(root, ids, signal) {
  document.title = `${counted(ids.length, "run")} \u00b7 Tandem`;
  root.replaceChildren(el("h1", {}, counted(ids.length, "run")), note("Asking \u2026"));
  const statuses = await asked(root, signal);
  if (!statuses) return;
  const runs = ids.map((id) => ({ id, label: id, study: studyOf(statuses.get(id)), hidden: false }));
  const board = new Board(runs, comparedPanels(ids.map((id) => statuses.get(id)).filter(Boolean)), signal);
  const table = runTable(board);
  const [curves, setups] = [section("Curves", "wide"), section("What differs", "wide")];
  curves.body.append(board.root);
  root.replaceChildren(el("h1", {}, `${counted(ids.length, "run")} compared`), el("div", { class: "scroll" }, table.root), curves.root, setups.root);
  const show = (found) => table.update(runs.map((run) => ({ ...run, run, status: found.get(run.id), success: found.get(run.id)?.trial?.success ?? newest(board, run.id) })));
  show(statuses);
  compareConfigurations(setups.body, ids, signal);
  await every(EVERY_MS, signal, async () => {
    await board.refresh().catch((error) => board.fail(error));
    const found = await get(["v1", "runs"], [["limit", 1000]], signal);
    show(new Map(found.runs.map((run) => [run.run_id, run])));
  });
}

/** What runs that differ in their seed alone have in common: their study, or their task. */
function studyOf(run) {
  return run?.study ?? (run?.trial ? trialText({ ...run.trial, seed: null }) : null);
}

async function asked(root, signal) {
  try {
    const { runs } = await get(["v1", "runs"], [["limit", 1000]], signal);
    return new Map(runs.map((run) => [run.run_id, run]));
  } catch (error) {
    if (!signal.aborted) root.append(note(error instanceof ApiError ? sentence(error.message) : String(error)));
    return null;
  }
}

function newest(board, id) {
  const curves = board.data.get(id)?.curves ?? {};
  return SUCCESS.map((name) => curves[name]?.mean.findLast((value) => value !== null)).find(Number.isFinite);
}

async function compareConfigurations(body, ids, signal) {
  const one = (id) => get(["v1", "runs", id, "setup"], [], signal).catch(() => ({ run_id: id, config: null }));
  const setups = await Promise.all(ids.map(one));
  if (!signal.aborted) body.replaceChildren(differences(setups));
}

function runTable(board) {
  const columns = [
    { label: "Run", changed: ({ id, hidden }) => [id, hidden], node: ({ run }) => chooser(run, board) },
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
