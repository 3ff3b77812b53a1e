// The page of one run: its state and numbers, curves, goals, recordings, actors, log, configuration and primitives.

import { ApiError, get, sentence } from "./api.js";
import { Board } from "./board.js";
import { Commands } from "./commands.js";
import { ConfigList } from "./config.js";
import { el, note, section, setText } from "./dom.js";
import { every, follow, isActive } from "./follow.js";
import { count, NBSP, percent, quantity } from "./format.js";
import { GoalMap } from "./goals.js";
import { Log } from "./log.js";
import { Media } from "./media.js";
import { OVERVIEW, TRIAL } from "./metrics.js";
import { Versions } from "./primitives.js";
import { GoalSpace } from "./space.js";
import { age, progressBar, share, stateChip, Table, timeLeft, trialText } from "./widgets.js";

const GOALS_MS = 5000;
const FILES_MS = 15_000;
const CURVES_MS = 2000;
const BOB = "bob/success_rate";
/** Names that the registry takes; a damaged directory has its id in place of one. */
const NAME = /^[a-z0-9][a-z0-9._-]{0,63}$/;
const ORDER = ["starting", "alive"];

/** Show a run until ``signal`` aborts. */
export function runView(root, runId, signal) {
  const page = new RunPage(root, runId, signal);
  follow(runId, page, signal);
}

class RunPage {
  constructor(root, runId, signal) {
    Object.assign(this, { root, runId, signal, begun: false });
    this.summary = new Summary(runId);
    [this.goals, this.space] = [new GoalMap(), new GoalSpace(signal)];
    this.actors = new ActorTable();
    this.media = new Media(runId);
    [this.log, this.config, this.commands] = [new Log(), new ConfigList(), new Commands()];
    root.replaceChildren(this.heading(), note("Asking \u2026"));
  }

  heading() {
    return el("h1", {}, this.runId);
  }

  /** Put the parts together, once the run is known to exist. */
  begin(run) {
    this.begun = true;
    this.board = new Board([{ id: this.runId, label: this.runId, study: null }], run.trial ? TRIAL : OVERVIEW, this.signal);
    const parts = {
      curves: section("Curves", "wide"), space: section("Goals over the run", "wide"), map: section("Goal map", "wide"),
      media: section("Recordings"), actors: section("Actors"), log: section("Log"), commands: section("Commands"), config: section("Configuration"),
    };
    for (const name of run.trial ? ["space", "map", "actors"] : []) delete parts[name]; // which self-play has
    const [name, published] = run.trial ? (run.trial.primitives ?? "").split("@") : [run.name, NAME.test(run.name)];
    this.parts = parts;
    this.primitives = published ? new Versions(name, `Primitives ${name}`) : null;
    parts.curves.body.append(this.board.root);
    this.actorsBody = parts.actors?.body;
    const bodies = Object.fromEntries(Object.entries(parts).map(([key, part]) => [key, part.body]));
    this.root.replaceChildren(this.summary.root, ...[...Object.values(parts), ...(this.primitives ? [this.primitives] : [])].map((part) => part.root));
    this.ask(bodies);
  }

  /** Leave out what only self-play has, where the run is of another method and has nothing of it. */
  fit() {
    const { isOther } = this.board;
    const { space, map } = this.parts;
    if (space) space.root.hidden = isOther && !this.space.frames.length;
    if (map) map.root.hidden = isOther && !map.body.contains(this.goals.root);
    for (const each of [this.summary.bob, this.summary.tiles.lag]) each.root.hidden = isOther;
  }

  ask(bodies) {
    const { signal, runId } = this;
    const part = (...names) => get(["v1", "runs", runId, ...names], [], signal);
    const keep = (milliseconds, name, shown, ...path) =>
      bodies[name] && every(milliseconds, signal, () => show(bodies[name], shown, () => part(...path)).then(() => this.fit()));
    keep(GOALS_MS, "map", this.goals, "goals");
    keep(FILES_MS, "space", this.space, "goals", "history");
    keep(FILES_MS, "media", this.media, "files");
    keep(GOALS_MS, "log", this.log, "log");
    if (this.primitives) every(FILES_MS, signal, () => this.primitives.refresh(signal));
    every(FILES_MS, signal, async () => {
      this.setup = await part("setup");
      await show(bodies.config, this.config, () => this.setup);
      this.commands.update(this.run, this.setup);
      if (!bodies.commands.firstChild) bodies.commands.append(this.commands.root);
    });
  }

  status(run) {
    this.run = run;
    if (!this.begun) this.begin(run);
    this.summary.update(run);
    if (this.missed) this.curves(); // of a run that has ended nothing else asks again
    if (this.setup) this.commands.update(run, this.setup);
    if (!this.actorsBody) return;
    this.actors.update(run);
    const there = run.actors.length ? this.actors.root : note("No actors of this run are known.");
    if (this.actorsBody.firstChild !== there) this.actorsBody.replaceChildren(there);
  }

  /** Ask for the curves, now or soon: once, however many iterations came meanwhile. */
  async curves() {
    if (this.asking) {
      this.again = true;
      return;
    }
    this.asking = true;
    try {
      do {
        this.again = false;
        await this.board.refresh();
        this.fit();
        this.missed = false;
        this.summary.trouble(null);
        this.summary.success((await this.board.newest([BOB])).get(this.runId));
        await new Promise((resolve) => setTimeout(resolve, CURVES_MS));
      } while (this.again && !this.signal.aborted);
    } catch (error) {
      this.missed = true;
      this.failed(error);
    } finally {
      this.asking = false;
    }
  }

  /** Say that the run does not exist or cannot be read; the banner says that the service does not answer. */
  failed(error) {
    if (!(error instanceof ApiError)) console.warn(error);
    if (!error.status || error.status === 401 || (this.begun && error.status === 503)) return;
    if (this.begun) this.summary.trouble(sentence(error.message));
    else this.root.replaceChildren(this.heading(), note(`${sentence(error.message)} `, el("a", { href: "#/" }, "All runs")));
  }
}

/** Fill a part's body, or say why it is empty. */
async function show(body, part, find) {
  try {
    part.update(await find());
    if (!body.contains(part.root)) body.replaceChildren(part.root);
  } catch (error) {
    if (!(error instanceof ApiError) || error.status === 0) throw error;
    body.replaceChildren(note(sentence(error.message)));
  }
}

/** The head of the page: state, progress, and errors. */
class Summary {
  constructor(runId) {
    this.chip = el("span", {});
    this.sub = el("p", { class: "summary" });
    this.troubles = el("div", { class: "troubles", role: "status" });
    this.numbers = el("dl", { class: "tiles" });
    this.bob = tile("Bob's success", "on Alice's goals");
    const here = el("span", { "aria-current": "page" }, runId);
    const trail = el("nav", { class: "trail", "aria-label": "Breadcrumb" }, el("a", { href: "#/" }, "Runs"), " / ", here);
    this.root = el("div", {}, trail, el("h1", {}, runId, " ", this.chip), this.sub, this.troubles, this.numbers);
    this.tiles = {
      progress: tile("Progress"),
      rate: tile("Env steps/s"),
      iteration: tile("Iteration"),
      lag: tile("Policy lag"),
      rollouts: tile("Rollouts"),
    };
    this.final = { last: tile("Final success"), ever: tile("At any step") };
  }

  /** Put the tiles there, once it is known what kind of run it is. */
  begin(run) {
    const { progress, rate, iteration, ...others } = this.tiles;
    const shown = run.trial ? [progress, ...Object.values(this.final), rate, iteration] : [progress, this.bob, rate, iteration, ...Object.values(others)];
    this.numbers.append(...shown.map((each) => each.root));
  }

  update(run) {
    if (!this.run) this.begin(run);
    this.run = run;
    this.chip.replaceChildren(stateChip(run));
    const published = run.published ? [`, published ${run.published}`] : [];
    const what = run.trial ? trialText(run.trial) : `${run.name}, ${run.runtime} runtime`;
    this.sub.replaceChildren(`${what}, started `, age(run.started), ", heard of ", age(run.heartbeat), ...published);
    if (run.trial) this.finally(run.trial);
    const { progress, rate, iteration, lag, rollouts } = this.tiles;
    const left = timeLeft(run);
    progress.set(percent(share(run)), left ? `about ${left} to go` : "");
    progress.bar.replaceChildren(progressBar(run));
    rate.set(count(run.env_steps_per_s), isActive(run) ? "newest iteration" : "last iteration");
    iteration.set(count(run.iteration), run.trial ? "" : `policy version ${count(run.policy_version)}`);
    lag.set(quantity(run.policy_lag), "versions");
    rollouts.set(count(run.num_rollouts_counted), `${count(run.num_rollouts_refused)} refused`);
    this.show();
  }

  show() {
    const run = this.run;
    const boxes = [
      ...(this.cannot ? [["error", "This run cannot be followed", this.cannot]] : []),
      ...(run.last_error ? [["error", "Last error", run.last_error]] : []),
      ...run.warnings.map((text) => ["warning", "Warning", text]),
    ];
    const key = JSON.stringify(boxes);
    if (key === this.shown) return; // so that a screen reader says it once
    this.shown = key;
    this.troubles.replaceChildren(...boxes.map(([kind, title, text]) => el("p", { class: kind }, el("strong", {}, `${title}: `), text)));
  }

  /** Show how well a run does its task in the end. */
  finally({ success, success_low: low, success_high: high, success_ever: ever, num_episodes: episodes }) {
    const known = Number.isFinite(success);
    this.final.last.set(percent(success), known ? `last step, ${(100 * low).toFixed(0)} to ${(100 * high).toFixed(0)}${NBSP}%` : "once it has ended");
    this.final.ever.set(percent(ever), known ? `of ${count(episodes)} episodes` : "once it has ended");
  }

  /** Show Bob's success in the newest iteration. */
  success(value) {
    this.bob.set(percent(value), "on Alice's goals");
  }

  /** Say why there are no new values; null if there are again. */
  trouble(text) {
    this.cannot = text;
    this.show();
  }
}

function tile(label, small = "") {
  const [value, more, bar] = [el("span", { class: "value" }, "\u2013"), el("small", {}, small), el("span", {})];
  const root = el("div", { class: "tile" }, el("dt", {}, label), el("dd", {}, value, bar, more));
  const set = (text, below) => {
    setText(value, text);
    setText(more, below);
  };
  return { root, bar, set };
}

/** The table of RunStatus.actors, starting ones first; if the run has ended, with their last values. */
class ActorTable {
  constructor() {
    this.table = new Table(
      "Actors",
      [
        { label: "Actor", text: (actor) => actor.name },
        { label: "State", changed: (actor) => actor.state, node: (actor) => el("span", { class: `chip ${actor.state}` }, actor.state) },
        { label: "Replaced", text: (actor) => count(actor.num_replaced), number: true },
        { label: "Node", text: (actor) => actor.node || "this machine" },
        { label: "Heard of", changed: (actor) => actor.heartbeat, node: (actor) => age(actor.heartbeat) },
        { label: "Rollouts", text: (actor) => count(actor.num_rollouts), number: true },
        { label: "Env steps", text: (actor) => count(actor.num_env_steps), number: true },
        { label: "Last error", text: (actor) => actor.last_error ?? "\u2013" },
      ],
      (actor) => actor.name,
    );
    this.root = el("div", { class: "scroll" }, this.table.root);
  }

  update(run) {
    const byName = (a, b) => a.name.localeCompare(b.name, "en", { numeric: true });
    const actors = run.actors.map((actor) => (isActive(run) ? actor : { ...actor, state: "ended" }));
    this.table.update(actors.sort((a, b) => ORDER.indexOf(a.state) - ORDER.indexOf(b.state) || byName(a, b)));
  }
}
