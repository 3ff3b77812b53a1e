// The versions of a name in the registry.

import { address } from "./api.js";
import { el } from "./dom.js";
import { bytes, percent } from "./format.js";
import { Table } from "./table.js";
import { age } from "./times.js";

const RATES = [["Mixed", "evaluation/mixed_success_last"], ["Table", "evaluation/table_success_last"], ["Air", "evaluation/air_success_last"]];

/** Of PrimitiveVersions. */
export class VersionTable {
  constructor(name) {
    const rates = RATES.map(([label, metric]) => ({ label, number: true, text: ({ metrics }) => percent(metrics[metric]) }));
    const columns = [
      { label: "Version", changed: (version) => [version.version, version.problem], node: (version) => reference(name, version) },
      { label: "Aliases", changed: (version) => version.aliases, node: aliases },
      ...rates,
      { label: "Published", changed: (version) => version.created, node: created },
      { label: "Commit", text: (version) => version.git_commit?.slice(0, 8) ?? "\u2013" },
      { label: "Trained on from", text: (version) => version.parent ?? "\u2013" },
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
