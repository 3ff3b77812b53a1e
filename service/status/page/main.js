// Show the view of the address: #/ has all runs, #/runs/ID one run, #/compare/ID,ID several, #/tasks the table of
// downstream tasks, #/primitives the registry.

import { connection, get, leave } from "./api.js";
import { el, note } from "./dom.js";
import { every } from "./follow.js";
import { library } from "./library.js";
import { loginView } from "./login.js";
import { runsView } from "./runs.js";
import { startAges } from "./widgets.js";

const AGAIN_MS = 2000;
const main = document.getElementById("main");
let left = new AbortController();

function show() {
  left.abort();
  leave();
  left = new AbortController();
  const parts = location.hash.replace(/^#\/?/, "").split("/").map(decoded);
  const [page, id] = parts;
  document.title = page === "runs" && id ? `${id} \u00b7 Tandem` : "Tandem";
  markCurrent(page);
  const { signal } = left;
  if (page === "runs" && id && parts.length === 2) load("./run.js", ({ runView }) => runView(main, id, signal), true);
  else if (page === "compare" && id && parts.length === 2) load("./compare.js", ({ compareView }) => compareView(main, ids(id), signal), true);
  else if (page === "primitives" && parts.length === 1) load("./primitives.js", ({ primitivesView }) => primitivesView(main, signal));
  else if (page === "tasks" && parts.length === 1) load("./tasks.js", ({ tasksView }) => tasksView(main, signal));
  else if (page === "" || (page === "runs" && !id)) runsView(main, left.signal);
  else main.replaceChildren(el("h1", {}, "Nothing here"), note("There is no page at this address. ", el("a", { href: "#/" }, "All runs")));
}

/** Load a view's modules, and the library of curves beside them if it has any, and show it. */
async function load(module, view, curves = false) {
  const { signal } = left;
  if (curves) library().catch(() => undefined); // the view says so
  main.replaceChildren(note("Loading \u2026"));
  try {
    const loaded = await import(module);
    if (!signal.aborted) await view(loaded);
  } catch (error) {
    if (signal.aborted) return;
    console.warn(error);
    main.replaceChildren(note("This view could not be loaded. It is loaded again as soon as the service answers."));
    await every(AGAIN_MS, signal, async () => {
      await get(["livez"], [], signal);
      location.reload(); // a browser may not ask twice for a module that did not come
    });
  }
}

/** The ids in an address: "a,b" without those that come again. */
function ids(text) {
  return [...new Set(text.split(",").filter(Boolean))];
}

function markCurrent(page) {
  const current = ["primitives", "tasks"].includes(page) ? `#/${page}` : "#/";
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
connection.addEventListener("locked", () => {
  if (document.querySelector("form.login")) return;
  left.abort();
  document.title = "Tandem";
  loginView(main, show);
});
startAges();
show();
