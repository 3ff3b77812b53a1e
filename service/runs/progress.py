"""Progress of a run, or of the runs of a study: a bar for each, with its newest rates."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf

from service.base.progress import Activity, Display, line

_PATTERNS = {
    "alice/valid_fraction": "{:.0%}",
    "alice/lifted_fraction": "{:.0%}",
    "alice/goal_distance_m": "{:.3f} m",
    "bob/success_rate": "{:.0%}",
    "rollout/success_last": "{:.0%}",
    "skills/moved_fraction": "{:.0%}",
    "skills/lifted_fraction": "{:.0%}",
    "skills/distance_m": "{:.3f} m",
    "evaluation/mixed_success_last": "{:.0%}",
    "evaluation/table_success_last": "{:.0%}",
    "evaluation/air_success_last": "{:.0%}",
    "evaluation/one_success_last": "{:.0%}",
    "evaluation/coverage": "{:.0%}",
}
"""Metrics that are shown, where a run has them."""
_SMOOTHING = 0.8


class Progress:
    """Shows every iteration's metrics of a run, or of several side by side, until ``close``. The last lines stay.

    Args:
        display: where they are shown.
    """

    def __init__(self, display: Display) -> None:
        self._display = display
        self._runs: dict[str, tuple[Activity, dict[str, float]]] = {}
        """Bars and rates by title."""

    def close(self) -> None:
        """End the bars."""
        for activity, _ in self._runs.values():
            self._end(activity)

    def say(self, text: str) -> None:
        """Print a plain line."""
        self._display.say(text)

    def show(self, metrics: Mapping[str, float | None], total: int, title: str = "learning") -> None:
        """Take in one iteration of the run with this title, which has so many env steps in all.

        Rates are smoothed over about five iterations; evaluations are shown as they are.
        """
        env_steps = int(metrics["env_steps"] or 0)
        if title not in self._runs:
            self._runs[title] = Activity(title, total, "env steps"), {}
            self._display.begin(self._runs[title][0])
        activity, rates = self._runs[title]
        for key in _PATTERNS:
            new = metrics.get(key)
            if new is not None:
                old = new if key.startswith("evaluation/") else rates.get(key, new)
                rates[key] = _SMOOTHING * old + (1 - _SMOOTHING) * new
        shown = [key for key in _PATTERNS if key in rates]
        activity.note = " | ".join(f"{key.split('/')[1]} {_PATTERNS[key].format(rates[key])}" for key in shown)
        if env_steps >= total:
            activity.told_s = inf  # its last line follows anyway
        activity.advance(env_steps - activity.done)
        if env_steps >= total:
            self._end(activity)

    def _end(self, activity: Activity) -> None:
        if activity.display is not None:
            self._display.end(activity)
            self.say(line(activity))
