// The form that asks for the service's token, where one is needed to read.

import { address, connection, sentence } from "./api.js";
import { el, note, setText } from "./dom.js";

/** Show the form in place of the page; ``entered`` is called once the service has taken the token. */
export function loginView(root, entered) {
  const input = el("input", { type: "password", name: "token", id: "token", autocomplete: "current-password", required: true, size: 40 });
  const said = el("p", { class: "problem", role: "alert" });
  const form = el("form", { class: "card login" }, el("h1", {}, "This service needs its token"),
    note("It is the one that the service was started with, in ", el("code", {}, "TANDEM_TOKEN"), " or in the file of ", el("code", {}, "--token-file"), ". Whoever started it knows it."),
    el("label", { for: "token" }, "Token"), input, el("button", { type: "submit" }, "Log in"), said,
    note("This browser then reads for a week. To stop a run or to move an alias, programs send the token itself."));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    setText(said, "");
    const problem = await enter(input.value);
    if (problem === null) {
      connection.dispatchEvent(new Event("entered"));
      return entered();
    }
    setText(said, problem);
    input.select();
    return undefined;
  });
  root.replaceChildren(form);
  input.focus();
}

/** Give the token to the service: null, or why it was not taken. */
async function enter(token) {
  try {
    const headers = { "Content-Type": "application/json" };
    const response = await fetch(address("v1", "session"), { method: "POST", headers, body: JSON.stringify({ token }) });
    if (response.ok) return null;
    return sentence((await response.json().catch(() => ({}))).detail ?? `the service answers ${response.status}`);
  } catch {
    return "No answer from the service: is it still running?";
  }
}
