// Which metrics there are panels for, and how their numbers are written.

import { percent, quantity } from "./format.js";

/** The panels of a run that are always there: a few curves each. */
export const OVERVIEW = [
  { title: "Alice's proposals", hint: "valid stays high, lifted grows", curves: [["alice/valid_fraction", "valid"], ["alice/lifted_fraction", "lifted"]] },
  {
    title: "Bob on Alice's goals",
    hint: "stays high while the goals get harder",
    curves: [["bob/success_rate", "all"], ["bob/success_rate_air", "air"], ["bob/success_rate_table", "table"]],
  },
  {
    title: "Bob on random goals",
    hint: "success at the last step of an evaluation; grows",
    curves: [["evaluation/mixed_success_last", "mixed"], ["evaluation/air_success_last", "air"], ["evaluation/table_success_last", "table"], ["evaluation/one_success_last", "one object"]],
  },
  { title: "Goals", hint: "grow while Alice proposes harder goals", curves: [["alice/goal_distance_m", "distance"], ["alice/goal_height_m", "height"]] },
  { title: "Throughput", hint: "env steps per second", curves: [["time/env_steps_per_s", "env steps/s"]] },
  { title: "Policy lag", hint: "versions between acting and learning", curves: [["learner/policy_lag", "versions"]] },
];

/** The panels of a run that learns a task. */
export const TRIAL = [
  {
    title: "Success",
    hint: "in evaluations on the way; with noise while it learns",
    curves: [["evaluation/success_last", "last step"], ["evaluation/success_ever", "any step"], ["rollout/success_last", "with noise"]],
  },
  { title: "Return", hint: "steps of an episode at the goal, with noise; grows", curves: [["rollout/return", "return"]] },
  { title: "Entropy coefficient", hint: "falls as the policy gets surer", curves: [["learner/entropy_coefficient", "coefficient"]] },
  { title: "Throughput", hint: "env steps per second", curves: [["time/env_steps_per_s", "env steps/s"]] },
];

/** The metrics of several runs that are always there: one a panel. */
const COMPARED = [
  ["bob/success_rate", "Bob on Alice's goals"],
  ["bob/success_rate_air", "Bob on her goals in the air"],
  ["evaluation/mixed_success_last", "Bob on random goals"],
  ["alice/lifted_fraction", "Alice lifts"],
  ["alice/goal_height_m", "Height of goals"],
  ["time/env_steps_per_s", "Throughput"],
];

/** The metrics of several runs that learn tasks that are always there: one a panel. */
const COMPARED_TRIALS = [
  ["evaluation/success_last", "Success at the last step"],
  ["evaluation/success_ever", "Success at any step"],
  ["rollout/return", "Return"],
  ["time/env_steps_per_s", "Throughput"],
];

/** Panels for runs that are compared: runs that learn tasks, others, or both. */
export function comparedPanels(statuses) {
  const [trials, others] = [statuses.some((run) => run.trial), statuses.some((run) => !run.trial)];
  const metrics = [...(others || !trials ? COMPARED : []), ...(trials ? COMPARED_TRIALS : [])];
  return [...new Map(metrics)].map(([name, title]) => ({ title, hint: name, curves: [[name, title]] }));
}

/** One panel for each metric of a group. */
export function panelsOf(names) {
  return names.map((name) => ({ title: name.split("/").slice(1).join("/") || name, hint: "", curves: [[name, name]] }));
}

/** Metrics by their prefix: "learner/bob_kl" belongs to "learner". */
export function grouped(names) {
  const groups = new Map();
  for (const name of names) {
    const group = name.includes("/") ? name.split("/")[0] : "other";
    groups.set(group, [...(groups.get(group) ?? []), name]);
  }
  return groups;
}

/** Whether a metric is a share of a whole, from 0 to 1. */
export function isFraction(name) {
  return /(fraction|success_rate|success_last|success_ever|success_rate_\w+|share_\d+)(_[a-z]+)?$/.test(name);
}

/** A metric's value as text. */
export function written(name, value) {
  if (isFraction(name)) return percent(value);
  return quantity(value, /_m$/.test(name) ? "m" : /_s$/.test(name) && !/per_s$/.test(name) ? "s" : "");
}
