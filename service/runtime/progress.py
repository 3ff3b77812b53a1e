"""A run's progress: a live table on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

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
_SMOOTHING = 0.8


class Progress:
    """Shows every iteration's metrics; a context manager."""

    def __init__(self, total_env_steps: int, console: Console) -> None:
        """Nothing is printed before the first ``show``."""
        self._total = total_env_steps
        self._console = console
        self._live = Live(console=console, refresh_per_second=4, transient=False) if console.is_terminal else None
        self._values: dict[str, float] = {}
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

    def show(self, metrics: dict[str, float]) -> None:
        """Take in one iteration. Rates are smoothed over about five iterations; evaluations are shown as they are."""
        for _, key, _ in _ROWS:
            if key in metrics:
                smooth = key in self._values and not key.startswith("evaluation/")
                old = self._values[key] if smooth else metrics[key]
                self._values[key] = _SMOOTHING * old + (1 - _SMOOTHING) * metrics[key]
        steps = int(metrics["env_steps"])
        if self._live is not None:
            self._live.update(self._table(steps))
        elif time.monotonic() - self._last_line_s >= PLAIN_INTERVAL_S or steps >= self._total:
            self._last_line_s = time.monotonic()
            self._console.print(self._line(steps), highlight=False, soft_wrap=True)

    def _table(self, steps: int) -> Table:
        table = Table(show_header=False, title=f"{steps:,} of {self._total:,} env steps", title_justify="left")
        table.add_row("", ProgressBar(total=self._total, completed=min(steps, self._total), width=40))
        for label, key, pattern in _ROWS:
            table.add_row(label, pattern.format(self._values[key]) if key in self._values else "-")
        return table

    def _line(self, steps: int) -> str:
        parts = [
            f"{key.split('/')[1]} {pattern.format(self._values[key])}"
            for _, key, pattern in _ROWS
            if key in self._values
        ]
        return f"{steps:>10,} env steps | " + " | ".join(parts)
