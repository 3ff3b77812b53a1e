// One panel of curves: of several metrics of one run, or of one metric of several runs. What it draws is the board's data.

import { el, setText } from "./dom.js";
import { count } from "./format.js";
import { library, theme } from "./library.js";
import { isFraction, written } from "./metrics.js";
import { band, extremes, nearest, smoothed } from "./smoothing.js";

const MARGIN = { l: 48, r: 12, t: 8, b: 24 };
const HEIGHT = 200;
const SPARSE = 0.5;
const MAX_LISTED = 12;

export class Panel {
  /** ``spec`` has title, hint and curves: [name, label] each. */
  constructor(spec, board) {
    Object.assign(this, { spec, board, drawn: [] });
    this.names = spec.curves.map(([name]) => name);
    this.where = el("span", { class: "where" });
    this.legend = el("ul", { class: "legend" });
    this.rule = el("div", { class: "rule", hidden: true });
    this.canvas = el("div", { class: "canvas" });
    this.empty = el("p", { class: "nothing" }, "Asking \u2026");
    const slider = { class: "plot", tabindex: 0, role: "slider", "aria-label": spec.title, "aria-valuemin": 0 };
    this.plot = el("div", slider, this.canvas, this.rule, this.empty);
    const picture = el("button", { type: "button", "aria-label": `Picture of ${spec.title}` }, "PNG");
    picture.addEventListener("click", () => this.save());
    const label = `All values of ${spec.title}, as CSV`;
    const url = board.tableUrl(this.names);
    const table = url && el("a", { href: url, download: "metrics.csv", "aria-label": label }, "CSV");
    const head = el("figcaption", {}, el("h3", {}, spec.title), this.where, el("span", { class: "tools" }, picture, table));
    this.root = el("figure", { class: "chart" }, head, el("span", { class: "hint" }, spec.hint), this.plot, this.legend);
    this.listen();
  }

  listen() {
    const look = (event) => this.board.point(this.placeAt(event));
    this.plot.addEventListener("pointermove", look);
    this.plot.addEventListener("pointerdown", look);
    this.plot.addEventListener("pointerleave", () => this.board.point(null));
    this.plot.addEventListener("blur", () => this.board.point(null));
    this.plot.addEventListener("keydown", (event) => this.key(event));
  }

  /** Arrow keys move the cursor from point to point of the first curve. */
  key(event) {
    const x = this.drawn[0]?.x ?? [];
    const last = x.length - 1;
    const from = this.board.cursor === null ? last : nearest(x, this.board.cursor);
    const far = event.shiftKey ? 10 : 1;
    const to = { ArrowLeft: from - far, ArrowRight: from + far, Home: 0, End: last, Escape: null }[event.key];
    if (to === undefined || last < 0) return;
    event.preventDefault();
    this.board.point(to === null ? null : x[Math.min(last, Math.max(0, to))]);
  }

  placeAt(event) {
    const axis = this.canvas._fullLayout?.xaxis;
    if (!axis) return null;
    const pixels = event.clientX - this.canvas.getBoundingClientRect().left - MARGIN.l;
    return axis.p2d(Math.min(axis._length, Math.max(0, pixels)));
  }

  /** The curves of this panel as the board has them: {label, colour, name, x, y, mean, ...}. */
  curves() {
    const { board } = this;
    const single = board.runs.length === 1;
    const found = [];
    board.runs.forEach((run, r) => {
      const data = board.data.get(run.id);
      this.spec.curves.forEach(([name, label], c) => {
        const curve = data?.curves[name];
        if (!curve || curve.mean.every((value) => value === null)) return;
        const values = { ...curve, x: data.x, perPoint: data.num_iterations / Math.max(1, data.x.length) };
        const shown = run.hidden ? "hidden" : null;
        if (!shown) found.push({ ...values, name, run, label: single ? label : run.label, colour: single ? c : r });
      });
    });
    return found;
  }

  /** Draw everything anew. */
  async draw() {
    const Plotly = await library();
    if (!this.root.isConnected) return;
    const colours = theme();
    const curves = this.curves();
    this.drawn = [];
    const banded = this.board.banded ? this.bands(curves, colours) : null;
    const traces = (banded ?? curves.map((curve) => this.traces(curve, colours))).flat();
    const settings = { displayModeBar: false, responsive: true, showTips: false, doubleClick: false };
    await Plotly.react(this.canvas, traces, this.layout(colours), settings);
    if (!this.zoomed) this.zoomed = this.canvas.on("plotly_relayout", (change) => this.zoom(change)) ?? true;
    if (!this.clicked) this.clicked = this.canvas.on("plotly_doubleclick", () => this.board.zoom(null)) ?? true;
    this.empty.hidden = traces.length > 0;
    setText(this.empty, "no values yet");
    this.canvas.dataset.curves = this.drawn.length;
    this.point(this.board.cursor);
  }

  zoom(change) {
    const range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    if (range.every(Number.isFinite)) this.board.zoom(range);
  }

  layout(colours) {
    const { board } = this;
    const axis = { gridcolor: colours.line, zerolinecolor: colours.line, linecolor: colours.soft, tickfont: { size: 11 }, automargin: false };
    const fraction = this.names.every(isFraction);
    const y = { ...axis, fixedrange: true, type: board.log ? "log" : "linear", tickformat: fraction && !board.log ? ".0%" : "~g", exponentformat: "SI", nticks: 6 };
    if (fraction && !board.log) Object.assign(y, { range: [0, 1.02] });
    else if (!board.log) y.rangemode = "tozero";
    const x = { ...axis, showline: true, zeroline: false, nticks: 6, tickformat: board.axis === "wall_s" ? "~g" : "~s", range: board.shownRange() };
    const dragmode = matchMedia("(pointer: coarse)").matches ? false : "zoom";
    return {
      margin: MARGIN, height: HEIGHT, autosize: true, showlegend: false, hovermode: false, dragmode, xaxis: x, yaxis: y,
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colours.soft, family: "inherit" },
    };
  }

  traces(curve, colours) {
    const { board } = this;
    const colour = colours.curve(curve.colour);
    const x = board.scaled(curve.x);
    const known = curve.mean.map((value, i) => (value === null ? -1 : i)).filter((i) => i >= 0);
    const common = { type: "scatter", hoverinfo: "skip", name: `${curve.run.id} ${curve.name}` };
    if (known.length < SPARSE * curve.mean.length) {
      const points = { x: known.map((i) => x[i]), y: known.map((i) => curve.mean[i]) };
      this.drawn.push({ ...curve, ...points });
      return [{ ...common, ...points, mode: "lines+markers", line: { color: colour, width: 2 }, marker: { color: colour, size: 5 } }];
    }
    const smooth = smoothed(curve.mean, board.span, curve.perPoint);
    this.drawn.push({ ...curve, x, y: curve.mean, smooth });
    const raw = curve.low ? extremes(x, curve.low, curve.high) : { x, y: curve.mean };
    const alone = board.span <= 1;
    const thin = { ...common, ...raw, mode: "lines", opacity: alone ? 0.9 : 0.28, line: { color: colour, width: alone ? 1.4 : 1 } };
    const lone = known.filter((i) => (curve.mean[i - 1] ?? null) === null && (curve.mean[i + 1] ?? null) === null); // a line does not show them
    const dots = { ...common, name: `${common.name} alone`, x: lone.map((i) => x[i]), y: lone.map((i) => smooth[i]), mode: "markers", marker: { color: colour, size: 5 } };
    return [thin, ...(alone ? [] : [{ ...common, x, y: smooth, mode: "lines", line: { color: colour, width: 2 } }]), ...(lone.length ? [dots] : [])];
  }

  /** One band for each study: the lowest, the mean and the highest of its seeds. */
  bands(curves, colours) {
    const groups = Map.groupBy(curves, (curve) => curve.run.study ?? curve.run.id);
    return [...groups].map(([group, members], i) => {
      const smooth = members.map((curve) => ({ x: this.board.scaled(curve.x), y: smoothed(curve.mean, this.board.span, curve.perPoint) }));
      const found = band(smooth);
      if (!found) return [];
      const colour = colours.curve(i);
      const label = members.length > 1 ? `${group}, ${members.length} seeds` : members[0].label;
      this.drawn.push({ name: members[0].name, label, colour: i, run: members[0].run, x: found.x, y: found.mean });
      const common = { type: "scatter", mode: "lines", hoverinfo: "skip", x: found.x };
      return [
        { ...common, name: `${group} highest`, y: found.high, line: { width: 0, color: colour } },
        { ...common, name: `${group} lowest`, y: found.low, line: { width: 0, color: colour }, fill: "tonexty", fillcolor: translucent(colour) },
        { ...common, name: group, y: found.mean, line: { width: 2, color: colour } },
      ];
    });
  }

  /** Show the values at a place of the axis; the newest for null. */
  point(place) {
    const rows = this.drawn.map((curve) => {
      const index = place === null ? curve.y.findLastIndex((value) => value !== null) : nearest(curve.x, place);
      return { ...curve, value: index < 0 ? null : curve.y[index], at: index < 0 ? null : curve.x[index] };
    });
    const listed = rows.slice(0, MAX_LISTED).map((row) =>
      el("li", { class: `c${row.colour % 10}`, "data-name": row.name, "data-run": row.run.id },
        el("span", { class: "swatch", "aria-hidden": "true" }), `${row.label} `, el("output", {}, written(row.name, row.value))),
    );
    if (rows.length > MAX_LISTED) listed.push(el("li", {}, `and ${rows.length - MAX_LISTED} more`));
    this.legend.replaceChildren(...listed);
    const at = place === null ? "" : this.board.placeText(rows[0]?.at ?? place);
    setText(this.where, at && `at ${at}`);
    this.speak(rows, place);
    this.move(place);
  }

  speak(rows, place) {
    const x = this.drawn[0]?.x ?? [];
    const index = place === null ? x.length - 1 : nearest(x, place);
    const values = rows.map((row) => `${row.label} ${written(row.name, row.value)}`).join(", ");
    this.plot.setAttribute("aria-valuemax", Math.max(0, x.length - 1));
    this.plot.setAttribute("aria-valuenow", Math.max(0, index));
    this.plot.setAttribute("aria-valuetext", x.length ? `${this.board.placeText(x[index])}: ${values}` : "no values yet");
  }

  /** Put the vertical line at a place. */
  move(place) {
    const axis = this.canvas._fullLayout?.xaxis;
    const inside = place !== null && axis && place >= axis.range[0] && place <= axis.range[1];
    this.rule.hidden = !inside;
    if (inside) this.rule.style.transform = `translateX(${MARGIN.l + axis.d2p(place)}px)`;
  }

  async save() {
    const Plotly = await library();
    const colours = theme();
    const ground = { paper_bgcolor: colours.card, plot_bgcolor: colours.card };
    const title = { text: plain(this.spec.title), font: { size: 15, color: colours.ink } };
    const legend = { showlegend: true, legend: { orientation: "h", y: -0.12 } };
    const shown = new Set(this.drawn.map((curve) => `${curve.run.id} ${curve.name}`));
    const data = this.canvas.data.map((trace) => ({ ...trace, name: plain(trace.name ?? ""), showlegend: shown.has(trace.name) && trace.opacity !== 0.28 || !trace.fill && trace.line?.width === 2 }));
    const layout = { ...this.layout(colours), ...ground, ...legend, title, margin: { l: 60, r: 20, t: 44, b: 60 } };
    await Plotly.downloadImage({ data, layout }, { format: "png", width: 1000, height: 560, scale: 2, filename: this.spec.title });
  }

  close() {
    window.Plotly?.purge(this.canvas);
  }
}

/** A colour of style.css, at a fifth of its strength. */
function translucent(colour) {
  return `${colour}33`;
}

/** Text that the library does not read as markup. */
function plain(text) {
  return text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
}

/** A place on an axis as text. */
export function placeText(axis, value) {
  if (axis === "wall_s") return `${Number(value.toPrecision(3))} h`;
  return axis === "iteration" ? `iteration ${count(value)}` : `${count(value)} env steps`;
}
