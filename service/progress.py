"""Progress of whatever takes longer than two seconds: a moving line on a terminal, plain lines now and then elsewhere.

Code that takes long says so: ``with doing("evaluating", 300, "episodes") as task: ... task.advance()``. Who shows it is
the program's business: ``tandem`` opens a ``Display``. Where none is open, as in somebody's own program or in another
thread, nothing happens.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.live import Live

SHOWN_AFTER_S = 2.0
PLAIN_INTERVAL_S = 10.0
_T = TypeVar("_T")


class Task:
    """Something that takes long.

    Args:
        title: what is done, such as ``evaluating``.
        total: how much there is to do; None where nobody knows.
        unit: of the total, such as ``episodes``.
        done: how much was done before, by another process.
        aloud: whether plain lines tell of it, too. One without a total has its line at once, since nobody counts.
    """

    def __init__(
        self, title: str, total: int | None = None, unit: str = "", done: int = 0, *, aloud: bool = True
    ) -> None:
        self.title, self.total, self.unit, self.done, self.aloud = title, total, unit, done, aloud
        self.note = ""
        """What else is known, shown after the rest."""
        self.begun_s = time.monotonic()
        self._done_before = done
        self._display = _open.get()

    def advance(self, num: int = 1) -> None:
        """Count what was done."""
        self.done += num
        if self._display is not None:
            self._display.advanced(self)

    @property
    def elapsed_s(self) -> float:
        """Time since it began."""
        return time.monotonic() - self.begun_s

    def text(self) -> str:
        """How far it is, how fast, for how long already, and how long it will take."""
        parts = []
        if self.total is not None:
            parts.append(f"{self.done:,} of {self.total:,} {self.unit}")
            if (num := self.done - self._done_before) > 0 and self.elapsed_s > 0.0:
                rate = num / self.elapsed_s
                parts.append(f"{rate:,.0f}/s" if rate >= 10.0 else f"{rate:.2g}/s")
                parts.append(f"{minutes(self.elapsed_s)}, {minutes((self.total - self.done) / rate)} left")
        if len(parts) < 2:
            parts.append(minutes(self.elapsed_s))
        return ", ".join(parts) + (f" | {self.note}" if self.note else "")


@contextmanager
def doing(title: str, total: int | None = None, unit: str = "", done: int = 0, *, aloud: bool = True) -> Iterator[Task]:
    """Show the block as a task, see ``Task``."""
    task, display = Task(title, total, unit, done, aloud=aloud), _open.get()
    if display is not None:
        display.begin(task)
    try:
        yield task
    finally:
        if display is not None:
            display.end(task)


def counted(items: Iterable[_T], title: str, total: int, unit: str) -> Iterator[_T]:
    """The items, shown as a task while they are taken."""
    with doing(title, total, unit) as task:
        for item in items:
            yield item
            task.advance()


def tick() -> None:
    """Let what is shown be seen while nothing can be counted, as while others work."""
    display = _open.get()
    if display is not None:
        display.tick()


def answer(text: str) -> None:
    """Tell the person at the terminal something at once; for signal handlers, which may not print."""
    display = _open.get()
    if display is not None:
        display.answer(text)


def minutes(seconds: float) -> str:
    """A duration as a clock shows it: ``0:07``, ``12:34``, ``1:02:03``."""
    whole = round(max(seconds, 0.0))
    clock = f"{whole // 60 % 60}:{whole % 60:02}"
    return clock if whole < 3600 else f"{whole // 3600}:{clock:0>5}"


class Display:
    """Shows tasks, and a table above them, on a console; as a context manager it is the one that is open.

    Args:
        console: of stderr, so that what a command prints for other programs stays by itself.
        quiet: show nothing but answers.
    """

    def __init__(self, console: Console, *, quiet: bool = False) -> None:
        self.console, self.quiet = console, quiet
        self._tasks: list[Task] = []
        self._head: RenderableType | None = None
        self._answer = ""
        self._live: Live | None = None
        self._last_line_s = float("-inf")

    def __enter__(self) -> Self:
        self._token = _open.set(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _open.reset(self._token)
        self._stop()

    @property
    def moves(self) -> bool:
        """Whether things are drawn again and again; or else lines follow each other."""
        return self.console.is_terminal and not self.quiet

    def say(self, line: str) -> None:
        """Print a plain line; on a terminal it stays above what moves."""
        if not self.quiet:
            self.console.print(line, highlight=False, soft_wrap=True, markup=False)

    def say_plain(self, line: str) -> None:
        """Print a plain line where nothing moves."""
        if not self.moves:
            self._last_line_s = time.monotonic()
            self.say(line)

    def is_due(self) -> bool:
        """Whether it is time for another plain line."""
        return not self.moves and time.monotonic() - self._last_line_s >= PLAIN_INTERVAL_S

    def show(self, head: RenderableType) -> None:
        """Show a table above the tasks; one that is shown already is replaced."""
        self._head = head
        if self.moves:
            self._start()

    def keep(self) -> None:
        """Leave the table as it is now where it is; what moves goes on below."""
        head, self._head = self._head, None
        self._stop()
        if head is not None and self.moves:
            self.console.print(head)

    def begin(self, task: Task) -> None:
        """Take in a task that begins. One of unknown length is shown at once."""
        self._tasks.append(task)
        if task.total is None and not self.quiet:
            if self.moves:
                self._start()
            if task.aloud:
                self.say_plain(f"{task.title} ...")

    def advanced(self, task: Task) -> None:
        """Take in that something was done."""
        if self.quiet or task.elapsed_s < SHOWN_AFTER_S:
            return
        if self.moves:
            self._start()
        elif self.is_due() and task.aloud:
            self.say_plain(f"{task.title}: {task.text()}")

    def tick(self) -> None:
        """See ``tick``."""
        for task in self._tasks[-1:]:
            self.advanced(task)

    def end(self, task: Task) -> None:
        """Take in that a task is over."""
        self._tasks.remove(task)
        if not self._shown() and self._head is None:
            self._stop()

    def answer(self, text: str) -> None:
        """See ``answer``: what moves shows it when it moves next; elsewhere it goes straight to the file."""
        if self._live is not None:
            self._answer = text
            return
        line = f"{text}\n"
        try:
            os.write(self.console.file.fileno(), line.encode())
        except (OSError, ValueError):  # it has no descriptor
            with suppress(OSError, ValueError):
                self.console.file.write(line)

    def __rich__(self) -> RenderableType:
        """What moves."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        rows = Table.grid(padding=(0, 1))
        for task in self._shown():
            bar = ProgressBar(total=task.total or 1, completed=task.done, width=20, pulse=task.total is None)
            rows.add_row(Text(task.title), bar, Text(task.text()))
        parts: list[RenderableType] = [] if self._head is None else [self._head]
        parts += [rows] * bool(rows.row_count) + [Text(self._answer, style="bold")] * bool(self._answer)
        return Group(*parts)

    def _shown(self) -> list[Task]:
        """Tasks that are worth a line."""
        return [task for task in self._tasks if task.total is None or task.elapsed_s >= SHOWN_AFTER_S]

    def _start(self) -> None:
        if self._live is None:
            from rich.live import Live

            # What commands print for other programs must not come onto our console when it is sent somewhere else.
            self._live = Live(
                console=self.console, get_renderable=self.__rich__, transient=True,
                redirect_stdout=_is_terminal(), vertical_overflow="crop",
            )  # fmt: skip
            self._live.start(refresh=True)

    def _stop(self) -> None:
        live, self._live, self._answer = self._live, None, ""
        if live is not None:
            live.stop()


_open: ContextVar[Display | None] = ContextVar("display", default=None)


def display() -> Display | None:
    """The display that is open."""
    return _open.get()


def _is_terminal() -> bool:
    import sys

    return sys.stdout.isatty()
