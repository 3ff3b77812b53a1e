// A table that keeps its rows while their cells change: focus, selection and scrolling stay. Narrow screens see cards.

import { el, setText } from "./dom.js";

/**
 * A column is {label, text(row)}, or {label, node(row), changed(row)}: the node is made anew where ``changed`` differs.
 * ``number: true`` sets it to the right.
 */
export class Table {
  constructor(label, columns, key) {
    this.columns = columns;
    this.key = key;
    this.rows = new Map();
    this.body = el("tbody", { role: "rowgroup" });
    const head = columns.map((column) => el("th", { scope: "col", role: "columnheader", class: kind(column) }, column.label));
    // roles, for a table that is shown as cards is none any more for a screen reader
    this.root = el(
      "table",
      { role: "table", "aria-label": label },
      el("thead", { role: "rowgroup" }, el("tr", { role: "row" }, ...head)),
      this.body,
    );
  }

  /** Show these rows, in this order. */
  update(items) {
    const rows = items.map((item) => this.row(item));
    const { children } = this.body;
    // a row that moves loses the focus within it, so only those move that have to
    rows.forEach((row, i) => row === children[i] || this.body.insertBefore(row, children[i] ?? null));
    while (children.length > rows.length) this.body.lastChild.remove();
    const known = new Set(items.map((item) => this.key(item)));
    for (const key of this.rows.keys()) if (!known.has(key)) this.rows.delete(key);
  }

  row(item) {
    const key = this.key(item);
    const row = this.rows.get(key) ?? el("tr", { role: "row" }, ...this.columns.map(cell));
    this.rows.set(key, row);
    this.columns.forEach((column, index) => fillCell(row.children[index], column, item));
    return row;
  }
}

function kind(column) {
  return column.number ? "number" : null;
}

function cell(column) {
  return el("td", { role: "cell", class: kind(column), "data-label": column.label });
}

function fillCell(element, column, item) {
  if (column.text) return setText(element, column.text(item));
  const changed = String(column.changed(item));
  if (element.dataset.changed === changed) return undefined;
  element.dataset.changed = changed;
  return element.replaceChildren(column.node(item));
}
