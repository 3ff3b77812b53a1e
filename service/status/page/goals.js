// The goal map: a view from above for each layer of height, one square for each cell.

import { el, setText, svg } from "./dom.js";
import { count, percent, quantity } from "./format.js";

const IDLE = "Point at a cell, or move with the arrow keys and page up and down.";
const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const MOVES = {
  ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowDown: [0, -1, 0], ArrowUp: [0, 1, 0], PageDown: [0, 0, -1], PageUp: [0, 0, 1],
};

export class GoalMap {
  constructor() {
    this.measure = MEASURES[0];
    this.summary = el("p", { class: "summary" });
    this.reading = el("p", { class: "reading", "aria-live": "polite" }, IDLE);
    this.low = el("span", {});
    this.high = el("span", {});
    const legend = el("p", { class: "scale" }, this.low, colourBar(), this.high);
    const none = el("p", { class: "scale" }, el("span", { class: "key untried" }), "no goal tried", el("span", { class: "key unseen" }), "never seen");
    const label = "Goal map. Arrow keys move over the cells, page up and down from layer to layer.";
    this.map = el("div", { class: "layers", tabindex: 0, role: "application", "aria-label": label });
    this.root = el("div", {}, this.summary, this.choices(), this.map, this.reading, legend, none);
    this.listen();
  }

  choices() {
    const buttons = MEASURES.map((measure) => {
      const input = el("input", { type: "radio", name: "measure", value: measure.key, checked: measure === this.measure });
      input.addEventListener("change", () => this.choose(measure));
      return el("label", {}, input, measure.label);
    });
    return el("fieldset", { class: "choice" }, el("legend", {}, "Coloured by"), ...buttons);
  }

  choose(measure) {
    this.measure = measure;
    if (this.grid) this.draw();
  }

  listen() {
    const at = (event) => event.target.closest("rect.cell")?.cell;
    this.map.addEventListener("pointerover", (event) => this.look(at(event) ?? null));
    this.map.addEventListener("pointerdown", (event) => this.look(at(event) ?? null));
    this.map.addEventListener("pointerleave", () => this.look(null));
    this.map.addEventListener("keydown", (event) => {
      const move = MOVES[event.key];
      if (!move || !this.grid) return;
      event.preventDefault();
      this.step(move);
    });
  }

  /** Move to the next cell, in one direction, in which a goal was proposed. */
  step(move) {
    const cells = this.layers.flatMap((layer) => layer.cells);
    let place = this.chosen ? [this.chosen.x, this.chosen.y, this.chosen.z] : null;
    if (!place) return this.look(cells[0] ?? null);
    for (;;) {
      place = place.map((value, axis) => value + move[axis]);
      if (place.some((value, axis) => value < 0 || value >= this.grid.shape[axis])) return undefined;
      const found = cells.find((cell) => cell.x === place[0] && cell.y === place[1] && cell.z === place[2]);
      if (found) return this.look(found);
    }
  }

  look(cell) {
    this.chosen = cell;
    setText(this.reading, cell ? cellText(cell) : IDLE);
    for (const rect of this.map.querySelectorAll("rect.cell")) rect.classList.toggle("chosen", rect.cell === cell);
  }

  update(grid) {
    this.grid = grid;
    this.layers = layers(grid);
    const mean = meanSuccess(grid.cells);
    const solved = mean === null ? "no goals tried yet" : `Bob solves ${percent(mean)} in the mean over cells`;
    setText(this.summary, `${grid.cells.length} of ${grid.num_cells} cells seen; ${solved}. From above, x to the right, y up.`);
    this.draw();
  }

  draw() {
    const looked = this.chosen;
    const most = Math.max(1, ...this.grid.cells.map((cell) => cell.num_tries));
    setText(this.low, this.measure.low);
    setText(this.high, this.measure.key === "tries" ? `${count(most)}, the ${this.measure.high}` : this.measure.high);
    this.map.replaceChildren(...this.layers.map((layer) => this.layer(layer, most)));
    const same = (cell) => looked && cell.x === looked.x && cell.y === looked.y && cell.z === looked.z;
    this.look(this.layers.flatMap((layer) => layer.cells).find(same) ?? null);
  }

  layer(layer, most) {
    const [columns, rows] = this.grid.shape;
    const spoken = `${heights(layer)}: ${layer.cells.length} of ${columns * rows} cells, Bob solves ${percent(meanSuccess(layer.cells))}`;
    const box = { viewBox: `-0.1 -0.1 ${columns + 0.2} ${rows + 0.2}`, role: "img", "aria-label": spoken };
    const cells = layer.cells.map((cell) => this.cell(cell, rows, most));
    const background = svg("path", { class: "unseen", d: lattice(columns, rows) });
    const title = el("figcaption", {}, heights(layer), el("span", { class: "hint" }, `${percent(meanSuccess(layer.cells))} solved`));
    return el("figure", { class: "layer" }, title, svg("svg", box, background, ...cells));
  }

  cell(cell, rows, most) {
    const share = this.measure.share(cell, most);
    const look = share === null ? { class: "cell untried" } : { class: "cell", fill: colour(share) };
    const rect = svg("rect", { ...look, x: cell.x + 0.04, y: rows - 1 - cell.y + 0.04, width: 0.92, height: 0.92, rx: 0.1 });
    rect.cell = cell;
    return rect;
  }
}

/** The lines of an empty grid. */
function lattice(columns, rows) {
  const vertical = Array.from({ length: columns + 1 }, (_, x) => `M${x} 0V${rows}`);
  const horizontal = Array.from({ length: rows + 1 }, (_, y) => `M0 ${y}H${columns}`);
  return [...vertical, ...horizontal].join("");
}

/** Quantities shown by colour: ``share`` is from 0 to 1, null if unknown. */
const MEASURES = [
  {
    key: "success",
    label: "Difficulty",
    low: "hard: Bob never solves it",
    high: "easy: he always does",
    share: (cell) => (cell.num_tries ? cell.success_rate : null),
  },
  {
    key: "learnability",
    label: "Learnability",
    low: "0: always or never solved",
    high: "0.25: solved half the time",
    share: (cell) => (cell.num_tries ? cell.learnability / 0.25 : null),
  },
  {
    key: "tries",
    label: "Tries",
    low: "one",
    high: "most, logarithmic",
    share: (cell, most) => (cell.num_tries ? Math.log(cell.num_tries) / Math.max(1e-9, Math.log(most)) : null),
  },
];

/** The layers of a grid from the table upwards: {low_m, high_m, cells}, cells with their column x and row y. */
function layers(grid) {
  const found = Array.from({ length: grid.shape[2] }, (_, z) => ({
    low_m: grid.lower_m[2] + z * grid.cell_size_m,
    high_m: grid.lower_m[2] + (z + 1) * grid.cell_size_m,
    cells: [],
  }));
  for (const cell of grid.cells) {
    const [x, y, z] = cell.center_m.map((at, axis) => place(grid, at, axis));
    found[z].cells.push({ ...cell, x, y, z });
  }
  return found;
}

/** Bob's mean success over the cells he tried; null if there are none. */
function meanSuccess(cells) {
  const tried = cells.filter((cell) => cell.num_tries);
  return tried.length ? tried.reduce((sum, cell) => sum + cell.success_rate, 0) / tried.length : null;
}

/** A layer's heights, in centimetres. */
function heights(layer) {
  return `${centimetres(layer.low_m)} to ${centimetres(layer.high_m)} cm`;
}

/** Text about a cell. */
function cellText(cell) {
  const where = ["x", "y", "z"].map((axis, i) => `${axis} ${quantity(Number(cell.center_m[i].toFixed(3)))}`).join(", ");
  if (!cell.num_tries) return `${where} m: no goal tried here yet`;
  const learnability = quantity(Number(cell.learnability.toFixed(3)));
  const tries = cell.num_tries === 1 ? "1 try" : `${count(cell.num_tries)} tries`;
  return `${where} m: Bob solves ${percent(cell.success_rate)}, learnability ${learnability}, ${tries}`;
}

function place(grid, at, axis) {
  const index = Math.floor((at - grid.lower_m[axis]) / grid.cell_size_m + 1e-9);
  return Math.min(grid.shape[axis] - 1, Math.max(0, index));
}

function centimetres(metres) {
  return Number((100 * metres).toFixed(1));
}

/** The colour of a number from 0 to 1, on the scale viridis by Smith and van der Walt. */
function colour(fraction) {
  const place = Math.min(1, Math.max(0, fraction)) * (STOPS.length - 1);
  const first = Math.min(STOPS.length - 2, Math.floor(place));
  const mixed = STOPS[first].map((from, i) => Math.round(from + (STOPS[first + 1][i] - from) * (place - first)));
  return `rgb(${mixed.join(", ")})`;
}

/** The scale as a bar. */
function colourBar(number = 32) {
  const steps = Array.from({ length: number }, (_, i) =>
    svg("rect", { x: i, y: 0, width: 1.05, height: 1, fill: colour(i / (number - 1)) }),
  );
  const box = { class: "bar", viewBox: `0 0 ${number} 1`, preserveAspectRatio: "none", "aria-hidden": "true" };
  return svg("svg", box, ...steps);
}
