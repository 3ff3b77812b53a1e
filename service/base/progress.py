"""Progress of what takes long: a bar on a terminal, elsewhere a plain line every ten seconds.

Code that takes long says so: ``with doing("evaluating", 300, "episodes") as activity: ... activity.advance()``. A
program shows it by opening a ``Display``, as ``tandem`` does. Where none is open, as in a user's own program or in
another thread, nothing is shown.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import UnsupportedOperation
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
from rich.progress import Task as Bar
from rich.text import Text

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

PLAIN_INTERVAL_S = 10.0
_T = TypeVar("_T")


class Activity:
    """Work that takes long.

    Args:
        title: what is done, such as ``evaluating``.
        total: how much there is to do; None: not known.
        unit: of the total, such as ``episodes``.
    """

    bar: Bar
    """What rich knows of it, once a display shows it."""

    def __init__(self, title: str, total: int | None = None, unit: str = "") -> None:
        self.title, self.total, self.unit, self.done = title, total, unit, 0
        self.note = ""
        """What else is known, shown after the rest."""
        self.told_s = 0.0
        """Time of its last plain line."""
        self.display: Display | None = None

    def advance(self, num: int = 1) -> None:
        """Count what was done."""
        self.done += num
        if self.display is not None:
            self.display.advanced(self)


@contextmanager
def doing(title: str, total: int | None = None, unit: str = "", *, aloud: bool = True) -> Iterator[Activity]:
    """Show the block as an activity, see ``Activity``.

    Plain lines tell at once of an activity without a total that is ``aloud``, as nothing of it can be counted.
    """
    activity, display = Activity(title, total, unit), _open.get()
    if display is not None:
        display.begin(activity)
        if total is None and aloud and not display.moves:
            display.say(f"{title} ...")
    try:
        yield activity
    finally:
        if display is not None:
            display.end(activity)


def track(items: Iterable[_T], title: str, total: int, unit: str) -> Iterator[_T]:
    """The items, shown as an activity while they are taken."""
    with doing(title, total, unit) as activity:
        for item in items:
            yield item
            activity.advance()


def answer(text: str) -> None:
    """Tell the person at the terminal something at once; for signal handlers, which may not print."""
    display = _open.get()
    if display is not None:
        display.answer(text)


class Display:
    """Shows activities on a console; as a context manager it is the one that is open.

    Args:
        console: of stderr, so that what a command prints for other programs stays by itself.
        quiet: show nothing but answers.
        get_time: seconds, of a clock that never goes back.
    """

    def __init__(
        self, console: Console, *, quiet: bool = False, get_time: Callable[[], float] = time.monotonic
    ) -> None:
        self.console, self.quiet = console, quiet
        self._get_time = get_time
        self._bars = self._new_bars()

    def __enter__(self) -> Self:
        self._token = _open.set(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _open.reset(self._token)
        self._bars.stop()

    @property
    def moves(self) -> bool:
        """Whether bars are drawn; otherwise lines follow each other."""
        return self.console.is_terminal and not self.quiet

    def say(self, line: str) -> None:
        """Print a plain line; on a terminal it stays above the bars."""
        if not self.quiet:
            self.console.print(line, highlight=False, soft_wrap=True, markup=False)

    def begin(self, activity: Activity) -> None:
        """Show an activity that begins."""
        self._bars.disable = not self.moves
        self._bars.start()
        self._bars.add_task(activity.title, total=activity.total, unit=activity.unit, note="")
        activity.bar = self._bars.tasks[-1]
        activity.display, activity.told_s = self, self._get_time()

    def advanced(self, activity: Activity) -> None:
        """Show how far an activity is."""
        self._bars.update(activity.bar.id, description=activity.title, completed=activity.done, note=activity.note)
        now_s = self._get_time()
        if not self.moves and now_s - activity.told_s >= PLAIN_INTERVAL_S:
            activity.told_s = now_s
            self.say(line(activity))

    def end(self, activity: Activity) -> None:
        """Show an activity no more."""
        activity.display = None
        self._bars.remove_task(activity.bar.id)
        if not self._bars.tasks:
            self._bars.stop()
            self._bars = self._new_bars()

    def answer(self, text: str) -> None:
        """See ``answer``: bars show it when they move next; elsewhere it goes straight to the file."""
        if self._bars.tasks and self.moves:
            self._bars.answer = text
            return
        with suppress(OSError, ValueError):  # it is closed
            try:
                os.write(self.console.file.fileno(), f"{text}\n".encode())
            except UnsupportedOperation:  # it is no file, as in a notebook
                self.console.file.write(f"{text}\n")

    def _new_bars(self) -> _Bars:
        # What commands print for other programs must not come onto our console when it is sent somewhere else.
        return _Bars(
            TextColumn("{task.description}", markup=False), BarColumn(20), _Numbers(),
            console=self.console, transient=True, redirect_stdout=sys.stdout.isatty(), disable=True,
            get_time=self._get_time, speed_estimate_period=math.inf,
        )  # fmt: skip


class _Bars(Progress):
    """A row for each activity, and below them the answer to a signal."""

    answer = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        yield from super().get_renderables()
        if self.answer:
            yield Text(self.answer, style="bold")


class _Numbers(ProgressColumn):
    def render(self, task: Bar) -> Text:
        return Text("\n".join(filter(None, (_numbers(task), task.fields["note"]))))


def line(activity: Activity) -> str:
    """How far an activity is that has been shown, in one line."""
    return f"{activity.title}: {' | '.join(filter(None, (_numbers(activity.bar), activity.note)))}"


def _numbers(bar: Bar) -> str:
    """How far it is, how fast, for how long already, and how long it will take."""
    parts = []
    if bar.total is not None:
        parts.append(f"{bar.completed:,.0f} of {bar.total:,.0f} {bar.fields['unit']}")
        if bar.speed:
            parts.append(f"{bar.speed:,.0f}/s" if bar.speed >= 10.0 else f"{bar.speed:.2g}/s")
    parts.append(_clock(bar.elapsed or 0.0))
    if bar.time_remaining is not None:
        parts.append(f"{_clock(bar.time_remaining)} left")
    return ", ".join(parts)


def _clock(seconds: float) -> str:
    """A duration as a clock shows it: ``0:07``, ``12:34``, ``1:02:03``."""
    whole = round(seconds)
    clock = f"{whole // 60 % 60}:{whole % 60:02}"
    return clock if whole < 3600 else f"{whole // 3600}:{clock:0>5}"


_open: ContextVar[Display | None] = ContextVar("display", default=None)


def display() -> Display | None:
    """The display that is open."""
    return _open.get()
