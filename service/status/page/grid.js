// The task generator's grid of goal cells, as numbers: layers by height, places in them, and what a cell is worth.

import { count, percent, quantity } from "./format.js";

/** What cells can be coloured by: ``share`` from 0 to 1, null where nothing is known. */
export const MEASURES = [
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
export function layers(grid) {
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

/** The mean success of Bob over the cells he tried; null where there are none. */
export function meanSuccess(cells) {
  const tried = cells.filter((cell) => cell.num_tries);
  return tried.length ? tried.reduce((sum, cell) => sum + cell.success_rate, 0) / tried.length : null;
}

/** A layer's heights, in centimetres. */
export function heights(layer) {
  return `${centimetres(layer.low_m)} to ${centimetres(layer.high_m)} cm`;
}

/** A cell in words. */
export function cellText(cell) {
  const where = ["x", "y", "z"].map((axis, i) => `${axis} ${quantity(Number(cell.center_m[i].toFixed(3)))}`).join(", ");
  if (!cell.num_tries) return `${where} m: proposed, not tried yet`;
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
