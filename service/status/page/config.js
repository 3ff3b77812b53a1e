// A run's resolved configuration, as a list that can be searched, and what differs between those of several runs.

import { el, note, setText } from "./dom.js";
import { counted } from "./format.js";

/** A configuration as a list of [key, value], such as ["learner.bob.gae_lambda", "0.9"]. */
export function flat(tree, before = "") {
  return Object.entries(tree ?? {}).flatMap(([key, value]) =>
    value !== null && typeof value === "object" && !Array.isArray(value) ? flat(value, `${before}${key}.`) : [[before + key, JSON.stringify(value)]],
  );
}

/** The configuration of one run. */
export class ConfigList {
  constructor() {
    this.search = el("input", { type: "search", placeholder: "Find a setting", "aria-label": "Find a setting" });
    this.search.addEventListener("input", () => this.show());
    this.list = el("dl", { class: "settings" });
    this.sum = el("p", { class: "hint" });
    this.root = el("div", {}, this.search, this.sum, this.list);
    this.rows = [];
  }

  update({ config, problem }) {
    const key = JSON.stringify([config, problem]);
    if (key === this.key) return; // so that what somebody has selected stays so
    this.key = key;
    this.rows = flat(config);
    this.problem = problem;
    this.show();
  }

  show() {
    const wanted = this.search.value.trim().toLowerCase();
    const found = this.rows.filter(([key, value]) => `${key} ${value}`.toLowerCase().includes(wanted));
    setText(this.sum, this.problem ?? `${counted(found.length, "setting")} of ${this.rows.length}`);
    this.list.replaceChildren(...found.map(([key, value]) => el("div", {}, el("dt", {}, key), el("dd", {}, el("code", {}, value)))));
  }
}

/** The table of what differs between runs: ``setups`` are {run_id, config}. */
export function differences(setups) {
  const known = setups.map(({ run_id: id, config }) => [id, config && new Map(flat(config))]);
  const there = known.filter(([, settings]) => settings);
  const keys = [...new Set(there.flatMap(([, settings]) => [...settings.keys()]))].sort();
  const differing = keys.filter((key) => new Set(there.map(([, settings]) => settings.get(key) ?? "\u2013")).size > 1);
  if (there.length < 2) return note("Fewer than two of these runs have a configuration here.");
  if (!differing.length) return note("Their configurations are the same in every setting.");
  const head = el("tr", {}, el("th", { scope: "col" }, "Setting"), ...known.map(([id]) => el("th", { scope: "col" }, id)));
  const rows = differing.map((key) =>
    el("tr", {}, el("th", { scope: "row" }, key), ...known.map(([id, settings]) => el("td", { "data-label": id }, el("code", {}, settings?.get(key) ?? "\u2013")))),
  );
  return el("div", { class: "scroll" }, el("table", { class: "differences", "aria-label": "What differs" }, el("thead", {}, head), el("tbody", {}, ...rows)));
}
