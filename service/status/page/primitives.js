// The page of all primitives, and the part of a run's page that tells of those under its name.

import { ApiError, get, sentence } from "./api.js";
import { el, note, section, setText } from "./dom.js";
import { counted } from "./format.js";
import { VersionTable } from "./registry.js";
import { every } from "./times.js";

const EVERY_MS = 10_000;

/** Every name in the registry, each with its versions. */
export function primitivesView(root, signal) {
  const list = el("div", {});
  const shown = new Map();
  root.replaceChildren(el("h1", {}, "Primitives"), el("p", { class: "summary" }, "Frozen policies that runs have published, newest first."), list);
  return every(EVERY_MS, signal, async () => {
    const { primitives } = await get(["v1", "primitives"], [], signal);
    const parts = [];
    for (const { name } of primitives) {
      if (!shown.has(name)) shown.set(name, new Versions(name, name));
      parts.push(shown.get(name));
    }
    await Promise.all(parts.map((part) => part.refresh(signal)));
    const nodes = parts.length ? parts.map((part) => part.root) : [nothing()];
    if (nodes.length !== list.children.length || nodes.some((node, i) => node !== list.children[i])) list.replaceChildren(...nodes);
  });
}

/** The versions of one name, in a section of its own. */
export class Versions {
  constructor(name, title) {
    Object.assign(this, { name, ...section(title) });
    this.summary = el("p", { class: "summary" });
    this.table = new VersionTable(name);
  }

  async refresh(signal) {
    try {
      const found = await get(["v1", "primitives", this.name], [], signal);
      const more = found.num_versions > found.versions.length ? `, the newest ${found.versions.length} here` : "";
      setText(this.summary, `${counted(found.num_versions, "version")}${more}. In Python: service.load_primitives("${this.name}@latest").`);
      this.table.update(found);
      if (!this.table.root.isConnected || !this.body.contains(this.table.root)) this.body.replaceChildren(this.summary, this.table.root);
    } catch (error) {
      if (!(error instanceof ApiError) || error.status === 0) throw error;
      const text = error.status === 404 ? `No version of ${this.name} is published yet.` : sentence(error.message);
      this.body.replaceChildren(note(text));
    }
  }
}

function nothing() {
  const command = el("code", {}, "tandem pretrain --config configs/pretrain/panda_cube.yaml --run-dir runs/cube");
  return note("The registry is empty. A run publishes its primitives at its end; start one with ", command, ".");
}
