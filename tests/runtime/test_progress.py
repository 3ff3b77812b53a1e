"""What a person sees of a run while it goes, and where its time went afterwards."""

import io
import time

import pytest
from rich.console import Console

from service.progress import PLAIN_INTERVAL_S, Display
from service.runtime.progress import Progress, StudyProgress
from service.runtime.timing import Timing


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


def plain(total_env_steps=1000):
    console = Console(file=io.StringIO(), force_terminal=False, width=60)
    return Progress(total_env_steps, Display(console)), console.file


def metrics(env_steps, **values):
    return {"iteration": 1, "env_steps": env_steps} | {name.replace("__", "/"): value for name, value in values.items()}


def test_a_plain_line_now_and_then(clock):
    progress, out = plain()
    with progress:
        assert out.getvalue() == ""
        for env_steps in (100, 200, 300):
            progress.show(metrics(env_steps))
            clock.now_s += 0.6 * PLAIN_INTERVAL_S
    lines = out.getvalue().splitlines()
    assert [int(line.split()[0]) for line in lines] == [100, 300]  # 200 came too soon


def test_the_last_line_is_always_printed(clock):
    progress, out = plain(total_env_steps=250)
    for env_steps in (100, 200, 300):
        progress.show(metrics(env_steps))
    assert [line.split()[0] for line in out.getvalue().splitlines()] == ["100", "300"]


def test_a_line_is_one_line_and_has_no_colours(clock):
    progress, out = plain()
    values = {"alice__valid_fraction": 0.25, "bob__success_rate": 0.5, "time__env_steps_per_s": 12345.6}
    progress.show(metrics(100, **values, evaluation__table_success_last=1.0, learner__bob_kl=0.1))
    (line,) = out.getvalue().splitlines()
    assert "\x1b" not in line
    assert "100 env steps" in line
    for part in ("valid_fraction 25%", "success_rate 50%", "table_success_last 100%", "12,346 env steps/s"):
        assert part in line
    assert "bob_kl" not in line


def test_rates_are_smoothed_and_evaluations_are_not(clock):
    progress, out = plain()
    progress.show(metrics(1, bob__success_rate=0.0, evaluation__air_success_last=0.0))
    progress.show(metrics(2))  # nothing to show: the values stay
    progress.show(metrics(1000, bob__success_rate=1.0, evaluation__air_success_last=1.0))
    last = out.getvalue().splitlines()[-1]
    assert " success_rate 20%" in last  # 0.8 x 0 + 0.2 x 1
    assert "air_success_last 100%" in last


def test_a_table_on_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with Progress(1000, Display(console)) as progress:
        progress.show(metrics(500, alice__valid_fraction=0.42))
    text = console.file.getvalue()
    assert "500 of 1,000 env steps" in text
    assert "42%" in text
    assert "Bob: random table goals" in text


def test_lines_of_a_study_name_the_seed_and_tell_no_run_twice(clock):
    console = Console(file=io.StringIO(), force_terminal=False, width=60)
    with StudyProgress(1000, Display(console)) as progress:
        progress.show({3: "starting", 8: None})
        progress.take(3, metrics(100, bob__success_rate=0.5) | {"alice/valid_fraction": None})
        progress.show({3: "running", 8: None})  # the first line comes at once
        progress.take(3, metrics(200))
        progress.show({3: "running", 8: None})  # too soon
        clock.now_s += PLAIN_INTERVAL_S
        progress.take(8, metrics(70))
        progress.show({3: "running", 8: "running"})
        clock.now_s += PLAIN_INTERVAL_S
        progress.show({3: "running", 8: "running"})  # nothing new
    lines = [line.split(" env steps")[0].split() for line in console.file.getvalue().splitlines()]
    assert lines == [["seed", "3:", "100"], ["seed", "3:", "200"], ["seed", "8:", "70"]]


def test_a_study_on_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    with StudyProgress(1000, Display(console)) as progress:
        progress.take(3, metrics(500, alice__valid_fraction=0.42, time__env_steps_per_s=1234.0))
        progress.show({3: "running", 8: None})
    text = console.file.getvalue()
    for part in ("seed", "running", "waiting", "42%", "1,234", "1,000 env steps"):
        assert part in text


def test_a_table_fits_a_narrow_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=40)
    with Progress(1000, Display(console)) as progress:
        progress.show(metrics(2000, bob__success_rate=0.5))
    assert "2,000 of 1,000" in console.file.getvalue()


def test_the_terminal_is_given_back_after_an_error():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    progress = Progress(1000, Display(console))
    progress.show(metrics(100))
    with pytest.raises(RuntimeError), progress:
        raise RuntimeError
    assert console.file.getvalue().rindex("\x1b[?25h") > console.file.getvalue().rindex("\x1b[?25l")  # the cursor


def test_timing_is_a_tree_that_adds_up(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    timing = Timing()
    for name, seconds in (("play", 2.0), ("learn", 1.0), ("play", 4.0)):
        with timing(name):
            clock.now_s += seconds
    clock.now_s += 1.0
    assert timing.seconds == {"play": 6.0, "learn": 1.0}
    rows = [line.split() for line in timing.tree().splitlines()]
    assert rows == [
        ["total", "8.0", "s"],
        ["play", "6.0", "s", "75.0", "%"],
        ["learn", "1.0", "s", "12.5", "%"],
        ["other", "1.0", "s", "12.5", "%"],
    ]


def test_timing_counts_what_failed(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    timing = Timing()

    def fail():
        clock.now_s += 3.0
        raise RuntimeError

    with pytest.raises(RuntimeError), timing("play"):
        fail()
    assert timing.seconds["play"] == 3.0


def test_timing_columns_line_up():
    timing = Timing()
    for name in ("play", "wait for learner"):
        with timing(name):
            pass
    rows = timing.tree().splitlines()[1:]
    assert len({row.index(" s ") for row in rows}) == 1
