// The goal map: a picture from above for each layer of height, one square for each cell.

import { colour, colourBar } from "./colours.js";
import { el, setText, svg } from "./dom.js";
import { count, percent } from "./format.js";
import { cellText, heights, layers, meanSuccess, MEASURES } from "./grid.js";

const IDLE = "Point at a cell, or move with the arrow keys and page up and down.";
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
    const none = el("p", { class: "scale" }, el("span", { class: "key untried" }), "proposed, not tried", el("span", { class: "key unseen" }), "never proposed");
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
    this.map.addEventListener("blur", () => this.look(null));
    this.map.addEventListener("keydown", (event) => {
      const move = MOVES[event.key];
      if (!move || !this.grid) return;
      event.preventDefault();
      this.step(move);
    });
  }

  /** To the next cell in a direction in which a goal was proposed. */
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
    const solved = mean === null ? "none tried yet" : `Bob solves ${percent(mean)} in the mean over cells`;
    setText(this.summary, `Alice proposed goals in ${grid.cells.length} of ${grid.num_cells} cells; ${solved}. From above, x to the right, y up.`);
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
