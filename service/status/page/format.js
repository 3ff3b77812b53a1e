// Numbers, times and sizes as text.

export const NBSP = "\u00a0";
const PREFIXES = [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e3, "k"]];
const NONE = "\u2013";

/** 9141723 to "9.14 M", 9141 to "9,141"; a dash for null. */
export function count(value) {
  if (!Number.isFinite(value)) return NONE;
  if (Math.abs(value) < 1e4) return Math.round(value).toLocaleString("en-US");
  return prefixed(value);
}

/** Three significant digits and a prefix; rounded first, so that 999,999 is "1 M" and not "1000 k". */
function prefixed(value) {
  const rounded = Number(value.toPrecision(3));
  const [size, prefix] = PREFIXES.find(([limit]) => Math.abs(rounded) >= limit);
  return `${trimmed((rounded / size).toPrecision(3))}${NBSP}${prefix}`;
}

/** 0.6193 to "61.9 %". */
export function percent(value) {
  if (!Number.isFinite(value)) return NONE;
  const digits = value > 0 && value < 0.9995 ? 1 : 0;
  return `${(100 * value).toFixed(digits)}${NBSP}%`;
}

/** Three significant digits and a unit. */
export function quantity(value, unit = "") {
  if (!Number.isFinite(value)) return NONE;
  const text = Math.abs(value) >= 1e3 ? count(value) : trimmed(value.toPrecision(3));
  return unit ? `${text}${NBSP}${unit}` : text;
}

/** 7500 to "2 h 5 min"; the two largest units. */
export function duration(seconds) {
  if (!Number.isFinite(seconds)) return NONE;
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole}${NBSP}s`;
  const minutes = Math.round(whole / 60);
  if (minutes < 60) return `${minutes}${NBSP}min`;
  const hours = Math.floor(minutes / 60);
  if (hours < 48) return joined(hours, "h", minutes % 60, "min");
  return joined(Math.floor(hours / 24), "d", hours % 24, "h");
}

/** 437716 to "438 kB". */
export function bytes(value) {
  if (!Number.isFinite(value)) return NONE;
  return value < 1000 ? `${value}${NBSP}B` : `${prefixed(value)}B`;
}

/** "1 run", "2 runs". */
export function counted(number, noun) {
  return `${count(number)} ${noun}${number === 1 ? "" : "s"}`;
}

/** A setting that is not usual, such as "300 k env steps". */
export function setting(key, value) {
  if (key === "run.total_env_steps") return `${count(value)} env steps`;
  return `${key} ${typeof value === "string" ? value : JSON.stringify(value)}`;
}

function joined(large, largeUnit, small, smallUnit) {
  return `${large}${NBSP}${largeUnit}${small ? ` ${small}${NBSP}${smallUnit}` : ""}`;
}

function trimmed(digits) {
  const plain = String(Number(digits));
  return plain.includes("e") ? digits : plain;
}
