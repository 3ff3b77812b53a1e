// Reading the service's API, and the banner that says when the service does not answer. URLs are relative to the page,
// so that it also works behind a proxy's prefix.

import { setText } from "./dom.js";

const ROOT = new URL("../", import.meta.url);
const TIMEOUT_MS = 20_000;
const AWAY = new Set([502, 503, 504]);
let serverAheadMs = 0;
const troubles = new Map();
let answeredAt = new Date();

/** A problem as answer, or no answer (status 0). */
export class ApiError extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

/** The URL of a path below the service's root. */
export function address(...parts) {
  return new URL(parts.map(encodeURIComponent).join("/"), ROOT).href;
}

/** GET a path; ``query`` is a list of pairs. */
export async function get(parts, query = [], signal = undefined) {
  const url = `${address(...parts)}${query.length ? `?${new URLSearchParams(query)}` : ""}`;
  const response = await ask(url, signal);
  const about = parts.slice(0, 2).join("/");
  noteClock(response);
  if (response.ok) {
    const answer = await body(response, signal);
    answered(about);
    return answer;
  }
  const problem = await response.json().catch(() => ({}));
  signal?.throwIfAborted(); // nobody would ask again for a view that was left
  const detail = problem.detail ?? `the service answers ${response.status} ${response.statusText}`;
  if (response.status === 401) connection.dispatchEvent(new Event("locked"));
  else if (AWAY.has(response.status)) troubled(about, sentence(detail));
  else answered(about);
  throw new ApiError(response.status, detail);
}

/** The time by the service's clock, so that ages are right even if this machine's clock is wrong. */
export function now() {
  return Date.now() + serverAheadMs;
}

/** Make a problem's detail a sentence. */
export function sentence(detail) {
  const text = detail.trim();
  return `${text.charAt(0).toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? "" : "."}`;
}

async function ask(url, signal) {
  try {
    return await fetch(url, { signal: limited(signal), headers: { Accept: "application/json" } });
  } catch (error) {
    throw unanswered(error, signal);
  }
}

async function body(response, signal) {
  try {
    return await response.json();
  } catch (error) {
    throw unanswered(error, signal);
  }
}

function unanswered(error, signal) {
  if (signal?.aborted) return error;
  silent();
  return new ApiError(0, "no answer from the service");
}

function limited(signal) {
  const limit = AbortSignal.timeout(TIMEOUT_MS);
  return signal ? AbortSignal.any([signal, limit]) : limit;
}

function noteClock(response) {
  const there = Date.parse(response.headers.get("date") ?? "");
  // the header has whole seconds: a smaller difference means nothing
  if (Number.isFinite(there)) serverAheadMs = Math.abs(there - Date.now()) > 2000 ? there - Date.now() : 0;
}

/** Fires "recovered" when the service answers again, "locked" when it wants its token, "entered" when it has it. */
export const connection = new EventTarget();

/** Record an answer; ``about`` names the part of the API it came from. */
export function answered(about) {
  answeredAt = new Date();
  if (troubles.delete("network")) connection.dispatchEvent(new Event("recovered"));
  troubles.delete(about);
  show();
}

/** Record that there was no answer. */
function silent() {
  troubles.set("network", `No answer from the service since ${answeredAt.toLocaleTimeString()}, trying again \u2026 Is it still running at ${ROOT.host}? It is started with: tandem serve`);
  show();
}

/** Record an answer that says why the service cannot read something. */
export function troubled(about, message) {
  troubles.set(about, `${message} Trying again \u2026`);
  show();
}

/** Forget what a view that is left could not read: nobody asks for it again. */
export function leave() {
  for (const about of [...troubles.keys()]) if (about !== "network") troubles.delete(about);
  show();
}

function show() {
  const banner = document.getElementById("banner");
  const text = troubles.get("network") ?? [...troubles.values()].join(" ");
  setText(banner, text);
  banner.hidden = !text;
}
