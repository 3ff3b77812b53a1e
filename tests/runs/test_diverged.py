"""A policy or a world that diverges in the middle of a run: what is said, what is kept, and how it goes on."""

from itertools import count

import numpy as np
import pytest
import torch

from service.base.errors import DivergedError
from service.methods.workers import RolloutWorker
from service.policies.numpy_policy import NumpyGaussianPolicy
from service.runs.resuming import resumed_config
from service.runs.train import open_run
from service.store.run_directory import RunDirectory
from tests.cli.typed import tandem
from tests.runs.runs import assert_one_line, assert_same_run, newest, play, read_lines, tiny_config, write_yaml


class NotANumber(NumpyGaussianPolicy):
    """Acts as it should, except in the last of its worlds."""

    def act(self, observation, rng):
        action, log_prob = super().act(observation, rng)
        action[-1] = np.nan
        return action, log_prob


def diverge_after(patch, iteration):
    """Alice's policy is no good from the iteration behind this one."""
    players, rounds = RolloutWorker._players, count()

    def spoiled(self, *given):
        if next(rounds) >= iteration:
            patch.setattr("service.methods.workers.NumpyGaussianPolicy", NotANumber)
        return players(self, *given)

    patch.setattr(RolloutWorker, "_players", spoiled)


def test_a_policy_that_diverges_is_one_line_that_says_how_to_go_on(uninterrupted, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        diverge_after(patch, iteration=3)
        with pytest.raises(DivergedError) as error:
            play(tmp_path)
    rates = "--set learner.alice.learning_rate=0.00015 --set learner.bob.learning_rate=0.00015"
    assert_one_line(error.value, tmp_path, "iteration 4", "of 24 worlds", "diverged", f"--resume {rates}")
    assert "delete" not in str(error.value)
    assert [row["iteration"] for row in read_lines(tmp_path / "metrics.jsonl")] == [1, 2, 3]
    assert newest(tmp_path).step == 2
    play(tmp_path, resume=True)
    assert_same_run(tmp_path, uninterrupted)


def test_a_checkpoint_that_has_the_policy_already_is_named(tmp_path, monkeypatch):
    diverge_after(monkeypatch, iteration=4)
    with pytest.raises(DivergedError) as error:
        play(tmp_path)
    assert_one_line(error.value, "iteration 5", "delete checkpoint-e00000001-00000004.safetensors", "--resume")
    assert newest(tmp_path).step == 4


def test_parameters_that_are_not_numbers_are_the_same_error(tmp_path):
    """The learner undoes such updates; a broken memory would do it."""

    def spoil(run, metrics):
        if run.iteration == 3:
            with torch.no_grad():
                run.method.learner._bob.policy_parameters[0].view(-1)[0] = torch.nan

    with pytest.raises(DivergedError) as error:
        play(tmp_path, on_iteration=spoil)
    assert_one_line(error.value, "iteration 4", "not finite", "--resume --set learner.alice.learning_rate=")


def test_the_command_ends_with_that_line_and_exit_code_1(tmp_path, monkeypatch):
    diverge_after(monkeypatch, iteration=1)
    result = tandem("pretrain", "--config", write_yaml(tmp_path / "tiny.yaml"), "--run-dir", tmp_path / "run")
    assert result.exit_code == 1
    assert_one_line(result.stderr.splitlines()[-1], "error: ", tmp_path / "run", "iteration 2", "--resume")


def test_a_resumed_run_takes_a_lower_learning_rate(tmp_path):
    play(tmp_path, kill_after=3)
    before = newest(tmp_path).arrays["learner/bob/learning_rate"]
    config = resumed_config(RunDirectory(tmp_path), ["learner.bob.learning_rate=1e-6"])
    run = open_run(config, RunDirectory(tmp_path), resume=True)
    assert before > 1e-5
    in_proportion = min(before * 1e-6 / tiny_config().learner.bob.learning_rate, 2e-6)  # it adapts up to 2e-6
    assert run.method.learner._bob.optimizer.learning_rate == pytest.approx(in_proportion)
    assert run.method.learner._alice.optimizer.learning_rate == newest(tmp_path).arrays["learner/alice/learning_rate"]
    assert RunDirectory(tmp_path).read_config().learner.bob.learning_rate == 1e-6
    assert run.run() == "finished"
    assert newest(tmp_path).arrays["learner/bob/learning_rate"] <= 2e-6


def test_a_world_that_breaks_is_said_recorded_and_starts_anew(tmp_path, caplog):
    """The object of one world flies off at 1e200 rad/s, in real physics."""

    def spin(run, metrics):
        if run.iteration == 2:
            states = run.method.game.worlds.states.copy()
            states[5, 29] = 1e200
            run.method.game.worlds.restore(states)

    run, result = play(tmp_path, on_iteration=spin)
    assert result.reason == "finished"
    assert np.isfinite(run.method.game.worlds.states).all()
    assert np.abs(run.method.game.worlds.states).max() < 1e3
    diverged = [row["world/num_broken"] for row in read_lines(tmp_path / "metrics.jsonl")]
    assert diverged == [0.0, 0.0, 1.0] + [0.0] * (len(diverged) - 3)
    (file,) = (tmp_path / "broken").iterdir()
    assert_one_line(caplog.messages[0], "physics diverged", file)
    with np.load(file) as dump:
        assert dump["states"].shape[1:] == (run.method.game.worlds.layout.size,)
        assert dump["actions"].shape[1:] == (4,)
        assert len(dump["states"]) == len(dump["actions"]) == 1
    state = run.method.learner.state()
    assert all(np.isfinite(array).all() for array in state.values() if array.dtype.kind == "f")
