// The columns that curves are drawn from.

/** A run's metrics over iterations: {iteration, steps, values: {name: [number or null]}}. */
export class Series {
  constructor(names) {
    this.names = names;
    this.clear();
  }

  clear() {
    this.iteration = [];
    this.steps = [];
    this.values = Object.fromEntries(this.names.map((name) => [name, []]));
  }

  get size() {
    return this.steps.length;
  }

  /** Begin anew with what the service remembers. */
  load(history) {
    this.iteration = [...history.iteration];
    this.steps = [...history.env_steps];
    for (const name of this.names) this.values[name] = [...(history.metrics[name] ?? this.steps.map(() => null))];
  }

  /** One more iteration; one that is known already is left out. */
  append(record) {
    if (this.size && record.iteration <= this.iteration[this.size - 1]) return;
    this.iteration.push(record.iteration);
    this.steps.push(record.env_steps);
    for (const name of this.names) this.values[name].push(record[name] ?? null);
  }

  /** The newest number at or before a point; null where there is none. */
  valueAt(name, index) {
    const values = this.values[name];
    for (let i = Math.min(index, values.length - 1); i >= 0; i--) if (values[i] !== null) return values[i];
    return null;
  }

  /** The newest number there is. */
  latest(name) {
    return this.valueAt(name, this.size - 1);
  }

  /** The point whose env steps are nearest. */
  nearest(steps) {
    let best = 0;
    for (let i = 1; i < this.size; i++) if (Math.abs(this.steps[i] - steps) < Math.abs(this.steps[best] - steps)) best = i;
    return best;
  }

  /**
   * A moving average with exponential weights and Adam's correction for its start. Points are means over several
   * iterations where a history is long, so the span counts iterations, not points.
   */
  smoothed(name) {
    const last = this.iteration[this.size - 1] ?? 0;
    const span = Math.min(30, Math.max(1, last / 20));
    const decay = 1 - 2 / (span + 1);
    let [average, weight, before] = [0, 0, 0];
    return this.values[name].map((value, i) => {
      if (value === null) return null;
      const kept = decay ** (this.iteration[i] - before);
      before = this.iteration[i];
      average = kept * average + (1 - kept) * value;
      weight = kept * weight + (1 - kept);
      return average / weight;
    });
  }
}
