// The commands for a run, ready to copy: the page itself changes nothing.

import { address } from "./api.js";
import { el, note } from "./dom.js";
import { isActive } from "./follow.js";

export class Commands {
  constructor() {
    this.root = el("div", { class: "commands" });
  }

  update(run, setup) {
    const key = JSON.stringify([isActive(run), setup]);
    if (key === this.shown) return;
    this.shown = key;
    const parts = isActive(run) ? this.stop(run, setup) : this.resume(run, setup);
    const where = setup.directory ? [note("Its directory is ", el("code", {}, setup.directory), ".")] : [];
    this.root.replaceChildren(...parts, ...where);
  }

  stop(run, setup) {
    const url = address("v1", "runs", run.run_id, "stop");
    const remote = `curl -X POST -H "Authorization: Bearer $TANDEM_TOKEN" ${url}`;
    return [
      ...(setup.stop_command ? [command("Stop it after this iteration, saved, on its machine", setup.stop_command)] : []),
      command("The same from anywhere, if this service has a token", remote),
    ];
  }

  resume(run, setup) {
    if (!setup.directory) return [note("Its directory is on another machine; go on with it there.")];
    const goOn = command("Go on with it, from its last checkpoint", setup.resume_command);
    return [goOn, ...setup.commands.map((each) => command(each.what, each.command))];
  }
}

/** A command with a button that copies it. */
export function command(what, text) {
  const button = el("button", { type: "button", "aria-label": `Copy: ${what}` }, "Copy");
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(text);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(button.previousSibling); // without https, a browser lets nobody copy
      button.textContent = "Selected";
    }
    setTimeout(() => (button.textContent = "Copy"), 2000);
  });
  return el("p", { class: "command" }, el("span", { class: "hint" }, what), el("code", {}, text), button);
}
