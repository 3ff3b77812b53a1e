// What happened to a run: who died, who came back, how it ended.

import { el, note, setText } from "./dom.js";
import { counted } from "./format.js";
import { age } from "./widgets.js";

export class Log {
  constructor() {
    this.lines = el("div", {});
    this.output = el("pre", {});
    this.details = el("details", {}, el("summary", {}, "What its processes wrote last"), this.output);
    this.root = el("div", {}, this.lines, this.details);
    this.shown = null;
  }

  /** ``log`` is a RunLog; the newest comes first. */
  update(log) {
    const key = JSON.stringify([log.num_entries, log.entries.at(-1), log.output.at(-1)]);
    if (key === this.shown) return;
    this.shown = key;
    const lines = log.entries.toReversed().map((entry) => el("li", { class: entry.level }, age(entry.at), " ", el("span", {}, entry.text)));
    const more = log.num_entries > log.entries.length ? [note(`${counted(log.num_entries - log.entries.length, "earlier line")} not shown.`)] : [];
    const list = lines.length ? el("ol", { class: "log", tabindex: 0, "aria-label": "Log" }, ...lines) : note("Nothing yet. A run of an earlier version, or on another machine, keeps no log here.");
    this.lines.replaceChildren(list, ...more);
    setText(this.output, log.output.join("\n"));
    this.details.hidden = !log.output.length;
  }
}
