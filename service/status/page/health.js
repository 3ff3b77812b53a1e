// Whether the service answers, told by the banner on top of the page. It goes by itself when all is well again.

import { setText } from "./dom.js";

/** Fires "recovered" when the service answers again. */
export const connection = new EventTarget();
const troubles = new Map();
let answeredAt = new Date();

/** An answer came; ``about`` names the part of the API it came from. */
export function answered(about) {
  answeredAt = new Date();
  if (troubles.delete("network")) connection.dispatchEvent(new Event("recovered"));
  troubles.delete(about);
  show();
}

/** No answer came. */
export function silent() {
  troubles.set("network", `No answer from the service since ${answeredAt.toLocaleTimeString()}, trying again \u2026`);
  show();
}

/** The service answers that it cannot. */
export function troubled(about, message) {
  troubles.set(about, `${message} Trying again \u2026`);
  show();
}

function show() {
  const banner = document.getElementById("banner");
  const text = troubles.get("network") ?? [...troubles.values()].join(" ");
  setText(banner, text);
  banner.hidden = !text;
}
