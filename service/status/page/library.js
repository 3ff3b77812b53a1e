// The library that draws curves and the map in three dimensions: plotly, which the service serves from its Python package.

import { el } from "./dom.js";

let loading = null;

/** Load the library once; it takes half a second, so views that need it call this first. */
export function library() {
  loading ??= new Promise((resolve, reject) => {
    const script = el("script", { src: new URL("plotly.js", import.meta.url).href });
    script.addEventListener("load", () => resolve(window.Plotly));
    script.addEventListener("error", () => {
      loading = null;
      script.remove();
      reject(new Error("Curves need the Python package plotly where the service runs: pip install 'tandem-skills[serve]'."));
    });
    document.head.append(script);
  });
  return loading;
}

/** The colours of the page, light or dark, for what the library draws. */
export function theme() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  return { ink: colour("ink"), soft: colour("soft"), line: colour("line"), card: colour("card"), curve: (i) => colour(`c${i % NUM_COLOURS}`) };
}

/** How many colours of curves style.css has. */
export const NUM_COLOURS = 10;

/** Call a function when the page turns light or dark. */
export function onTheme(changed, signal) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed, { signal });
}
