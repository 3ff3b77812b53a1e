// Show the view of the address: #/ has all runs, #/runs/ID one run, #/primitives the registry.

import { el, note } from "./dom.js";
import { primitivesView } from "./primitives.js";
import { runView } from "./run.js";
import { runsView } from "./runs.js";
import { startAges } from "./widgets.js";

const main = document.getElementById("main");
let left = new AbortController();

function show() {
  left.abort();
  left = new AbortController();
  const parts = location.hash.replace(/^#\/?/, "").split("/").map(decoded);
  const [page, id] = parts;
  document.title = page === "runs" && id ? `${id} \u00b7 Tandem` : "Tandem";
  markCurrent(page);
  if (page === "runs" && id && parts.length === 2) runView(main, id, left.signal);
  else if (page === "primitives" && parts.length === 1) primitivesView(main, left.signal);
  else if (page === "" || (page === "runs" && !id)) runsView(main, left.signal);
  else main.replaceChildren(el("h1", {}, "Nothing here"), note("There is no page at this address. ", el("a", { href: "#/" }, "All runs")));
}

function markCurrent(page) {
  const current = page === "primitives" ? "#/primitives" : "#/";
  for (const link of document.querySelectorAll(".top nav a")) {
    if (link.getAttribute("href") === current) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

document.querySelector("a.skip").addEventListener("click", (event) => {
  event.preventDefault(); // a change of the address would change the view
  main.focus();
});
addEventListener("hashchange", () => {
  scrollTo(0, 0);
  show();
});
startAges();
show();
