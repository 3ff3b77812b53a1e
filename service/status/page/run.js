// The page of one run.

import { ApiError, get, sentence } from "./api.js";
import { ActorTable } from "./actors.js";
import { el, note, section } from "./dom.js";
import { follow } from "./follow.js";
import { GoalMap } from "./goals.js";
import { Media } from "./media.js";
import { NAMES, Panels } from "./panels.js";
import { Versions } from "./primitives.js";
import { Summary } from "./summary.js";
import { every } from "./times.js";

const GOALS_MS = 5000;
const FILES_MS = 15_000;

/** Everything about a run; ends when ``signal`` says so. */
export function runView(root, runId, signal) {
  const page = new RunPage(root, runId, signal);
  follow(runId, NAMES, page, signal);
}

class RunPage {
  constructor(root, runId, signal) {
    Object.assign(this, { root, runId, signal, begun: false });
    this.summary = new Summary(runId);
    this.panels = new Panels(signal);
    this.goals = new GoalMap();
    this.actors = new ActorTable();
    this.media = new Media(runId);
    root.replaceChildren(this.heading(), note("Asking \u2026"));
  }

  heading() {
    return el("h1", {}, this.runId);
  }

  /** Put the parts together, when it is known that there is such a run. */
  begin(run) {
    this.begun = true;
    const [curves, map] = [section("Curves", "wide"), section("Goal map", "wide")];
    const [actors, film] = [section("Actors"), section("Newest video")];
    this.primitives = new Versions(run.name, `Primitives ${run.name}`);
    curves.body.append(this.panels.root);
    this.actorsBody = actors.body;
    film.body.append(this.media.root);
    const parts = [curves, map, film, actors, this.primitives].map((part) => part.root);
    this.root.replaceChildren(this.summary.root, ...parts);
    this.ask(map.body, film.body);
  }

  ask(mapBody, filmBody) {
    const { signal, runId } = this;
    const part = (name) => get(["v1", "runs", runId, name], [], signal);
    every(GOALS_MS, signal, () => shown(mapBody, this.goals, () => part("goals")));
    every(FILES_MS, signal, () => shown(filmBody, this.media, () => part("files")));
    every(FILES_MS, signal, () => this.primitives.refresh(signal));
  }

  status(run) {
    if (!this.begun) this.begin(run);
    this.summary.update(run);
    this.actors.update(run);
    const there = run.actors.length ? this.actors.root : note("No actors are known of this run.");
    if (this.actorsBody.firstChild !== there) this.actorsBody.replaceChildren(there);
  }

  history(history) {
    this.summary.trouble(null);
    this.panels.load(history);
    this.success();
  }

  record(record) {
    this.panels.append(record);
    this.success();
  }

  success() {
    this.summary.success(this.panels.series.latest("bob/success_rate"));
  }

  /** No such run, or one that cannot be read; of a service that is away the banner tells. */
  failed(error) {
    if (!(error instanceof ApiError)) console.warn(error);
    if (!error.status || (this.begun && error.status === 503)) return;
    if (this.begun) this.summary.trouble(sentence(error.message));
    else this.root.replaceChildren(this.heading(), note(`${sentence(error.message)} `, el("a", { href: "#/" }, "All runs")));
  }
}

/** Show what is found in a part's body, or why there is nothing. */
async function shown(body, part, find) {
  try {
    part.update(await find());
    if (!body.contains(part.root)) body.replaceChildren(part.root);
  } catch (error) {
    if (!(error instanceof ApiError) || error.status === 0) throw error;
    body.replaceChildren(note(sentence(error.message)));
  }
}
