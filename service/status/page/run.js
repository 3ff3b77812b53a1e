// The page of one run: its state and numbers, curves, goal map, newest video, actors and primitives.

import { address, ApiError, get, sentence } from "./api.js";
import { NAMES, Panels } from "./curves.js";
import { el, note, section, setText } from "./dom.js";
import { every, follow, isActive } from "./follow.js";
import { bytes, count, percent, quantity } from "./format.js";
import { GoalMap } from "./goals.js";
import { Versions } from "./primitives.js";
import { age, progressBar, share, stateChip, Table, timeLeft } from "./widgets.js";

const GOALS_MS = 5000;
const FILES_MS = 15_000;
const ORDER = ["lost", "starting", "alive"];

/** Show a run until ``signal`` aborts. */
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

  /** Put the parts together, once the run is known to exist. */
  begin(run) {
    this.begun = true;
    const [curves, map] = [section("Curves", "wide"), section("Goal map", "wide")];
    const [actors, video] = [section("Actors"), section("Newest video")];
    this.primitives = new Versions(run.name, `Primitives ${run.name}`);
    curves.body.append(this.panels.root);
    this.actorsBody = actors.body;
    video.body.append(this.media.root);
    const parts = [curves, map, video, actors, this.primitives].map((part) => part.root);
    this.root.replaceChildren(this.summary.root, ...parts);
    this.ask(map.body, video.body);
  }

  ask(mapBody, videoBody) {
    const { signal, runId } = this;
    const part = (name) => get(["v1", "runs", runId, name], [], signal);
    every(GOALS_MS, signal, () => shown(mapBody, this.goals, () => part("goals")));
    every(FILES_MS, signal, () => shown(videoBody, this.media, () => part("files")));
    every(FILES_MS, signal, () => this.primitives.refresh(signal));
  }

  status(run) {
    if (!this.begun) this.begin(run);
    this.summary.update(run);
    this.actors.update(run);
    const there = run.actors.length ? this.actors.root : note("No actors of this run are known.");
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

  /** Say that the run does not exist or cannot be read; the banner says that the service does not answer. */
  failed(error) {
    if (!(error instanceof ApiError)) console.warn(error);
    if (!error.status || (this.begun && error.status === 503)) return;
    if (this.begun) this.summary.trouble(sentence(error.message));
    else this.root.replaceChildren(this.heading(), note(`${sentence(error.message)} `, el("a", { href: "#/" }, "All runs")));
  }
}

/** Fill a part's body, or say why it is empty. */
async function shown(body, part, find) {
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
    const trail = el("nav", { class: "trail", "aria-label": "Breadcrumb" }, el("a", { href: "#/" }, "Runs"), " / ");
    this.root = el("div", {}, trail, el("h1", {}, runId, " ", this.chip), this.sub, this.troubles, this.numbers);
    this.tiles = {
      progress: tile("Progress"),
      rate: tile("Env steps/s"),
      iteration: tile("Iteration"),
      lag: tile("Policy lag"),
      rollouts: tile("Rollouts"),
    };
    const { progress, ...others } = this.tiles;
    this.numbers.append(progress.root, this.bob.root, ...Object.values(others).map((each) => each.root));
  }

  update(run) {
    this.run = run;
    this.chip.replaceChildren(stateChip(run));
    const published = run.published ? [`, published ${run.published}`] : [];
    this.sub.replaceChildren(`${run.name}, ${run.runtime} runtime, started `, age(run.started), ", heard of ", age(run.heartbeat), ...published);
    const { progress, rate, iteration, lag, rollouts } = this.tiles;
    const left = timeLeft(run);
    progress.set(percent(share(run)), left ? `about ${left} to go` : "");
    progress.bar.replaceChildren(progressBar(run));
    rate.set(count(run.env_steps_per_s), isActive(run) ? "newest iteration" : "last iteration");
    iteration.set(count(run.iteration), `policy version ${count(run.policy_version)}`);
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

/** The table of RunStatus.actors, lost ones first; if the run has ended, with their last values. */
class ActorTable {
  constructor() {
    this.table = new Table(
      "Actors",
      [
        { label: "Actor", text: (actor) => actor.name },
        { label: "State", changed: (actor) => actor.state, node: (actor) => el("span", { class: `chip ${actor.state}` }, actor.state) },
        { label: "Replaced", text: (actor) => count(actor.incarnation), number: true },
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

/** The newest video and the pictures, from RunFiles; a video keeps playing until there is a newer one. */
class Media {
  constructor(runId) {
    this.runId = runId;
    this.shown = null;
    this.root = el("div", { class: "media" });
  }

  update({ files }) {
    const key = JSON.stringify(files);
    if (key === this.shown) return;
    this.shown = key;
    const isVideo = (file) => file.media_type.startsWith("video/");
    const videos = files.filter(isVideo).sort((a, b) => Date.parse(b.modified) - Date.parse(a.modified));
    const pictures = files.filter((file) => !isVideo(file));
    const video = videos.length ? this.video(videos[0]) : note("No video yet: a run records a few rounds at its end.");
    this.root.replaceChildren(video, el("ul", { class: "pictures" }, ...pictures.map((file) => this.picture(file))));
  }

  video(file) {
    const player = el("video", { controls: true, preload: "metadata", muted: true, loop: true, playsinline: true, src: `${this.url(file)}#t=0.1`, "aria-label": file.title });
    const words = [`${file.title}, ${bytes(file.num_bytes)}, `, age(file.modified), ". "];
    return el("figure", { class: "recording" }, player, el("figcaption", {}, ...words, el("a", { href: this.url(file), download: file.name }, "Download")));
  }

  picture(file) {
    const image = el("img", { src: this.url(file), alt: "", loading: "lazy", decoding: "async" });
    return el("li", {}, el("a", { href: this.url(file) }, image, file.title), ` ${bytes(file.num_bytes)}`);
  }

  /** The URL with the file's time, so that a browser does not show an older file from its cache. */
  url(file) {
    return `${address("v1", "runs", this.runId, "files", file.name)}?modified=${encodeURIComponent(file.modified)}`;
  }
}
