import pytest

import service
from benchmarks import downstream_throughput
from tests.downstream.trials import small_trial


def test_both_learn_while_they_are_measured(monkeypatch):
    monkeypatch.setattr(downstream_throughput, "_DEFAULT_STEPS", 4)
    monkeypatch.setattr(downstream_throughput, "_DEFAULT_WARM_UP", 102)
    trained = service.load_primitives("panda-cube@champion", registry="no registry here")
    updates = []
    train = downstream_throughput.SAC.train

    def counted(learner, gradient_steps, batch_size):
        updates.append((learner.n_envs, gradient_steps, batch_size))
        train(learner, gradient_steps, batch_size)

    monkeypatch.setattr(downstream_throughput.SAC, "train", counted)
    result = downstream_throughput.compare(
        small_trial(), trained, downstream_throughput.Settings(num_pairs=1, seconds=0.01, threads=1)
    )
    worker, default = (result["rows"][name] for name in (downstream_throughput.WORKER, downstream_throughput.DEFAULT))
    assert worker["num_steps"] == 200  # an episode of each of four worlds
    assert default["num_steps"] == 4
    assert updates.count((1, 1, 256)) == 2 + 4  # of the warm-up, and of the measurement: one update a step
    assert updates.count((4, 2, 16)) == 2 * 50
    assert result["ratio"]["median"] == pytest.approx(worker["env_steps_per_s"] / default["env_steps_per_s"])
