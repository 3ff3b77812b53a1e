// Curves made smooth, and several of them made one band. Curves are {x, y}, y has null where there is no value.

const GRID = 200;

/** How many iterations a curve is averaged over, by the place of the slider. */
export const SPANS = [1, 3, 10, 30, 100, 300, 1000];

/** The place of the slider for a run of so many iterations. */
export function usualPlace(numIterations) {
  return Math.max(0, SPANS.findLastIndex((span) => span <= Math.min(30, numIterations / 20)));
}

/**
 * A moving average with exponential weights and Adam's correction for its start. The span counts iterations, and a point
 * stands for ``perPoint`` of them.
 */
export function smoothed(values, span, perPoint) {
  if (span <= 1) return values;
  const kept = (1 - 2 / (span + 1)) ** Math.max(1, perPoint);
  let [average, weight, gap] = [0, 0, 1];
  return values.map((value) => {
    if (value === null) {
      gap *= kept;
      return null;
    }
    const stays = gap * kept;
    gap = 1;
    average = stays * average + (1 - stays) * value;
    weight = stays * weight + (1 - stays);
    return average / weight;
  });
}

/** Each point twice, first the lowest and then the highest of what it stands for, so that no extreme is lost. */
export function extremes(x, low, high) {
  return { x: x.flatMap((value) => [value, value]), y: low.flatMap((value, i) => [value, high[i]]) };
}

/** The lowest, the mean and the highest of several curves, wherever at least one of them is. */
export function band(curves) {
  const known = curves.map(({ x, y }) => ({ x: x.filter((_, i) => y[i] !== null), y: y.filter((value) => value !== null) })).filter(({ x }) => x.length);
  if (!known.length) return null;
  const from = Math.min(...known.map(({ x }) => x[0]));
  const to = Math.max(...known.map(({ x }) => x.at(-1)));
  const x = Array.from({ length: GRID + 1 }, (_, i) => from + ((to - from) * i) / GRID);
  const at = x.map((place) => known.map((curve) => valueAt(curve, place)).filter((value) => value !== null));
  const each = (of) => at.map((values) => (values.length ? of(values) : null));
  return {
    x,
    low: each((values) => Math.min(...values)),
    mean: each((values) => values.reduce((sum, value) => sum + value, 0) / values.length),
    high: each((values) => Math.max(...values)),
  };
}

/** The value between two points; null outside a curve. */
export function valueAt({ x, y }, place) {
  if (!x.length || place < x[0] || place > x.at(-1)) return null;
  const right = Math.max(1, lowerBound(x, place));
  if (x.length === 1) return y[0];
  const [x0, x1] = [x[right - 1], x[right]];
  const share = x1 > x0 ? (place - x0) / (x1 - x0) : 0;
  return y[right - 1] + share * (y[right] - y[right - 1]);
}

/** The index of the point that is nearest to a place; -1 if there are none. */
export function nearest(x, place) {
  if (!x.length) return -1;
  const right = Math.min(x.length - 1, lowerBound(x, place));
  return right > 0 && place - x[right - 1] < x[right] - place ? right - 1 : right;
}

function lowerBound(x, place) {
  let [low, high] = [0, x.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (x[middle] < place) low = middle + 1;
    else high = middle;
  }
  return low;
}
