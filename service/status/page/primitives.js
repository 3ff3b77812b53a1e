// The page of all primitives, and the table of the versions of a name, which a run's page shows too.

import { address, ApiError, get, sentence } from "./api.js";
import { el, note, section, setText } from "./dom.js";
import { every } from "./follow.js";
import { bytes, counted, percent } from "./format.js";
import { age, Table } from "./widgets.js";

const EVERY_MS = 10_000;
const RATES = [["Mixed", "evaluation/mixed_success_last"], ["Table", "evaluation/table_success_last"], ["Air", "evaluation/air_success_last"]];

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

/** The table of the versions of a name, from PrimitiveVersions. */
class VersionTable {
  constructor(name) {
    const rates = RATES.map(([label, metric]) => ({ label, number: true, text: ({ metrics }) => percent(metrics[metric]) }));
    const columns = [
      { label: "Version", changed: (version) => [version.version, version.problem], node: (version) => reference(name, version) },
      { label: "Aliases", changed: (version) => version.aliases, node: aliases },
      ...rates,
      { label: "Published", changed: (version) => version.created, node: created },
      { label: "Commit", text: (version) => version.git_commit?.slice(0, 8) ?? "\u2013" },
      { label: "Trained further from", text: (version) => version.parent ?? "\u2013" },
      { label: "Size", text: (version) => bytes(version.blob_bytes), number: true },
      { label: "Download", changed: (version) => version.blob_sha256, node: (version) => downloads(name, version) },
    ];
    this.table = new Table(`Versions of ${name}`, columns, (version) => version.version);
    this.root = el("div", { class: "scroll" }, this.table.root);
  }

  update(primitive) {
    this.table.update(primitive.versions);
  }
}

function reference(name, version) {
  const label = el("strong", {}, `${name}@${version.version}`);
  return version.problem ? el("span", {}, label, el("span", { class: "problem" }, version.problem)) : label;
}

function aliases(version) {
  if (!version.aliases.length) return document.createTextNode("\u2013");
  return el("span", { class: "chips" }, ...version.aliases.map((alias) => el("span", { class: "chip alias" }, alias)));
}

function created(version) {
  return version.created ? age(version.created) : document.createTextNode("\u2013");
}

function downloads(name, version) {
  if (!version.blob_sha256) return document.createTextNode("\u2013");
  const [manifest, parameters] = [
    address("v1", "primitives", name, "versions", version.version),
    address("v1", "blobs", "sha256", version.blob_sha256),
  ];
  const of = `of ${name}@${version.version}`;
  return el(
    "span",
    { class: "links" },
    el("a", { href: parameters, download: `${name}-${version.version}.safetensors`, "aria-label": `parameters ${of}` }, "parameters"),
    el("a", { href: manifest, "aria-label": `manifest ${of}` }, "manifest"),
  );
}
