// The table of a run's actors, those that are lost first.

import { el } from "./dom.js";
import { isActive } from "./follow.js";
import { count } from "./format.js";
import { Table } from "./table.js";
import { age } from "./times.js";

const ORDER = ["lost", "starting", "alive"];

/** Of RunStatus.actors; those of a run that has ended are what they were in the end. */
export class ActorTable {
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
