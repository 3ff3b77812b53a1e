// The page of all primitives, and the table of the versions of a name, which a run's page shows too.

import { address, ApiError, get, sentence } from "./api.js";
import { el, note, runsLink, section, setText } from "./dom.js";
import { every } from "./follow.js";
import { bytes, counted, percent } from "./format.js";
import { age, Table } from "./widgets.js";

const EVERY_MS = 10_000;
const RATES = [["Mixed", "evaluation/mixed_success_last"], ["Table", "evaluation/table_success_last"], ["Air", "evaluation/air_success_last"]];
const TASK_RATES = [["Last step", "evaluation/success_last"], ["Any step", "evaluation/success_ever"]];

/** Every name in the registry, each with its versions. */
export function primitivesView(root, signal) {
  const list = el("div", {});
  const shown = new Map();
  root.replaceChildren(el("h1", {}, "Primitives"), el("p", { class: "summary" }, "Frozen policies: those that runs have published here, and those that come with tandem. Newest first."), list);
  return every(EVERY_MS, signal, async () => {
    let found;
    try {
      found = await Promise.all([get(["v1", "primitives"], [], signal), publishers(signal)]);
    } catch (error) {
      if (!(error instanceof ApiError) || error.status === 0) throw error;
      return list.replaceChildren(note(sentence(error.message)));
    }
    const [{ primitives }, runs] = found;
    const parts = [];
    for (const { name } of primitives) {
      if (!shown.has(name)) shown.set(name, new Versions(name, name));
      parts.push(shown.get(name));
    }
    await Promise.all(parts.map((part) => part.refresh(signal, runs)));
    const users = usersOf(parts);
    parts.forEach((part) => part.show(runs, users));
    const nodes = parts.map((part) => part.root);
    if (nodes.length !== list.children.length || nodes.some((node, i) => node !== list.children[i])) list.replaceChildren(...nodes);
  });
}

/** The versions of one name, in a section of its own. */
export class Versions {
  constructor(name, title) {
    Object.assign(this, { name, ...section(title) });
    this.summary = el("p", { class: "summary" });
    this.table = null;
  }

  /** Show what was found; ``runs`` and ``users`` as of ``publishers`` and ``usersOf``. */
  show(runs, users) {
    if (!this.found) return;
    const kind = this.found.versions[0]?.kind ?? "primitives"; // all versions of a name are of one kind
    if (this.table?.kind !== kind) this.table = new VersionTable(this.name, kind);
    this.table.update(this.found, runs, users);
    if (!this.body.contains(this.table.root)) this.body.replaceChildren(this.summary, this.table.root);
  }

  /** Ask for the versions, and show them where ``runs``, as of ``publishers``, is null. */
  async refresh(signal, runs = null) {
    try {
      const found = await get(["v1", "primitives", this.name], [], signal);
      this.found = found;
      const more = found.num_versions > found.versions.length ? `, the newest ${found.versions.length} here` : "";
      setText(this.summary, `${counted(found.num_versions, "version")}${more}. In Python: tandem_skills.load("${this.name}@latest").`);
      if (!runs) this.show(await publishers(signal), new Map());
    } catch (error) {
      if (!(error instanceof ApiError) || error.status === 0) throw error;
      const text = error.status === 404 ? `The registry of this service has no version of ${this.name}.` : sentence(error.message);
      this.body.replaceChildren(note(text));
    }
  }
}

/** By NAME@VERSION, the run that published it, and the downstream trainings that compose it. */
async function publishers(signal) {
  const { runs } = await get(["v1", "runs"], [["limit", 1000]], signal).catch(() => ({ runs: [] }));
  const trainings = new Map();
  for (const { run_id: id, trial } of runs) {
    if (trial?.primitives) trainings.set(trial.primitives, [...(trainings.get(trial.primitives) ?? []), id]);
  }
  return { by: new Map(runs.filter((run) => run.published).map((run) => [run.published, run.run_id])), trainings };
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

/** The table of the versions of a name, from PrimitiveVersions. */
class VersionTable {
  constructor(name, kind) {
    this.kind = kind;
    const task = { label: "Task", short: true, text: (version) => version.task ?? "\u2013" };
    const rates = (kind === "orchestrator" ? TASK_RATES : RATES).map(([label, metric]) => ({ label, number: true, text: ({ metrics }) => percent(metrics[metric]) }));
    const columns = [
      { label: "Version", changed: (version) => [version.version, version.problem], node: (version) => reference(name, version) },
      { label: "Aliases", changed: (version) => version.aliases, node: aliases },
      ...(kind === "orchestrator" ? [task] : []),
      ...rates,
      { label: "Where", changed: (version) => [version.origin, version.directory], node: where },
      { label: "Published", changed: (version) => version.created, node: created },
      { label: "Lineage", changed: (version) => version.lineage, node: lineage },
      { label: "Commit", short: true, text: (version) => version.git_commit?.slice(0, 8) ?? "\u2013" },
      { label: "Size", text: (version) => bytes(version.blob_bytes), number: true },
      { label: "Download", changed: (version) => version.blob_sha256, node: (version) => downloads(name, version) },
    ];
    this.table = new Table(`Versions of ${name}`, columns, (version) => version.version);
    this.root = el("div", { class: "scroll" }, this.table.root);
  }

  /** ``runs`` and ``users`` as of ``publishers`` and ``usersOf``. */
  update(primitive, runs, users) {
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

/** What is known of where a version comes from and what was made with it: [text, ids of runs] each. */
function lineageOf(reference, version, runs, users) {
  const run = version.origin === "registry" ? runs.by.get(reference) : null;
  const trainings = runs.trainings.get(reference);
  return [
    ...(version.kind === "primitives" ? [] : [[version.kind]]),
    ...(run ? [["made by run ", run]] : []),
    ...(version.parent ? [[`trained on from ${version.parent}`]] : []),
    ...(version.primitives ? [[`composes ${version.primitives}`]] : []),
    ...(users.get(reference) ?? []).map((user) => [`used by ${user}`]),
    ...(trainings ? [["composed by ", ...trainings]] : []),
  ];
}

function lineage(version) {
  if (!version.lineage.length) return document.createTextNode("\u2013");
  return el("span", { class: "lines" }, ...version.lineage.map(([text, ...ids]) => el("small", {}, text, ids.length ? runsLink(ids, counted(ids.length, "downstream run")) : null)));
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
