// Follow a run: its state, and word of every new iteration. After any failure it starts again.

import { address, answered, connection, get, troubled } from "./api.js";

const ACTIVE = new Set(["starting", "running"]);
const AGAIN_MS = 1000;
const RETRY_MS = 2000;
const ENDED_MS = 5000;

/** Whether a run is in progress. */
export function isActive(run) {
  return ACTIVE.has(run.state);
}

/** Follow a run until the view is left. ``listener`` has status(run), curves() and failed(error). */
export async function follow(runId, listener, signal) {
  while (!signal.aborted) {
    await visible(signal);
    await sleep(await once(runId, listener, signal), signal);
  }
}

/** Make one attempt; returns the milliseconds until the next. */
async function once(runId, listener, signal) {
  try {
    const run = await get(["v1", "runs", runId], [], signal);
    listener.status(run);
    listener.curves();
    await (isActive(run) ? listen(run, listener, signal) : untilResumed(run, listener, signal));
    return AGAIN_MS;
  } catch (error) {
    if (signal.aborted) return 0;
    listener.failed(error);
    return RETRY_MS;
  }
}

/** Resolve when a run that has ended was resumed or replaced. */
async function untilResumed(run, listener, signal) {
  while (!signal.aborted) {
    await sleep(ENDED_MS, signal);
    await visible(signal);
    const found = await get(["v1", "runs", run.run_id], [], signal);
    listener.status(found);
    if (["started", "state", "iteration"].some((field) => found[field] !== run[field])) return;
  }
}

/** Resolve when the stream has ended, for any reason; the run is then looked at again. */
function listen(run, listener, signal) {
  const query = new URLSearchParams([["names", "iteration"], ["after_iteration", run.iteration]]);
  const source = new EventSource(`${address("v1", "runs", run.run_id, "metrics", "stream")}?${query}`);
  return new Promise((resolve) => {
    const stopped = new AbortController();
    const done = () => {
      source.close();
      stopped.abort();
      resolve();
    };
    const on = (kind, handler) => source.addEventListener(kind, (event) => handler(JSON.parse(event.data)));
    on("metrics", () => {
      listener.curves();
      answered("v1/runs");
    });
    on("status", (found) => {
      listener.status(found);
      answered("v1/runs");
    });
    on("unavailable", ({ detail }) => troubled("v1/runs", `The runs cannot be read: ${detail}.`));
    on("reset", done);
    on("end", done);
    source.addEventListener("error", done); // browsers do not reconnect after every error
    document.addEventListener("visibilitychange", () => document.hidden && done(), { signal: stopped.signal });
    connection.addEventListener("recovered", done, { signal: stopped.signal }); // the stream may be dead without an error
    signal.addEventListener("abort", done, { signal: stopped.signal });
    if (signal.aborted) done();
  });
}

/** Resolve after some time, or when the view is left. */
export function sleep(milliseconds, signal) {
  return new Promise((resolve) => {
    if (signal.aborted) return resolve();
    const timer = setTimeout(done, milliseconds);
    signal.addEventListener("abort", done, { once: true });
    function done() {
      clearTimeout(timer);
      signal.removeEventListener("abort", done);
      resolve();
    }
  });
}

/** Resolve when the page is visible: a tab in the background makes no requests. */
export async function visible(signal) {
  while (document.hidden && !signal.aborted) {
    await new Promise((resolve) => {
      const options = { once: true };
      document.addEventListener("visibilitychange", resolve, options);
      signal.addEventListener("abort", resolve, options);
    });
  }
}

/** Call an async function repeatedly until the view is left; its errors are logged. */
export async function every(milliseconds, signal, task) {
  while (!signal.aborted) {
    await visible(signal);
    if (signal.aborted) return;
    try {
      await task();
    } catch (error) {
      if (!signal.aborted) console.warn(error);
    }
    await sleep(milliseconds, signal);
  }
}
