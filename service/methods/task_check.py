"""Checks before a task is learned: the method takes what was named, and a user's task runs, and can be solved."""

from __future__ import annotations

import logging

import numpy as np

from service.base.errors import ConfigError, TandemError
from service.base.types import BoolArray
from service.base.user_code import CodeError, place_of
from service.config import WorldConfig
from service.config.task_methods import TaskMethod
from service.envs.batch import WorldBatch
from service.envs.objects import object_names
from service.envs.observations import ACTION, each_object
from service.envs.rules import Rules
from service.envs.task import Task, View
from service.methods.compose import check_primitives, check_robot
from service.registry.loading import Trained

_NUM_WORLDS = 64
_logger = logging.getLogger(__name__)


def check_fits(method: TaskMethod, trained: Trained) -> None:
    """Check that these primitives or skills are for this method.

    Raises:
        TandemError: of another kind, robot or layout, skills of another method, or primitives that cannot be composed.
    """
    if method.takes == "skills" and trained.kind != "skills":
        name = method.skills or "lsd"
        raise TandemError(
            f"this method acts by skills, and {trained.label} has none: name some, such "
            f"as panda-cube-{name}@latest, which tandem train --method {name} makes"
        )
    if method.takes is not None:
        trained.expect(method.takes, by=f"the method {method.title}")
    (check_primitives if method.composes else check_robot)(trained)
    if method.skills is not None and (found := trained.skills.method) != method.skills:
        hint = "; any-skills takes all" * method.learns
        raise TandemError(f"{trained.label} holds skills of {found}, this method takes those of {method.skills}{hint}")


def check_task(task: Task, world: WorldConfig, *, relabels: bool = False) -> None:
    """Play an episode of a user's task at random, and one in which the object is brought to its goal by hand.

    A success that neither comes to is warned of: it may need more than that, or be impossible.

    Args:
        task: of a user's; one of ours is not tried.
        world: that it is learned in, of which the task replaces its part.
        relabels: whether it is asked what would have been paid for other goals, which no memory tells.

    Raises:
        TandemError: a function raises, or gives another shape, type or NaN; goals that the world cannot have;
            or, with ``relabels``, pay by memory.
    """
    if not task.code:
        return
    rng = np.random.default_rng(0)
    world = task.world_from(world)
    with WorldBatch(world, _NUM_WORLDS, num_threads=1) as worlds:
        rules = Rules(task, worlds)
        worlds.reset(rng)
        rules.place(rng)
        goal = rules.draw(rng)
        start = worlds.states.copy()

        def solved() -> BoolArray:
            rules.reward(rules.view(goal))
            return rules.solved(goal)

        if relabels and task.is_own:  # without the memory
            rules.reward(rules.view(goal))  # an error that also comes with the memory is not of hindsight
            try:
                rules.reward(View.of_rows(rules.view(goal).rows(), each_object(goal.astype(np.float32))))
            except CodeError as error:
                raise ConfigError(
                    f"{error}: hindsight asks what would have been paid for other goals. Give a reward that does "
                    "without memory, or take a method without hindsight, such as ours"
                ) from None
        at_start, at_random, by_hand = solved(), np.zeros(_NUM_WORLDS, bool), np.zeros(_NUM_WORLDS, bool)
        for _ in range(task.episode_steps):
            worlds.step(rng.uniform(-1.0, 1.0, (_NUM_WORLDS, ACTION.size)).astype(np.float32))
            rules.advance(goal)
            at_random |= solved()
        rules.begin(np.ones(_NUM_WORLDS, dtype=bool))
        place = np.concatenate([np.r_[worlds.layout[name]] for name in object_names(world)])
        way = goal - start[:, place]
        for step in range(task.episode_steps):  # there in half of the time, then it stays
            moved = start.copy()
            moved[:, place] += way * min(1.0, (step + 1) / max(1, task.episode_steps // 2))
            worlds.restore(moved)
            rules.advance(goal)
            by_hand |= solved()
    where = task.name if task.success is None else place_of(task.success)[1]
    if at_start.all():
        _logger.warning("%s: success is true at the start of every episode; is that meant?", where)
    _logger.info(
        "%s: success at the start of %.0f %% of episodes, in %.0f %% of random ones, in %.0f %% where the object goes "
        "straight to its goal",
        where, 100 * at_start.mean(), 100 * at_random.mean(), 100 * by_hand.mean(),
    )  # fmt: skip
    if not (at_random | by_hand).any():
        _logger.warning(
            "%s: success in 0 %% of %d random episodes, and in 0 %% where the object goes straight to its goal: look "
            "whether it can be reached", where, _NUM_WORLDS,
        )  # fmt: skip
