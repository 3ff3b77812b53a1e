"""Env steps per second on one core: our world against PyBullet panda-gym, measured in turn in one process.

    python -m benchmarks.env_throughput --json docs/results/env_throughput.json

Both sides do the same: episodes of 50 random actions with their resets, 20 physics steps of 2 ms an action, the
observation and the test for success of every step. Random arms rarely meet the object, and contact is dear, so each
side also plays episodes that reach for the object and squeeze it. panda-gym steps one world with one thread, so ours
gets one thread, too. What our batch gains over our own Gymnasium environment is one call for all worlds.
Two cubes are compared with one; who grasps goes for the first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import describe_ratio, measure_in_turn, rates, rates_table, ratio, run_benchmark
from service.base.errors import TandemError
from service.config import WorldConfig
from service.envs.batch import DISPLACEMENT_M, WorldBatch
from service.envs.gym.registration import TABLETOP_ID
from service.envs.observations import ACTION, distances
from service.envs.sampling import sample_goals

EPISODE_STEPS = 50
"""Length of an episode in panda-gym's registration, and in ours."""
PICK_AND_PLACE, PUSH = PANDA_GYM_IDS = ("PandaPickAndPlace-v3", "PandaPush-v3")
BATCH = "tandem"
ONE_WORLD = "tandem, one world, Gymnasium"
TWO_CUBES = "tandem, two cubes"
GRASPING = ", grasping"
"""Ends the name of a row that reaches for the object and squeezes it."""
COMPARED = (
    (BATCH, PICK_AND_PLACE),
    (BATCH, PUSH),
    (BATCH + GRASPING, PICK_AND_PLACE + GRASPING),
    (ONE_WORLD, PICK_AND_PLACE),
    (ONE_WORLD, PUSH),
    (TWO_CUBES, BATCH),
    (TWO_CUBES + GRASPING, BATCH + GRASPING),
)
_SUCCESS_M = 0.05
_OPEN_STEPS = 8
"""After which a grasping arm closes its gripper."""

FloatArray = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Settings:
    """Amount of what is measured."""

    num_pairs: int = 5
    seconds: float = 2.0
    """Length of each measurement."""
    num_worlds: int = 64
    """Worlds of our batch."""


class BatchContender:
    """Our worlds as an actor uses them: stepped together, by one thread."""

    def __init__(
        self, config: WorldConfig, num_worlds: int, *, num_steps: int = EPISODE_STEPS, grasping: bool = False
    ) -> None:
        self._worlds = WorldBatch(config, num_worlds, num_threads=1)
        self._num_steps = num_steps
        self._grasping = grasping
        self._rng = np.random.default_rng(0)

    def episode(self) -> int:
        """One episode in every world."""
        worlds, num = self._worlds, self._worlds.num_worlds
        worlds.reset(self._rng)
        goal = sample_goals("mixed", self._rng, num, worlds.config, _SUCCESS_M)
        actions = self._rng.uniform(-1.0, 1.0, (self._num_steps, num, ACTION.size)).astype(np.float32)
        for step, action in enumerate(actions, start=1):
            if self._grasping:
                reach(action, worlds.object_position[:, :3] - worlds.ee_position, step)
            worlds.step(action)
            worlds.full(step / self._num_steps)
            distances(worlds.object_position, goal).max(axis=1) <= _SUCCESS_M  # noqa: B015 - only its time matters
        return self._num_steps * num


class GymnasiumContender:
    """One Gymnasium goal environment, as ``gymnasium.make`` gives it but for the checker of first steps.

    A grasping one has the end effector first in its observation, as ours and panda-gym's have.
    """

    def __init__(self, name: str, *, num_steps: int = EPISODE_STEPS, grasping: bool = False) -> None:
        self._environment = gymnasium.make(name, disable_env_checker=True)
        self._num_steps = num_steps
        self._grasping = grasping
        self._rng = np.random.default_rng(0)
        self._environment.reset(seed=0)

    def episode(self) -> int:
        """One episode, or what the environment's time limit leaves of it."""
        observation, _ = self._environment.reset()
        shape = self._environment.action_space.shape
        assert shape is not None
        actions = self._rng.uniform(-1.0, 1.0, (self._num_steps, *shape)).astype(np.float32)
        for step, action in enumerate(actions, start=1):
            if self._grasping:
                reach(action, observation["achieved_goal"] - observation["observation"][:3], step)
            observation, _, terminated, truncated, _ = self._environment.step(action)
            if terminated or truncated:
                return step
        return self._num_steps


def reach(action: FloatArray, towards: NDArray[Any], step: int) -> None:
    """Turn random actions (..., 4) into noisy ones that go to the object, ``towards`` metres off, and close."""
    action[..., :3] = np.clip(towards / DISPLACEMENT_M, -1.0, 1.0) + 0.5 * action[..., :3]
    action[..., 3] = 1.0 if step <= _OPEN_STEPS else -1.0


def contenders(num_worlds: int) -> dict[str, BatchContender | GymnasiumContender]:
    """Every row of the table by its name, ours first."""
    rows: dict[str, BatchContender | GymnasiumContender] = {BATCH: BatchContender(WorldConfig(), num_worlds)}
    rows |= {name: panda_gym(name) for name in PANDA_GYM_IDS}
    two = WorldConfig(objects=("cube", "cube"))
    return rows | {
        BATCH + GRASPING: BatchContender(WorldConfig(), num_worlds, grasping=True),
        PICK_AND_PLACE + GRASPING: panda_gym(PICK_AND_PLACE, grasping=True),
        ONE_WORLD: GymnasiumContender(TABLETOP_ID),
        TWO_CUBES: BatchContender(two, num_worlds),
        TWO_CUBES + GRASPING: BatchContender(two, num_worlds, grasping=True),
    }


def panda_gym(name: str, *, grasping: bool = False) -> GymnasiumContender:
    """An environment of panda-gym."""
    try:
        import panda_gym  # noqa: F401 - registers its environments
    except ImportError as error:
        raise TandemError(f"panda-gym cannot be imported ({error}): run `make bench`, which installs it") from None
    return GymnasiumContender(name, grasping=grasping)


def benchmark(settings: Settings) -> dict[str, Any]:
    """Measure all rows in turn."""
    return measure_rows(contenders(settings.num_worlds), settings)


def measure_rows(rows: Mapping[str, BatchContender | GymnasiumContender], settings: Settings) -> dict[str, Any]:
    """Median rates of the given rows, and ratios of those that are compared; for JSON."""
    plays = {name: row.episode for name, row in rows.items()}
    samples = measure_in_turn(plays, settings.num_pairs, settings.seconds)
    ratios = {
        f"{ours} / {theirs}": ratio(samples[ours], samples[theirs])
        for ours, theirs in COMPARED
        if {ours, theirs} <= samples.keys()
    }
    return {"rows": {name: rates(each) for name, each in samples.items()}, "ratios": ratios}


def report(result: dict[str, Any]) -> str:
    """A result for people."""
    ratios = [describe_ratio(name, each) for name, each in result["ratios"].items()]
    return "\n".join([rates_table(result["rows"]), *ratios])


if __name__ == "__main__":
    raise SystemExit(run_benchmark("env_throughput", __doc__, Settings, benchmark, report))
