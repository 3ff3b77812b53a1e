"""Which workers hang: those that count no further while the driver looks, however slow the others are."""

from threading import Event
from types import SimpleNamespace

import pytest
from ray.exceptions import RayError

from service.cluster import watch
from service.cluster.watch import FIRST_S, LOOK_S, STALL_S, Clock, RayletWatch, Watch


class Worker:
    """A worker, and a driver that looks after it; both have the same clock, which stands still by itself."""

    def __init__(self, monkeypatch):
        self.now, self.count, self.answers, self.num_asked = 1000.0, 0, True, 0
        monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: self.now))
        ready = lambda references, timeout: (references, []) if self.answers else ([], references)  # noqa: E731
        monkeypatch.setattr(watch, "ray", SimpleNamespace(wait=ready, get=lambda reference: reference()))
        self.clock = Clock()
        self.watch = Watch("learner", 0, SimpleNamespace(progress=SimpleNamespace(remote=self.ask)), self.clock)

    def ask(self):
        self.num_asked += 1
        count = int(self.count)
        return lambda: count

    def call(self):
        """A call, after which it has loaded its libraries."""
        self.watch.begin()
        self.looks(0.5, counts=10.0)
        self.watch.end()

    def passes(self, num, seconds, *, counts=0.0):
        """The driver passes so often, each time after so many seconds, in which the worker counts so much a second.

        Returns:
            What the last look said.
        """
        for _ in range(num):
            self.now += seconds
            self.count += seconds * counts
            self.clock.look()
            if (reason := self.watch.look()) is not None:
                return reason
        return None

    def looks(self, seconds, *, counts=0.0):
        """The driver looks five times a second for so long."""
        return self.passes(round(seconds / 0.2), 0.2, counts=counts)


@pytest.fixture
def worker(monkeypatch):
    return Worker(monkeypatch)


@pytest.mark.parametrize("answers", [True, False])
def test_one_that_counts_no_further_hangs_whether_it_answers_or_not(worker, answers):
    worker.call()
    worker.watch.begin()
    worker.answers = answers
    assert worker.looks(STALL_S - 0.5) is None
    assert worker.looks(4.0) in {f"no progress for {seconds} s" for seconds in (30, 31, 32)}


@pytest.mark.parametrize("per_s", [0.1, 5.0])
def test_one_that_counts_is_left_alone_however_slowly_and_however_long(worker, per_s):
    """As in an evaluation of 20,000 episodes, which takes an hour where a round takes a second."""
    worker.call()
    worker.watch.begin()
    assert worker.looks(3600.0, counts=per_s) is None


def test_the_first_call_may_stand_still_for_longer(worker):
    worker.watch.begin()
    assert worker.looks(FIRST_S - 1.0) is None
    assert worker.looks(5.0) is not None


def test_one_that_has_nothing_to_do_or_answers_soon_is_not_even_asked(worker):
    assert worker.looks(500.0) is None
    for _ in range(20):
        worker.watch.begin()
        assert worker.looks(0.6) is None
        worker.watch.end()
    assert worker.num_asked == 0


@pytest.mark.parametrize("pause_s", [26.0, 30.0, 3600.0])
def test_time_in_which_the_driver_does_not_look_counts_for_nobody(worker, pause_s):
    """It was frozen with everybody else, waited for another worker to start, or for a disk: that is one look."""
    worker.call()
    worker.watch.begin()
    assert worker.looks(5.0) is None
    assert worker.passes(1, pause_s) is None
    assert worker.looks(STALL_S - 5.0 - LOOK_S - 0.5) is None
    assert worker.looks(4.0) is not None


def test_a_driver_that_is_slow_takes_longer_to_call_a_worker_hung(worker):
    """Each of its passes takes 5 s on a busy machine: 29 of them are no 30 s of looking."""
    worker.call()
    worker.watch.begin()
    assert worker.passes(29, 5.0) is None
    assert worker.passes(5, 5.0) is not None


def test_one_that_was_frozen_for_less_than_that_is_left_alone(worker):
    worker.call()
    worker.watch.begin()
    for _ in range(10):
        worker.answers = False
        assert worker.looks(25.0) is None
        worker.answers = True
        assert worker.looks(5.0, counts=10.0) is None


def test_a_call_begins_anew_with_the_next_one(worker):
    worker.watch.begin()
    worker.watch.begin()
    worker.looks(7.0, counts=10.0)
    assert worker.watch.call_s == pytest.approx(7.0)
    worker.watch.end()
    assert worker.watch.call_s == 0.0


def test_a_process_that_is_gone_is_left_to_its_call(worker, monkeypatch):
    def fail(reference):
        raise RayError

    worker.call()
    worker.watch.begin()
    monkeypatch.setattr(watch.ray, "get", fail)
    assert worker.looks(10.0) is None


class Raylet:
    """It answers so often, and then never again; each look at it takes half a second of its clock."""

    def __init__(self, monkeypatch, num_answers):
        self.now, self.num_answers, self.last_s = 0.0, num_answers, 0.0
        context = SimpleNamespace(get_node_id=lambda: "here")
        here = {"NodeID": "here", "NodeManagerAddress": "127.0.0.1", "NodeManagerPort": 1}
        monkeypatch.setattr(watch, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(watch, "ray", SimpleNamespace(get_runtime_context=lambda: context, nodes=lambda: [here]))
        monkeypatch.setattr(watch, "init_grpc_channel", lambda address: self)
        monkeypatch.setattr(watch, "ASK_S", 0.0)

    def unary_unary(self, method):
        return SimpleNamespace(future=lambda request: SimpleNamespace(done=self.done, exception=lambda: None))

    def done(self):
        self.now += 0.5
        if self.num_answers == 0:
            return False
        self.num_answers -= 1
        self.last_s = self.now
        return True

    def close(self):
        pass


def test_a_raylet_that_answers_no_more_is_named_within_a_minute(monkeypatch):
    raylet, lost, named = Raylet(monkeypatch, num_answers=200), [], Event()
    with RayletWatch(lambda line: (lost.append((line, raylet.now - raylet.last_s)), named.set())):
        assert named.wait(60.0)
    ((line, silent_s),) = lost
    assert "the raylet, has not answered for 40 s" in line
    assert 30.0 < silent_s <= 60.0
