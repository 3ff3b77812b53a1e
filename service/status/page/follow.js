// A run as it goes on: its history first, then what is new. When anything breaks, it begins again from the history.

import { address, get } from "./api.js";
import { answered, connection, troubled } from "./health.js";
import { sleep, visible } from "./times.js";

const ACTIVE = new Set(["starting", "running"]);
const MAX_POINTS = 600;
const MAX_RECORDS = 600;
const AGAIN_MS = 1000;
const RETRY_MS = 2000;
const ENDED_MS = 5000;

/** Whether a run goes on. */
export function isActive(run) {
  return ACTIVE.has(run.state);
}

/**
 * Follow a run until the view is left. ``listener`` has status(run), history(history), record(record) and
 * failed(error).
 */
export async function follow(runId, names, listener, signal) {
  while (!signal.aborted) {
    await visible(signal);
    await sleep(await once(runId, names, listener, signal), signal);
  }
}

/** One try; returns after how long to try again. */
async function once(runId, names, listener, signal) {
  try {
    const run = await get(["v1", "runs", runId], [], signal);
    listener.status(run);
    const query = [...names.map((name) => ["names", name]), ["max_points", MAX_POINTS]];
    const history = await get(["v1", "runs", runId, "metrics"], query, signal);
    listener.history(history);
    await (isActive(run) ? listen(runId, names, history, listener, signal) : untilResumed(run, listener, signal));
    return AGAIN_MS;
  } catch (error) {
    if (signal.aborted) return 0;
    listener.failed(error);
    return RETRY_MS;
  }
}

/** Resolve when a run that has ended is another one: it was resumed, or made anew. */
async function untilResumed(run, listener, signal) {
  while (!signal.aborted) {
    await sleep(ENDED_MS, signal);
    await visible(signal);
    const found = await get(["v1", "runs", run.run_id], [], signal);
    listener.status(found);
    if (["started", "state", "iteration"].some((field) => found[field] !== run[field])) return;
  }
}

/** Resolve when the stream has ended, for whatever reason; the history is asked for again then. */
function listen(runId, names, history, listener, signal) {
  const query = new URLSearchParams([...names.map((name) => ["names", name]), ["after_iteration", history.last_iteration]]);
  const source = new EventSource(`${address("v1", "runs", runId, "metrics", "stream")}?${query}`);
  let numRecords = 0;
  return new Promise((resolve) => {
    const stopped = new AbortController();
    const done = () => {
      source.close();
      stopped.abort();
      resolve();
    };
    const on = (kind, handler) => source.addEventListener(kind, (event) => handler(JSON.parse(event.data)));
    on("metrics", (record) => {
      listener.record(record);
      answered("v1/runs");
      if (++numRecords > MAX_RECORDS) done(); // the history has them in fewer points
    });
    on("status", (run) => {
      listener.status(run);
      answered("v1/runs");
    });
    on("unavailable", ({ detail }) => troubled("v1/runs", `The runs cannot be read: ${detail}.`));
    on("reset", done);
    on("end", done);
    source.addEventListener("error", done); // not left to the browser, which gives up on some errors
    document.addEventListener("visibilitychange", () => document.hidden && done(), { signal: stopped.signal });
    connection.addEventListener("recovered", done, { signal: stopped.signal }); // it may have died without a word
    signal.addEventListener("abort", done, { signal: stopped.signal });
    if (signal.aborted) done();
  });
}
