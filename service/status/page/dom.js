// Elements made by code. Text always becomes a text node, so that no name or message is read as markup.

const SVG = "http://www.w3.org/2000/svg";
let sections = 0;

/** An element with attributes (null and false omit one) and children: nodes or text. */
export function el(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** An SVG element with attributes and children. */
export function svg(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== false && value !== undefined) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Set text only if it changed, so that a selection stays. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A part of a page: a heading and an empty body. */
export function section(title, className = "") {
  const id = `section-${++sections}`;
  const body = el("div", { class: "body" });
  const root = el("section", { class: `card ${className}`, "aria-labelledby": id }, el("h2", { id }, title), body);
  return { root, body };
}

/** A note in place of missing content. */
export function note(...content) {
  return el("p", { class: "note" }, ...content);
}

/** Record when something was shown; the last time counts. */
export function mark(name) {
  performance.clearMarks(name);
  performance.mark(name);
}

/** A link to a run. */
export function runLink(runId, text = runId) {
  return el("a", { href: `#/runs/${encodeURIComponent(runId)}` }, text);
}

/** A link to the comparison of several runs, or to the one that there is, with its id as text. */
export function runsLink(ids, text, single = ids[0]) {
  if (ids.length === 1) return runLink(ids[0], single);
  return el("a", { href: `#/compare/${ids.map(encodeURIComponent).join(",")}` }, text);
}
