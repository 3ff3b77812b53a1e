// The service's API: reading only. Addresses are relative to the page, so that it also works behind a proxy's prefix.

import { answered, silent, troubled } from "./health.js";

const ROOT = new URL("../", import.meta.url);
const TIMEOUT_MS = 10_000;
const AWAY = new Set([502, 503, 504]);
let serverAheadMs = 0;

/** An answer that is a problem, or none at all (status 0). */
export class ApiError extends Error {
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

/** The address of a path below the service's root. */
export function address(...parts) {
  return new URL(parts.map(encodeURIComponent).join("/"), ROOT).href;
}

/** What the service says of a path; ``query`` is a list of pairs. */
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
  const detail = problem.detail ?? `the service answers ${response.status} ${response.statusText}`;
  if (response.status === 401) troubled(about, `${sentence(detail)} Reload the page to be asked for it.`);
  else if (AWAY.has(response.status)) troubled(about, sentence(detail));
  else answered(about);
  throw new ApiError(response.status, detail);
}

/** Now, by the service's clock: ages are right where this machine's clock is wrong. */
export function now() {
  return Date.now() + serverAheadMs;
}

/** A detail as a sentence. */
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
  // the header has whole seconds: a smaller difference says nothing
  if (Number.isFinite(there)) serverAheadMs = Math.abs(there - Date.now()) > 2000 ? there - Date.now() : 0;
}
