"""Goals of a user's own source, which Bob plays besides those that Alice has just proposed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from inspect import getfile

import numpy as np

from service.base.errors import ConfigError, TandemError, in_metres
from service.base.types import Array, BoolArray, StateArray
from service.base.user_code import CodeError, check_members, checked, find_class, naming_errors_of, shown
from service.config import WorldConfig
from service.config.self_play import SelfPlayConfig
from service.envs.observations import each_object
from service.envs.overlap import inside_each_other, inside_fixtures
from service.envs.sampling import GoalKind, check_goals, sample_goals
from service.generator.validity import in_workspace

NUM_DRAWN = 1024
"""Goals drawn in a round when they do not come from Alice; of these, those that are played are chosen."""


@dataclass(frozen=True, slots=True)
class Known:
    """What the task generator knows, for a source of goals."""

    world: WorldConfig
    success_distance_m: float
    coverage: float
    """Share of the workspace's cells in which a goal was ever proposed."""
    success_rate: float
    """Bob's, mean over all cells; 0 where no goal was proposed or tried."""
    near: Callable[[StateArray], BoolArray]
    """(M,) whether (M, K, 3) or (M, 3 K) goals, metres, are in cells to which objects were brought, or beside one."""

    def random(self, rng: np.random.Generator, num: int = NUM_DRAWN, kind: GoalKind = "mixed") -> StateArray:
        """Draw (num, 3 K) goals of a kind as an evaluation does, metres.

        Raises:
            TandemError: ``one``, or a kind that the world cannot have.
        """
        check_goals(kind, self.world, self.success_distance_m)
        if kind == "one":
            raise TandemError("goals = 'one' depend on where the objects are; choose mixed, and let the others stay")
        return sample_goals(kind, rng, num, self.world, self.success_distance_m)


class GoalSource(ABC):
    """Goals that Bob plays besides those that Alice has just proposed: a base for a user's own.

    It is a function of what is known, so a resumed run goes on with the same goals. Each is tried from where worlds are
    now and, with ``generator.replay_from_reset``, from starts of games.
    """

    @abstractmethod
    def goals(self, known: Known, rng: np.random.Generator) -> Array:
        """(M, K, 3) or (M, 3 K) goals of all objects, metres.

        Those outside the workspace, or with an object inside another one or a fixture, are left out.
        """

    def weights(self, known: Known, goal: StateArray, start: StateArray, learnability: StateArray) -> Array:
        """(M,) how often to draw tasks by (M, K, 3) goals and starts, and p (1 - p) of Bob's success in such tasks."""
        return learnability + 0.01


class CheckedSource:
    """A user's source, whose answers are checked; for ``coverage`` and others see ``Known``."""

    def __init__(
        self, config: SelfPlayConfig, coverage: float, success_rate: float, near: Callable[[StateArray], BoolArray]
    ) -> None:
        kind: type[GoalSource] = find_class(config.generator.goal_source, config.code, GoalSource)
        self._origin, self._name, self._near = getfile(kind), kind.__name__, near
        self._known = Known(config.world, config.success_distance_m, coverage, success_rate, self._asked_near)
        with naming_errors_of(self._origin):
            self._source = kind()

    def goals(self, rng: np.random.Generator) -> StateArray:
        """(M, 3 K) goals in the workspace, in which no object is inside another one or a fixture, metres."""
        with naming_errors_of(self._origin):
            goal = np.asarray(self._source.goals(self._known, rng))
        num = self._known.world.num_objects
        if goal.ndim == 2 and goal.shape[1] == 3 * num:  # as ``known.random`` gives them
            goal = goal.reshape(-1, num, 3)
        shape = len(np.atleast_1d(goal)), num, 3
        goal = checked(f"{self._origin}: {self._name}.goals", goal, shape)
        inside = in_workspace(goal, self._known.world.workspace).all(axis=1)
        self._outside = goal[~inside][:1].reshape(-1, 3)
        kept: StateArray = goal[inside].reshape(-1, shape[1] * 3)
        world = self._known.world
        return kept[~(inside_each_other(kept, world) | inside_fixtures(kept, world))]

    @property
    def left_out(self) -> str:
        """Words for a goal that it gave last and that is outside the workspace; empty where there was none."""
        if not len(self._outside):
            return ""
        workspace = self._known.world.workspace
        low, high = in_metres(workspace.lower_m), in_metres(workspace.upper_m)
        return f", as ({in_metres(self._outside[0])}) m is outside: that is ({low}) to ({high}) m"

    def _asked_near(self, goal: StateArray) -> BoolArray:
        """``Known.near``, of (M, 3 K) or (M, K, 3) goals."""
        num, rows = self._known.world.num_objects, np.asarray(goal, dtype=np.float64)
        if rows.shape[1:] not in ((3 * num,), (num, 3)):
            raise CodeError(f"{self._origin}: known.near: goal has shape {rows.shape}; give (M, {num}, 3)")
        return self._near(rows.reshape(len(rows), 3 * num))

    def weights(self, goal: StateArray, start: StateArray, learnability: StateArray) -> StateArray:
        """(M,) weights of tasks with (M, 3 K) goals and starts."""
        if not len(goal):
            return np.zeros(0)
        asked = each_object(goal), each_object(start), learnability
        with naming_errors_of(self._origin):
            weight = np.asarray(self._source.weights(self._known, *map(shown, asked)))
        where = f"{self._origin}: {self._name}.weights"
        weight = checked(where, weight, learnability.shape)
        if (weight < 0.0).any():
            least = int(weight.argmin())
            raise CodeError(f"{where} gave {weight[least]:g} at [{least}]; give weights of 0 or more")
        with np.errstate(over="ignore"):
            total = weight.sum()
        if not np.isfinite(total):
            raise CodeError(f"{where} gave up to {weight.max():g}, whose sum is too large; give smaller weights")
        return weight


def check_source(config: SelfPlayConfig) -> None:
    """Try a user's source before anything is known.

    Raises:
        ConfigError: it does not run, gives something else, or no goal in the workspace.
    """
    check_members(find_class(config.generator.goal_source, config.code, GoalSource), GoalSource, ("goals", "weights"))
    rng, tried = np.random.default_rng(0), list[tuple[int, str]]()
    for near in (False, True):
        source = CheckedSource(config, 0.0, 0.0, partial(_all, near))
        goal = source.goals(rng)
        source.weights(goal, np.zeros_like(goal), np.full(len(goal), 0.25))
        tried.append((len(goal), source.left_out))
    # Alice brings the object to some cells first; without her nothing is ever near.
    counted = tried if config.game.alice_plays else tried[:1]
    if not any(num for num, _ in counted):
        left_out = next(filter(None, (words for _, words in counted)), "")
        raise ConfigError(
            f"generator.goal_source = {config.generator.goal_source!r}: it gives no goal in the workspace while "
            f"nothing is known{left_out}: let it give some without known.near, such as known.random(rng)"
        )


def _all(near: bool, goal: StateArray) -> BoolArray:
    return np.full(len(goal), near)
