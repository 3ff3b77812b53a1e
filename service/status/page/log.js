// What happened to a run: who died, who came back, how it ended.

import { el, note } from "./dom.js";
import { counted } from "./format.js";
import { age } from "./widgets.js";

export class Log {
  constructor() {
    this.root = el("div", {});
    this.shown = null;
  }

  /** ``log`` is a RunLog; the newest comes first. */
  update(log) {
    const key = JSON.stringify([log.num_entries, log.entries.at(-1), log.output.at(-1)]);
    if (key === this.shown) return;
    this.shown = key;
    const lines = log.entries.toReversed().map((entry) => el("li", { class: entry.level }, age(entry.at), " ", el("span", {}, entry.text)));
    const more = log.num_entries > log.entries.length ? [note(`${counted(log.num_entries - log.entries.length, "earlier line")} not shown.`)] : [];
    const output = log.output.length ? [el("details", {}, el("summary", {}, "What its processes wrote last"), el("pre", {}, log.output.join("\n")))] : [];
    const list = lines.length ? el("ol", { class: "log", tabindex: 0, "aria-label": "Log" }, ...lines) : note("Nothing yet. A run of an earlier version, or on another machine, keeps no log here.");
    this.root.replaceChildren(list, ...more, ...output);
  }
}
