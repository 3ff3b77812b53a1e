"""Progress of what takes long: when it is shown, what it says, and that nothing is left of it."""

import io
import re
import threading
import time

import pytest
from rich.console import Console

from service.progress import PLAIN_INTERVAL_S, SHOWN_AFTER_S, Display, answer, counted, doing, minutes, tick

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Clock:
    """Seconds that pass when told to."""

    now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    return clock


def console(*, terminal=False):
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, _environ={})


def lines(shown):
    return shown.console.file.getvalue().splitlines()


def test_plain_lines_begin_after_two_seconds_and_are_rare(clock):
    with Display(console()) as shown, doing("evaluating", 1000, "episodes") as task:
        clock.now_s += SHOWN_AFTER_S - 0.1
        task.advance(100)
        assert lines(shown) == []
        clock.now_s += 2.1
        task.advance(100)
        assert lines(shown) == ["evaluating: 200 of 1,000 episodes, 50/s, 0:04, 0:16 left"]
        clock.now_s += PLAIN_INTERVAL_S - 1.0
        task.advance(1)
        assert len(lines(shown)) == 1
        clock.now_s += 1.0
        task.note = "success 5%"
        task.advance(1)
        assert lines(shown)[1:] == ["evaluating: 202 of 1,000 episodes, 14/s, 0:14, 0:55 left | success 5%"]


def test_what_was_done_before_does_not_count_as_fast(clock):
    with Display(console()), doing("learning", 1000, "env steps", done=900) as task:
        clock.now_s += 10.0
        task.advance(50)
        assert task.text() == "950 of 1,000 env steps, 5/s, 0:10, 0:10 left"


def test_what_nobody_can_count_is_said_at_once():
    with Display(console()) as shown:
        with doing("starting Ray"):
            assert lines(shown) == ["starting Ray ..."]
        assert list(counted("abc", "letters", 3, "letters")) == ["a", "b", "c"]
        assert len(lines(shown)) == 1


def test_without_a_display_and_in_other_threads_nothing_is_shown():
    with doing("evaluating", 10) as task:
        task.advance()
    answer("unheard")
    tick()
    with Display(console()) as shown:
        thread = threading.Thread(target=lambda: list(counted(range(3), "x", 3, "x")) or doing("y").__enter__())
        thread.start()
        thread.join()
        assert lines(shown) == []


def test_quiet_shows_answers_only(clock, tmp_path):
    with (tmp_path / "stderr").open("w") as file:
        with Display(Console(file=file, force_terminal=True), quiet=True) as shown, doing("evaluating", 10) as task:
            clock.now_s += 60.0
            task.advance()
            shown.say("a line")
            with doing("starting Ray"):
                shown.show("a table")
                shown.keep()
            answer("stopping after this iteration")
        assert (tmp_path / "stderr").read_text() == "stopping after this iteration\n"


def test_a_terminal_is_left_as_if_there_had_been_nothing(clock):
    with Display(console(terminal=True)) as shown:
        with doing("evaluating", 100, "episodes") as task:
            task.advance()
            assert lines(shown) == []
            clock.now_s += 3.0
            task.advance(9)
            answer("stopping after this iteration")
            shown._live.refresh()
            drawn = ESCAPE.sub("", shown.console.file.getvalue())
            assert "evaluating" in drawn
            assert "10 of 100 episodes, 3.3/s, 0:03, 0:27 left" in drawn
            assert "stopping after this iteration" in drawn
        assert shown._live is None
        written = shown.console.file.getvalue()
        after = written[written.rindex("iteration") :]
        assert "\r\x1b[2K\x1b[1A\x1b[2K" in after  # both lines are erased
        assert "\x1b[?25h" in after  # the cursor is there again
        shown.console.file.truncate(0)
        with doing("evaluating", 100, "episodes") as task:
            task.advance()
        assert "episodes" not in shown.console.file.getvalue()


def test_a_table_stays_and_tasks_move_below_it(clock):
    with Display(console(terminal=True)) as shown:
        shown.show("the table")
        with doing("drawing the video", 10, "pictures") as task:
            clock.now_s += 3.0
            task.advance()
            shown._live.refresh()
            drawn = ESCAPE.sub("", shown.console.file.getvalue()).rstrip()
            assert drawn.rindex("the table") < drawn.rindex("drawing the video")
        assert shown._live is not None
        shown.keep()
        assert shown._live is None
        assert lines(shown)[-1] == "the table"


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0:00"), (7, "0:07"), (754, "12:34"), (3723, "1:02:03"), (-1, "0:00")]
)
def test_durations(seconds, text):
    assert minutes(seconds) == text
