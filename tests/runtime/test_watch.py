"""Which workers hang: those that count no further, however slow the others are."""

from types import SimpleNamespace

import pytest
from ray.exceptions import RayError

from service.runtime import watch
from service.runtime.watch import Watch


class Worker:
    """A worker that is asked at once, with a clock of its own."""

    def __init__(self, monkeypatch):
        self.now, self.count, self.answers, self.num_asked = 1000.0, 0, True, 0
        monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: self.now))
        ready = lambda references, timeout: (references, []) if self.answers else ([], references)  # noqa: E731
        monkeypatch.setattr(watch, "ray", SimpleNamespace(wait=ready, get=lambda reference: reference()))
        self.watch = Watch(self.ask)

    def ask(self):
        self.num_asked += 1
        count = self.count
        return lambda: count

    def call(self, seconds):
        self.watch.begin()
        self.now += seconds
        self.watch.end()

    def looks(self, seconds, *, counts=0.0):
        """Look five times a second for so long, while it counts so much a second; what the last look said."""
        begun = self.now
        while self.now < begun + seconds:
            self.now += 0.2
            self.count = int((self.now - begun) * counts)
            if (reason := self.watch.look()) is not None:
                return reason
        return None


@pytest.fixture
def worker(monkeypatch):
    return Worker(monkeypatch)


@pytest.mark.parametrize("answers", [True, False])
def test_one_that_counts_no_further_hangs_whether_it_answers_or_not(worker, answers):
    worker.call(0.5)
    worker.watch.begin()
    worker.answers = answers
    assert worker.looks(19.5) is None
    assert worker.looks(3.0) in {f"no progress for {seconds} s" for seconds in (20, 21, 22)}
    assert worker.watch.silent is not answers


def test_one_that_counts_slowly_is_left_alone(worker):
    worker.call(0.5)
    worker.watch.begin()
    assert worker.looks(300.0, counts=0.1) is None


def test_a_call_that_counts_for_ever_hangs_too(worker):
    worker.call(0.5)
    worker.watch.begin()
    assert worker.looks(700.0, counts=5.0) == "a call that usually takes 0.5 s has taken 600 s"


def test_the_bound_follows_its_own_calls_and_leaves_time_for_the_first(worker):
    assert worker.watch.bound_s == 120.0
    worker.call(1.0)
    assert worker.watch.bound_s == 20.0
    for _ in range(3):
        worker.call(3.0)
    assert worker.watch.bound_s == 30.0
    for _ in range(9):
        worker.call(60.0)
    assert worker.watch.bound_s == 40.0


def test_one_that_has_nothing_to_do_or_answers_soon_is_not_even_asked(worker):
    assert worker.looks(500.0) is None
    for _ in range(20):
        worker.watch.begin()
        assert worker.looks(0.6) is None
        worker.watch.end()
    assert worker.num_asked == 0


def test_time_in_which_nobody_looked_counts_for_nobody(worker):
    worker.call(0.5)
    worker.watch.begin()
    worker.looks(5.0)
    worker.now += 67.0
    worker.watch.forgive(67.0)
    assert worker.looks(10.0) is None
    assert worker.looks(10.0) is not None


def test_a_process_that_is_gone_is_left_to_its_call(worker, monkeypatch):
    def fail(reference):
        raise RayError

    worker.call(0.5)
    worker.watch.begin()
    monkeypatch.setattr(watch.ray, "get", fail)
    assert worker.looks(10.0) is None
