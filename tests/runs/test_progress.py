"""What a person sees of a run while it goes, and where its time went afterwards."""

import io
import time
from contextlib import closing
from functools import partial

import pytest
from rich.console import Console

from service.base.progress import PLAIN_INTERVAL_S, Display
from service.methods.method import Timing
from service.runs.progress import Progress
from tests.clock import Clock


@pytest.fixture
def clock():
    return Clock()


def shown(clock, *, total_env_steps=1000, terminal=False, width=300):
    console = Console(file=io.StringIO(), force_terminal=terminal, width=width)
    progress = Progress(Display(console, get_time=clock))
    return progress, console.file, partial(progress.show, total=total_env_steps)


def metrics(env_steps, **values):
    return {"iteration": 1, "env_steps": env_steps} | {name.replace("__", "/"): value for name, value in values.items()}


def test_a_plain_line_now_and_then_and_the_last_one(clock):
    _, out, show = shown(clock, total_env_steps=500)
    for env_steps in (100, 200, 300, 400, 500, 600):
        show(metrics(env_steps))
        clock.now_s += 0.6 * PLAIN_INTERVAL_S
    # 200 and 400 came too soon; 500 is the end, and 600 is past it
    assert out.getvalue().splitlines() == [
        "learning: 300 of 500 env steps, 17/s, 0:12, 0:12 left",
        "learning: 500 of 500 env steps, 17/s, 0:24, 0:00 left",
    ]


def test_a_line_is_one_line_and_has_no_colours(clock):
    _, out, show = shown(clock, width=60)
    values = {"alice__valid_fraction": 0.25, "bob__success_rate": 0.5, "time__env_steps_per_s": 12345.6}
    show(metrics(1000, **values, evaluation__table_success_last=1.0, learner__bob_kl=0.1))
    (line,) = out.getvalue().splitlines()
    assert line.endswith("0:00 left | valid_fraction 25% | success_rate 50% | table_success_last 100%")


def test_rates_are_smoothed_and_evaluations_are_not(clock):
    _, out, show = shown(clock)
    show(metrics(1, bob__success_rate=0.0, evaluation__air_success_last=0.0))
    show(metrics(2) | {"bob/success_rate": None})  # nothing to show: the values stay
    show(metrics(1000, bob__success_rate=1.0, evaluation__air_success_last=1.0))
    (last,) = out.getvalue().splitlines()
    assert last.endswith("success_rate 20% | air_success_last 100%")  # 0.8 x 0 + 0.2 x 1


def test_what_a_resumed_run_had_before_does_not_count_as_fast(clock):
    _, out, show = shown(clock)
    for env_steps in (900, 920, 940):
        clock.now_s += 10.0
        show(metrics(env_steps))
    assert out.getvalue().splitlines()[-1] == "learning: 940 of 1,000 env steps, 2/s, 0:20, 0:30 left"


def test_lines_of_a_study_name_the_seed_and_tell_no_run_twice(clock):
    progress, out, show = shown(clock)
    with closing(progress):
        for seed, env_steps in ((3, 100), (8, 70), (3, 200), (8, 80)):
            show(metrics(env_steps), title=f"seed {seed}")
            clock.now_s += 0.6 * PLAIN_INTERVAL_S
        assert [line.split(" of")[0] for line in out.getvalue().splitlines()] == ["seed 3: 200", "seed 8: 80"]


def test_a_bar_moves_on_a_terminal_and_its_last_line_stays(clock):
    progress, out, show = shown(clock, terminal=True, width=40)
    with closing(progress):
        show(metrics(500, alice__valid_fraction=0.42))
    assert "\x1b[?25l" in out.getvalue()
    after = out.getvalue().rpartition("\x1b[?25h")[2]  # the cursor is given back
    assert after.splitlines()[-1] == "learning: 500 of 1,000 env steps, 0:00 | valid_fraction 42%"


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
