import pytest

import service
from benchmarks import downstream_throughput
from benchmarks.measuring import ROOT
from service.errors import TandemError
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


def test_the_default_learns_while_it_is_measured(trained, monkeypatch):
    monkeypatch.setattr(downstream_throughput, "_DEFAULT_STEPS", 4)
    monkeypatch.setattr(downstream_throughput, "_DEFAULT_WARM_UP", 102)
    updates = []
    train = downstream_throughput.SAC.train

    def counted(learner, gradient_steps, batch_size):
        updates.append((learner.n_envs, gradient_steps, batch_size))
        train(learner, gradient_steps, batch_size)

    monkeypatch.setattr(downstream_throughput.SAC, "train", counted)
    play = downstream_throughput.make_default(small_trial(), trained)
    assert updates == [(1, 1, 256)] * 2  # one update a step, after 100 of them
    assert play() == 4
    assert updates == [(1, 1, 256)] * 6


def test_a_process_that_fails_says_why(tmp_path):
    settings = downstream_throughput.Settings(primitives="nobody@champion", seconds=0.01)
    with pytest.raises(TandemError, match=r"worker in .*nobody"):
        downstream_throughput.measure_tree(ROOT, "worker", settings, tmp_path)
