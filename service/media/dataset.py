"""Recorded episodes and rounds as a Minari data set, for learners that learn from what was played."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.base.errors import TandemError, needs_extra
from service.base.files import os_errors
from service.base.progress import track
from service.base.types import FloatArray, StateArray
from service.base.version import __version__
from service.config import Config
from service.config.self_play import SelfPlayConfig
from service.envs.batch import WorldBatch
from service.envs.gym.tabletop import FURTHEST_M, action_space, goal_space
from service.envs.observations import distances
from service.envs.scene import build_layout
from service.media.recording import RecordedEpisodes, RecordedRound

_NAME = re.compile(r"(?![\w-]/[\w-]+$)(?:[\w-]+/)*[\w-]+-v[0-9]+")  # what Minari takes


@dataclass(frozen=True, slots=True)
class Played:
    """What one player did for T steps."""

    states: StateArray
    """(T + 1, S) rows of ``WorldBatch.states``."""
    actions: FloatArray
    """(T, 4)."""
    goal: StateArray
    """(3 K,) metres."""
    is_alice: bool = False


def played_episodes(recorded: RecordedEpisodes) -> list[Played]:
    """Bob's episodes, from a recording that has their actions and goals."""
    assert recorded.actions is not None
    assert recorded.goal is not None
    return [
        Played(recorded.states[:, index], recorded.actions[:, index], goal)
        for index, goal in enumerate(recorded.goal)
    ]  # fmt: skip


def played_turns(rounds: Sequence[RecordedRound]) -> list[Played]:
    """Alice's turns, each with where she left the object as its goal, and Bob's turns; without those of no step."""
    turns = []
    for each in rounds:
        if len(each.alice_actions):
            turns.append(Played(each.alice_states, each.alice_actions, each.goal, is_alice=True))
        if len(each.bob_actions):
            turns.append(Played(each.bob_states, each.bob_actions, each.goal))
    return turns


def check_name(name: str) -> str:
    """The identifier of a new data set: ``name``, with ``-v0`` where it says no version.

    Raises:
        TandemError: no name, or that of a data set that is there; or Minari is not installed.
    """
    full = name if re.search(r"-v[0-9]+$", name) else f"{name}-v0"
    if not _NAME.fullmatch(full):
        raise TandemError(
            f"--out {name!r}: write NAME, GROUP/NAME or NAME-v1, of letters, digits and dashes; a GROUP has two or more"
        )
    if (place := _place(full)).exists():
        raise TandemError(f"--out {name}: the data set {full} is there already, in {place}: choose another name")
    return full


def write_dataset(
    name: str, played: Sequence[Played], config: Config, label: str, *, success_distance_m: float
) -> Path:
    """Write a Minari data set into the directory MINARI_DATASETS_PATH, or Minari's own; each turn is an episode.

    Observations are those of ``TabletopEnv``: ``observation`` (T + 1, P), ``achieved_goal`` and ``desired_goal``
    (T + 1, 3 K). Rewards (T) are 1 where each object is within the success distance after a step, else 0;
    ``infos["is_success"]`` (T + 1) is the same with the start, ``infos["is_alice"]`` says whose turn it was. All end
    by time.

    Args:
        name: see ``check_name``.
        played: at least one.
        config: of the run that the players come from.
        label: where they come from, such as ``panda-cube@3``.
        success_distance_m: greatest distance that is paid.

    Returns:
        The data set's directory.

    Raises:
        TandemError: a name that is none or taken, or a place that cannot be written; or Minari is not installed.
    """
    full = check_name(name)
    place = _place(full)
    with needs_extra("data", "tandem dataset"):
        import minari

    description = {"players": label, "success_distance_m": success_distance_m}
    about = {**description, "world": config.world.model_dump(mode="json")}
    try:
        with os_errors("write", place), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it asks for an author, and for more that is not known here
            minari.create_dataset_from_buffers(
                full,
                list(_buffers(played, config, success_distance_m)),
                observation_space=goal_space(config.world),
                action_space=action_space(),
                algorithm_name="tandem",
                description=json.dumps(about),
                requirements=[f"tandem-skills=={__version__}"],
                data_format="hdf5",
            )
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)  # half a data set looks like a whole one
        raise
    return place


def _buffers(played: Sequence[Played], config: Config, success_distance_m: float) -> Iterator[object]:
    from minari.data_collector import EpisodeBuffer

    longest = max(len(each.states) for each in played)
    blocked, usual = 0.0, build_layout(config.world).size
    if isinstance(config, SelfPlayConfig) and played[0].states.shape[1] > usual:  # of self-play, with a column more
        blocked = config.game.blocked_gripper_fraction
    with WorldBatch(config.world, longest, num_threads=1, blocked_fraction=blocked) as worlds:
        for each in track(played, "writing the data set", len(played), "episodes"):
            yield EpisodeBuffer(**_arrays(each, worlds, success_distance_m))


def _arrays(played: Played, worlds: WorldBatch, success_distance_m: float) -> dict[str, object]:
    """An episode as ``EpisodeBuffer`` has it; what was seen follows from the states."""
    num_steps, num = len(played.actions), len(played.states)
    worlds.restore(played.states, np.arange(worlds.num_worlds) < num)
    achieved = np.clip(worlds.object_position[:num], -FURTHEST_M, FURTHEST_M)
    success = np.all(distances(achieved, played.goal) <= success_distance_m, axis=1)
    return {
        "observations": {
            "observation": np.clip(worlds.positions()[:num], -FURTHEST_M, FURTHEST_M),
            "achieved_goal": achieved.astype(np.float32),
            "desired_goal": np.tile(played.goal.astype(np.float32), (num_steps + 1, 1)),
        },
        "actions": np.clip(played.actions, -1.0, 1.0).astype(np.float32),
        "rewards": success[1:].astype(np.float64),
        "terminations": np.zeros(num_steps, dtype=bool),
        "truncations": np.arange(num_steps) == num_steps - 1,
        "infos": {"is_success": success, "is_alice": np.full(num_steps + 1, played.is_alice)},
    }


def _place(full: str) -> Path:
    with needs_extra("data", "tandem dataset"):
        import h5py  # noqa: F401 - Minari would miss it only when it writes, after all was played
        from minari import storage
    with os_errors("write", Path(full)):
        return Path(storage.get_dataset_path(full))
