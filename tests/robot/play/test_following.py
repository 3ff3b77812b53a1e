"""A run that goes on, as those see it who watch: newer players, and how far it is."""

import threading
from contextlib import closing

import numpy as np
import pytest

from service.base.errors import StorageError
from service.robot.play import following
from service.robot.play.following import Following, goal_map, is_running
from service.robot.play.game import Game
from service.runs.train import train
from service.store.models import GoalCell, GoalGrid
from service.store.run_directory import RunDirectory
from tests.runs.runs import KilledError, tiny_config


@pytest.mark.usefixtures("default_signals")
def test_a_run_is_followed_from_checkpoint_to_checkpoint(tmp_path, monkeypatch):
    """The thread does no more than this by hand, again and again."""
    monkeypatch.setattr(Following, "_follow", lambda self: None)
    path, seen = tmp_path / "run", []

    def watch(metrics):
        if metrics["iteration"] == 1:
            seen.append(Following(path, tmp_path / "registry"))
        if metrics["iteration"] in (2, 4):
            assert is_running(path)
            seen[0].look()
            seen.append(seen[0].learning)
        if metrics["iteration"] == 4:
            raise KilledError

    config = tiny_config(checkpoint_interval=1, evaluation_interval=1, evaluation_episodes=2)
    with pytest.raises(KilledError):
        train(config, RunDirectory(path), tmp_path / "registry", publish=False, on_iteration=watch)
    followed, first, second = seen
    with closing(followed):
        for learning in (first, second):
            assert learning.total_env_steps == config.run.total_env_steps
            assert 0.0 <= learning.success <= 1.0
        assert first.players.digest != second.players.digest
        assert first.num_env_steps < second.num_env_steps
    with closing(Game(first.players)) as game:
        game.take(second.players)
        assert game.players is second.players
        assert game.primitives is second.players.policy
        assert game.alice is second.players.alice
        for _ in range(3):
            game.step()


def test_it_looks_again_and_again_also_after_a_look_that_failed(tmp_path, monkeypatch):
    looks, again = [], threading.Event()

    def look(self):
        looks.append(None)
        if len(looks) == 1:
            raise StorageError("a file that is replaced meanwhile")
        again.set()

    monkeypatch.setattr(following, "LOOK_S", 0.01)
    monkeypatch.setattr(Following, "look", look)
    with closing(Following(tmp_path, tmp_path)):
        assert again.wait(60.0)
    num = len(looks)
    assert not any(thread.name == "following" for thread in threading.enumerate())
    assert len(looks) == num


def test_a_place_that_is_no_run_is_none_that_goes_on(tmp_path):
    assert not is_running(tmp_path)
    assert not is_running(tmp_path / "gone")


def test_the_goal_map_is_the_workspace_from_above():
    def cell(x, y, z, rate):
        return GoalCell(center_m=(x, y, z), num_tries=1, success_rate=rate, learnability=rate * (1 - rate))

    grid = GoalGrid(
        iteration=1, num_env_steps=1, cell_size_m=0.1, shape=(3, 2, 2), num_cells=12,
        lower_m=(-0.1, -0.1, 0.0), upper_m=(0.2, 0.1, 0.2),
        cells=(cell(0.15, 0.05, 0.05, 1.0), cell(-0.05, -0.05, 0.05, 0.0), cell(-0.05, -0.05, 0.15, 1.0)),
    )  # fmt: skip
    assert goal_map(grid.model_copy(update={"cells": ()})) is None
    picture = goal_map(grid)
    assert picture.shape == (48, 32, 3)
    assert picture[0, 0].tolist() == [60, 160, 80]  # far and left: always solved
    assert picture[-1, -1].tolist() == [132, 110, 65]  # near and right: at half of the heights
    assert picture[0, -1].tolist() == picture[20, 5].tolist() == [225, 225, 225]
    assert np.array_equal(picture[:16, :16], np.broadcast_to(picture[0, 0], (16, 16, 3)))
