"""Progress of a run, or of the runs of a study: a live table on a terminal, plain lines now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from rich.progress_bar import ProgressBar
from rich.table import Table

from service.progress import Display, minutes
from service.store.models import RunState

_ROWS = (
    ("Alice: valid goals", "alice/valid_fraction", "{:.0%}"),
    ("Alice: lifted, of the valid", "alice/lifted_fraction", "{:.0%}"),
    ("Alice: goal distance", "alice/goal_distance_m", "{:.3f} m"),
    ("Bob: solves of Alice's goals", "bob/success_rate", "{:.0%}"),
    ("Bob: random table goals, at the end", "evaluation/table_success_last", "{:.0%}"),
    ("Bob: random goals in the air, at the end", "evaluation/air_success_last", "{:.0%}"),
    ("speed", "time/env_steps_per_s", "{:,.0f} env steps/s"),
)
_SKILL_ROWS = (
    ("Episodes that move the object", "skills/moved_fraction", "{:.0%}"),
    ("Episodes that lift it", "skills/lifted_fraction", "{:.0%}"),
    ("How far it came", "skills/distance_m", "{:.3f} m"),
    ("32 random skills: share of the table's cells", "evaluation/coverage", "{:.0%}"),
    _ROWS[-1],
)
_COLUMNS = (
    ("valid", "alice/valid_fraction"),
    ("lifted", "alice/lifted_fraction"),
    ("solved", "bob/success_rate"),
    ("table", "evaluation/table_success_last"),
    ("air", "evaluation/air_success_last"),
    ("env steps/s", "time/env_steps_per_s"),
)
_PATTERNS = {key: pattern for _, key, pattern in (*_ROWS, *_SKILL_ROWS)}
_SMOOTHING = 0.8


class _Values:
    """The metrics of one run that are shown: rates smoothed over about five iterations, evaluations as they are."""

    def __init__(self) -> None:
        self.env_steps = 0
        self._values: dict[str, float] = {}

    def take(self, metrics: Mapping[str, float | None]) -> None:
        self.env_steps = int(metrics["env_steps"] or 0)
        for key in _PATTERNS:
            new = metrics.get(key)
            if new is not None:
                smooth = key in self._values and not key.startswith("evaluation/")
                old = self._values[key] if smooth else new
                self._values[key] = _SMOOTHING * old + (1 - _SMOOTHING) * new

    @property
    def rows(self) -> tuple[tuple[str, str, str], ...]:
        """What is shown of such a run."""
        return _SKILL_ROWS if _SKILL_ROWS[0][1] in self._values else _ROWS

    def text(self, key: str) -> str:
        return _PATTERNS[key].format(self._values[key]) if key in self._values else "-"

    def line(self) -> str:
        parts = [f"{key.split('/')[1]} {self.text(key)}" for _, key, _ in self.rows if key in self._values]
        return f"{self.env_steps:>10,} env steps | " + " | ".join(parts)


class _Shown:
    """A table on the display while a block runs; it stays there afterwards, as it was at the end."""

    def __init__(self, total_env_steps: int, display: Display) -> None:
        """Nothing is shown before the first ``show``.

        Args:
            total_env_steps: of each run.
            display: where it is shown.
        """
        self._total, self._display = total_env_steps, display
        self._begun_s = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._display.keep()

    def say(self, line: str) -> None:
        """Print a plain line."""
        self._display.say(line)


class Progress(_Shown):
    """Shows every iteration's metrics of one run; a context manager."""

    def __init__(self, total_env_steps: int, display: Display) -> None:
        super().__init__(total_env_steps, display)
        self._values = _Values()
        self._first: tuple[float, int] | None = None
        """Time and env steps of the first iteration that was shown."""

    def show(self, metrics: Mapping[str, float]) -> None:
        """Take in one iteration. Rates are smoothed over about five iterations; evaluations are shown as they are."""
        self._values.take(metrics)
        self._first = self._first or (time.monotonic(), self._values.env_steps)
        self._display.show(self)
        if self._display.is_due() or self._values.env_steps >= self._total:
            self._display.say_plain(f"{self._values.line()} | {self._times()}")

    def __rich__(self) -> Table:
        """The table, as it is now."""
        steps = self._values.env_steps
        table = Table(show_header=False, title=f"{steps:,} of {self._total:,} env steps", title_justify="left")
        table.add_row("", ProgressBar(total=self._total, completed=min(steps, self._total), width=40))
        for label, key, _ in self._values.rows:
            table.add_row(label, self._values.text(key))
        table.add_row("time", self._times())
        return table

    def _times(self) -> str:
        """How long it has taken, and how long it will take at the rate since the first iteration that was shown."""
        now_s, steps = time.monotonic(), self._values.env_steps
        begun_s, begun_steps = self._first or (now_s, steps)
        left = ""
        if steps >= self._total:
            left = ", learning is over"
        elif steps > begun_steps and now_s > begun_s:
            left = f", about {minutes((self._total - steps) * (now_s - begun_s) / (steps - begun_steps))} left"
        return f"{minutes(now_s - self._begun_s)}{left}"


class StudyProgress(_Shown):
    """Shows the runs of a study side by side; a context manager."""

    def __init__(self, total_env_steps: int, display: Display) -> None:
        super().__init__(total_env_steps, display)
        self._values: dict[int, _Values] = {}
        self._states: Mapping[int, RunState | None] = {}
        self._said: dict[int, int] = {}
        """Env steps of each run's last line."""

    def take(self, seed: int, metrics: Mapping[str, float | None]) -> None:
        """Take in one iteration of one run."""
        self._values.setdefault(seed, _Values()).take(metrics)

    def show(self, states: Mapping[int, RunState | None]) -> None:
        """Show all runs, each with its state; None: it waits for others to end."""
        self._states = states
        self._display.show(self)
        new = {seed: each for seed, each in self._values.items() if each.env_steps != self._said.get(seed)}
        if new and self._display.is_due():
            for seed, values in new.items():
                self._said[seed] = values.env_steps
                self._display.say_plain(f"seed {seed}: {values.line()}")

    def __rich__(self) -> Table:
        """The table, as it is now."""
        done = sum(values.env_steps for values in self._values.values())
        title = (
            f"{done:,} of {self._total * len(self._states):,} env steps, {minutes(time.monotonic() - self._begun_s)}"
        )
        head = ("seed", "state", f"of {self._total:,} env steps", *(label for label, _ in _COLUMNS))
        table = Table(*head, title=title, title_justify="left")
        for seed, state in self._states.items():
            values = self._values.get(seed, _Values())
            bar = ProgressBar(total=self._total, completed=min(values.env_steps, self._total), width=20)
            cells = [values.text(key).removesuffix(" env steps/s") for _, key in _COLUMNS]
            table.add_row(str(seed), state or "waiting", bar, *cells)
        return table
