import pytest

import service
from benchmarks import downstream_throughput
from tests.downstream.trials import small_trial


@pytest.fixture(scope="module")
def trained():
    return service.load_primitives("panda-cube@champion", registry="no registry here")


def test_the_worker_learns_while_it_is_measured(trained, monkeypatch):
    steps = []
    step = downstream_throughput.make_loop.__globals__["SACLearner"]._step
    monkeypatch.setattr(
        downstream_throughput.make_loop.__globals__["SACLearner"],
        "_step",
        lambda learner, *rows: steps.append(len(rows[0])) or step(learner, *rows),
    )
    play = downstream_throughput.make_worker(small_trial(), trained, 1)
    steps.clear()
    assert play() == 200  # an episode of each of four worlds
    assert steps == [16] * (2 * 50)
