// The head of a run's page: its state, how far it is, and what is wrong.

import { el, setText } from "./dom.js";
import { isActive } from "./follow.js";
import { count, percent, quantity } from "./format.js";
import { progressBar, share, stateChip, timeLeft } from "./progress.js";
import { age, secondsSince } from "./times.js";

const SILENT_S = 30;

export class Summary {
  constructor(runId) {
    this.chip = el("span", {});
    this.sub = el("p", { class: "summary" });
    this.troubles = el("div", { class: "troubles", role: "status" });
    this.numbers = el("dl", { class: "tiles" });
    this.bob = tile("Bob's success", "on Alice's goals");
    const trail = el("nav", { class: "trail", "aria-label": "Where this is" }, el("a", { href: "#/" }, "Runs"), " / ");
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
    const silent = isActive(run) && secondsSince(run.heartbeat) > SILENT_S;
    const warnings = [...run.warnings, ...(silent ? ["not heard of for a while; it may be busy, or gone"] : [])];
    const boxes = [
      ...(this.cannot ? [["error", "This run cannot be followed", this.cannot]] : []),
      ...(run.last_error ? [["error", "Last error", run.last_error]] : []),
      ...warnings.map((text) => ["warning", "Warning", text]),
    ];
    const key = JSON.stringify(boxes);
    if (key === this.shown) return; // a screen reader says it once
    this.shown = key;
    this.troubles.replaceChildren(...boxes.map(([kind, title, text]) => el("p", { class: kind }, el("strong", {}, `${title}: `), text)));
  }

  /** Of the newest iteration. */
  success(value) {
    this.bob.set(percent(value), "on Alice's goals");
  }

  /** Say why nothing is new any more; null when all is well again. */
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
