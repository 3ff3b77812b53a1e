// The page of all primitives, and the table of the versions of a name, which a run's page shows too.

import { address, ApiError, get, sentence } from "./api.js";
import { el, note, runLink, section, setText } from "./dom.js";
import { every } from "./follow.js";
import { bytes, counted, percent } from "./format.js";
import { age, Table } from "./widgets.js";

const EVERY_MS = 10_000;
const RATES = [["Mixed", "evaluation/mixed_success_last"], ["Table", "evaluation/table_success_last"], ["Air", "evaluation/air_success_last"]];

/** Every name in the registry, each with its versions. */
export function primitivesView(root, signal) {
  const list = el("div", {});
  const shown = new Map();
  root.replaceChildren(el("h1", {}, "Primitives"), el("p", { class: "summary" }, "Frozen policies: those that runs have published here, and those that come with tandem. Newest first."), list);
  return every(EVERY_MS, signal, async () => {
    const [{ primitives }, runs] = await Promise.all([get(["v1", "primitives"], [], signal), publishers(signal)]);
    const parts = [];
    for (const { name } of primitives) {
      if (!shown.has(name)) shown.set(name, new Versions(name, name));
      parts.push(shown.get(name));
    }
    await Promise.all(parts.map((part) => part.refresh(signal, runs)));
    const users = usersOf(parts);
    parts.forEach((part) => part.table.update(part.found, runs, users));
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

  /** Ask for the versions; ``runs`` as of ``publishers``, asked for where it is null. */
  async refresh(signal, runs = null) {
    try {
      const found = await get(["v1", "primitives", this.name], [], signal);
      this.found = found;
      const more = found.num_versions > found.versions.length ? `, the newest ${found.versions.length} here` : "";
      setText(this.summary, `${counted(found.num_versions, "version")}${more}. In Python: service.load_primitives("${this.name}@latest").`);
      this.table.update(found, runs ?? (await publishers(signal)), new Map());
      if (!this.table.root.isConnected || !this.body.contains(this.table.root)) this.body.replaceChildren(this.summary, this.table.root);
    } catch (error) {
      if (!(error instanceof ApiError) || error.status === 0) throw error;
      const text = error.status === 404 ? `No version of ${this.name} is published yet.` : sentence(error.message);
      this.body.replaceChildren(note(text));
    }
  }
}

/** The runs that published something, by NAME@VERSION. */
async function publishers(signal) {
  const { runs } = await get(["v1", "runs"], [["limit", 1000]], signal).catch(() => ({ runs: [] }));
  return new Map(runs.filter((run) => run.published).map((run) => [run.published, run.run_id]));
}

/** Which versions belong to which primitives, or were trained on from which: NAME@VERSION to a list of them. */
function usersOf(parts) {
  const users = new Map();
  for (const { found } of parts) {
    for (const version of found?.versions ?? []) {
      for (const source of [version.primitives, version.parent].filter(Boolean)) {
        users.set(source, [...(users.get(source) ?? []), `${found.name}@${version.version}`]);
      }
    }
  }
  return users;
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
      { label: "Where", changed: (version) => [version.origin, version.directory], node: where },
      { label: "Published", changed: (version) => version.created, node: created },
      { label: "Lineage", changed: (version) => [version.lineage.map(([text, id]) => `${text} ${id}`)], node: lineage },
      { label: "Commit", text: (version) => version.git_commit?.slice(0, 8) ?? "\u2013" },
      { label: "Size", text: (version) => bytes(version.blob_bytes), number: true },
      { label: "Download", changed: (version) => version.blob_sha256, node: (version) => downloads(name, version) },
    ];
    this.table = new Table(`Versions of ${name}`, columns, (version) => version.version);
    this.root = el("div", { class: "scroll" }, this.table.root);
  }

  /** ``runs`` and ``users`` as of ``publishers`` and ``usersOf``. */
  update(primitive, runs, users) {
    if (!primitive) return;
    const rows = primitive.versions.map((version) => ({ ...version, lineage: lineageOf(`${primitive.name}@${version.version}`, version, runs, users) }));
    this.table.update(rows);
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

/** What is known of where a version comes from and what was made with it: [text, id of a run or null] each. */
function lineageOf(reference, version, runs, users) {
  const run = version.run ?? (version.origin === "registry" ? runs.get(reference) : null);
  return [
    ...(version.kind === "primitives" ? [] : [[version.kind, null]]),
    ...(run ? [["made by run ", run]] : []),
    ...(version.parent ? [[`trained on from ${version.parent}`, null]] : []),
    ...(version.primitives ? [[`composes ${version.primitives}`, null]] : []),
    ...(users.get(reference) ?? []).map((user) => [`used by ${user}`, null]),
  ];
}

function lineage(version) {
  if (!version.lineage.length) return document.createTextNode("\u2013");
  return el("span", { class: "lines" }, ...version.lineage.map(([text, id]) => el("small", {}, text, id && runLink(id))));
}

function where(version) {
  const text = version.origin === "bundled" ? "comes with tandem" : "registry";
  return el("span", { class: "lines" }, el("span", { class: "chip" }, text), el("small", {}, version.directory));
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
