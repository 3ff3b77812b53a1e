"""Progress of what takes long: when it is shown, what it says, and that nothing is left of it."""

import errno
import io
import re
import threading
import time

import pytest
from rich.console import Console

from service.base.progress import PLAIN_INTERVAL_S, Display, answer, doing, track
from service.cli.common import Terminal
from tests.clock import Clock

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@pytest.fixture
def clock():
    return Clock()


def console(*, terminal=False):
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, _environ={})


def lines(shown):
    return shown.console.file.getvalue().splitlines()


def screen(shown):
    """Lines that are left on a terminal after all that was written: what was erased is not there."""
    found, row = [""], 0
    for part in re.split(r"(\n|\r|\x1b\[1A|\x1b\[2K)", shown.console.file.getvalue()):
        if part in ("\n", "\x1b[1A"):
            row += 1 if part == "\n" else -1
            found += [""] * (row == len(found))
        else:
            found[row] = "" if part == "\x1b[2K" else found[row] + ESCAPE.sub("", part).strip("\r")
    return [line.rstrip() for line in found if line.strip()]


def wait_for(text, shown):
    """Until the terminal has been drawn with this text."""
    end_s = time.monotonic() + 30.0
    while not any(text in line for line in screen(shown)):
        assert time.monotonic() < end_s, screen(shown)
        time.sleep(0.02)


def test_a_plain_line_every_ten_seconds(clock):
    with Display(console(), get_time=clock) as shown, doing("evaluating", 1000, "episodes") as task:
        for _ in range(4):
            clock.now_s += PLAIN_INTERVAL_S / 4
            task.advance(100)
        # 300 episodes in the 7.5 s since the first were counted
        assert lines(shown) == ["evaluating: 400 of 1,000 episodes, 40/s, 0:10, 0:15 left"]
        clock.now_s += PLAIN_INTERVAL_S - 0.1
        task.advance(1)
        assert len(lines(shown)) == 1
        clock.now_s += 0.1
        task.note = "success 5%"
        task.advance(1)
        assert lines(shown)[1:] == ["evaluating: 402 of 1,000 episodes, 17/s, 0:20, 0:35 left | success 5%"]


def test_what_was_done_before_does_not_count_as_fast(clock):
    with Display(console(), get_time=clock) as shown, doing("learning", 1000, "env steps") as task:
        task.advance(902)
        for _ in range(2):
            clock.now_s += 1875.0
            task.advance(25)
    assert lines(shown)[1:] == ["learning: 952 of 1,000 env steps, 0.013/s, 1:02:30, 1:00:00 left"]


def test_what_nobody_can_count_is_said_at_once():
    with Display(console()) as shown:
        with doing("loading", aloud=False):
            assert lines(shown) == []
        with doing("starting Ray"):
            assert lines(shown) == ["starting Ray ..."]
        assert list(track("abc", "letters", 3, "letters")) == ["a", "b", "c"]
        assert len(lines(shown)) == 1


def test_without_a_display_and_in_other_threads_nothing_is_shown():
    with doing("evaluating", 10) as task:
        task.advance()
    answer("unheard")
    with Display(console()) as shown:
        thread = threading.Thread(target=lambda: list(track(range(3), "x", 3, "x")) or doing("y").__enter__())
        thread.start()
        thread.join()
        assert lines(shown) == []


def test_quiet_shows_answers_only(clock, tmp_path):
    with (tmp_path / "stderr").open("w") as file:
        display = Display(Console(file=file, force_terminal=True), quiet=True, get_time=clock)
        with display as shown, doing("evaluating", 10) as task:
            clock.now_s += 60.0
            task.advance()
            shown.say("a line")
            with doing("starting Ray"):
                answer("stopping after this iteration")
        assert (tmp_path / "stderr").read_text() == "stopping after this iteration\n"


def test_a_terminal_is_left_as_if_there_had_been_nothing(clock):
    with Display(console(terminal=True), get_time=clock) as shown:
        with doing("evaluating [goals]", 100, "episodes") as task:
            task.note = "success 5%"
            for _ in range(2):
                clock.now_s += 2.0
                task.advance(19)
            answer("stopping after this iteration")
            with doing("drawing", 10, "pictures"):
                wait_for("0 of 10 pictures", shown)
            for text in ("evaluating [goals]", "38 of 100 episodes, 9.5/s, 0:04, 0:07 left", "success 5%"):
                wait_for(text, shown)
            wait_for("stopping after this iteration", shown)
        assert screen(shown) == []
        assert shown.console.file.getvalue().endswith("\x1b[?25h\r\x1b[1A\x1b[2K")  # the cursor is there again
        shown.say("a line")
        with doing("loading"):
            wait_for("loading", shown)
            assert not any("stopping" in line for line in screen(shown))
        assert screen(shown) == ["a line"]


class Failing(io.StringIO):
    """Raises at every write, as long as there is something to raise."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, text):
        if self.error is not None:
            raise self.error
        return super().write(text)


def test_a_reader_that_is_gone_ends_nothing():
    """As with ``tandem train 2>&1 | head -1``: rich would end the process."""
    with Display(Terminal(file=Failing(BrokenPipeError()))) as display:
        display.say("a line")
        display.say("another")
    assert display.console.quiet


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])  # a full disk, a terminal that is gone
@pytest.mark.parametrize("terminal", [False, True])
def test_what_cannot_be_written_is_left_out_and_ends_nothing(number, terminal):
    file = Failing(OSError(number, "cannot be written"))
    with Display(Terminal(file=file, force_terminal=terminal, width=100)) as display:
        with doing("learning", 10, "env steps") as task:
            display.say("lost")
            task.advance(1)
        file.error = None  # somebody has made room
        display.say("a line")
    assert file.getvalue() == "a line\n"
