"""Progress of a run, or of the runs of a study: a live table on a terminal, plain lines now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from service.store.models import RunState

PLAIN_INTERVAL_S = 10.0

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
    """The part of the console that is drawn anew again and again; a context manager."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, refresh_per_second=4, transient=False) if console.is_terminal else None
        self._last_line_s = float("-inf")

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, line: str) -> None:
        """Print a plain line; on a terminal it stays above the table."""
        self._console.print(line, highlight=False, soft_wrap=True, markup=False)

    def _due(self) -> bool:
        """Whether it is time for plain lines."""
        if time.monotonic() - self._last_line_s < PLAIN_INTERVAL_S:
            return False
        self._last_line_s = time.monotonic()
        return True


class Progress(_Shown):
    """Shows every iteration's metrics of one run; a context manager."""

    def __init__(self, total_env_steps: int, console: Console) -> None:
        """Nothing is printed before the first ``show``."""
        super().__init__(console)
        self._total = total_env_steps
        self._values = _Values()

    def show(self, metrics: Mapping[str, float]) -> None:
        """Take in one iteration. Rates are smoothed over about five iterations; evaluations are shown as they are."""
        self._values.take(metrics)
        if self._live is not None:
            self._live.update(self._table())
        elif self._due() or self._values.env_steps >= self._total:
            self.say(self._values.line())

    def _table(self) -> Table:
        steps = self._values.env_steps
        table = Table(show_header=False, title=f"{steps:,} of {self._total:,} env steps", title_justify="left")
        table.add_row("", ProgressBar(total=self._total, completed=min(steps, self._total), width=40))
        for label, key, _ in self._values.rows:
            table.add_row(label, self._values.text(key))
        return table


class StudyProgress(_Shown):
    """Shows the runs of a study side by side; a context manager."""

    def __init__(self, total_env_steps: int, console: Console) -> None:
        """Nothing is printed before the first ``show``."""
        super().__init__(console)
        self._total = total_env_steps
        self._values: dict[int, _Values] = {}
        self._said: dict[int, int] = {}
        """Env steps of each run's last line."""

    def take(self, seed: int, metrics: Mapping[str, float | None]) -> None:
        """Take in one iteration of one run."""
        self._values.setdefault(seed, _Values()).take(metrics)

    def show(self, states: Mapping[int, RunState | None]) -> None:
        """Show all runs, each with its state; None: it waits for others to end."""
        if self._live is not None:
            self._live.update(self._table(states))
            return
        new = {seed: each for seed, each in self._values.items() if each.env_steps != self._said.get(seed)}
        if new and self._due():
            for seed, values in new.items():
                self._said[seed] = values.env_steps
                self.say(f"seed {seed}: {values.line()}")

    def _table(self, states: Mapping[int, RunState | None]) -> Table:
        table = Table("seed", "state", f"of {self._total:,} env steps", *(label for label, _ in _COLUMNS))
        for seed, state in states.items():
            values = self._values.get(seed, _Values())
            bar = ProgressBar(total=self._total, completed=min(values.env_steps, self._total), width=20)
            cells = [values.text(key).removesuffix(" env steps/s") for _, key in _COLUMNS]
            table.add_row(str(seed), state or "waiting", bar, *cells)
        return table
