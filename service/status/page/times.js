// Waiting, asking again and again, and ages that grow while one looks at them.

import { now } from "./api.js";
import { el, setText } from "./dom.js";
import { duration } from "./format.js";

/** Resolve after a while, or when the view is left. */
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

/** Resolve when the page can be seen: a tab in the background asks for nothing. */
export async function visible(signal) {
  while (document.hidden && !signal.aborted) {
    await new Promise((resolve) => {
      const options = { once: true };
      document.addEventListener("visibilitychange", resolve, options);
      signal.addEventListener("abort", resolve, options);
    });
  }
}

/** Call an async function again and again until the view is left; its errors are its own business. */
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

/** "3 min ago"; counts on by itself. */
export function age(timestamp) {
  const element = el("time", { datetime: timestamp, "data-age": true, title: new Date(timestamp).toLocaleString() });
  tell(element);
  return element;
}

/** Seconds since then, by the service's clock. */
export function secondsSince(timestamp) {
  return Math.max(0, (now() - Date.parse(timestamp)) / 1000);
}

/** Make all ages grow. */
export function startAges() {
  setInterval(() => document.querySelectorAll("time[data-age]").forEach(tell), 1000);
}

function tell(element) {
  setText(element, `${duration(secondsSince(element.dateTime))} ago`);
}
