"""One world as a Gymnasium goal environment: bring the object to a given place. ``vector`` has many at once."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from service.base.errors import TandemError, in_metres
from service.base.types import BoolArray, FloatArray, StateArray
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import ACTION, each_object, layouts
from service.envs.overlap import inside_each_other, inside_fixtures
from service.envs.rules import Rules
from service.envs.task import Task, View, view_of_places
from service.envs.tasks import find_task

if TYPE_CHECKING:
    from service.envs.rendering.renderer import SceneRenderer

Observation = dict[str, FloatArray]

FURTHEST_M = 10.0
"""Bound of every position: an object off the table falls for ever, a space needs an end."""


@dataclass(frozen=True, slots=True)
class EnvState:
    """Everything that an environment of N worlds continues from."""

    worlds: StateArray
    """(N, S) ``WorldBatch.states``."""
    goal: StateArray
    """(N, 3 K) metres."""
    elapsed: NDArray[np.int64]
    """(N,) steps of the episode."""
    memory: StateArray
    """(N, M) of the task; (N, 0) where it keeps none."""
    random: list[dict[str, Any]]
    """State of each world's bit generator, which draws object and goal at the next reset."""


class GoalWorlds:
    """Worlds with a goal for the object of each: the part that the environments of one world and of many share.

    Args: those of ``TabletopEnv`` and of ``WorldBatch``.

    Raises:
        TandemError: unknown task, goals that the world cannot have, a distance that is not positive, or a task
            beside that of a Gymnasium name.
    """

    def __init__(
        self,
        num_worlds: int,
        num_threads: int,
        config: WorldConfig | None,
        task: Path | str | Task | None,
        success_distance_m: float,
        registered: str | None,
    ) -> None:
        if registered is not None and task is not None:
            raise TandemError(
                f"{find_task(registered).id} has a task, and another one would leave out its world: take "
                "tandem/Tabletop-v1, and give your task the world that it needs, such as {'fixture': 'wall'}"
            )
        task = task if registered is None else registered
        self.config = config or WorldConfig()
        if not isinstance(self.config, WorldConfig):
            raise TandemError(
                f"config is a {type(config).__name__}: give a WorldConfig, such as load(...).config.world, or None"
            )
        asked = find_task(task) if isinstance(task, str | Path) else task
        if asked is None:
            asked = Task("Tabletop", goals=self.config.usual_goals)
        if not isinstance(asked, Task):
            raise TandemError(f"task is a {type(asked).__name__}: give a name, a file, a Task, or None")
        self.config = asked.world_from(self.config)
        if not success_distance_m > 0.0:
            raise TandemError(f"success_distance_m = {success_distance_m}; give a distance above 0 m")
        self.success_distance_m = success_distance_m
        self._worlds = WorldBatch(self.config, num_worlds, num_threads=num_threads)
        self.rules = Rules(asked, self._worlds, success_distance_m)
        """What the task says, and what it remembers."""
        self._goal = self._worlds.object_position.copy()
        self._random = [seeding.np_random()[0] for _ in range(num_worlds)]
        self._has_begun = False

    def compute_reward(self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Any) -> Any:
        """Compute (...) float64 rewards of (..., 3 K) achieved for (..., 3 K) desired goals, metres, as the task pays.

        ``info`` is there for the convention of goal environments and is not read.

        Raises:
            TandemError: goals of another shape; or the task needs more than places, or gives something else.
        """
        size = self._goal.shape[1]
        for name, goal in (("achieved_goal", achieved_goal), ("desired_goal", desired_goal)):
            if np.shape(goal)[-1:] != (size,):
                raise TandemError(f"compute_reward: {name} has shape {np.shape(goal)}, not (..., {size}): give metres")
        achieved, desired = np.broadcast_arrays(achieved_goal, desired_goal)
        flat = (each.reshape(-1, each.shape[-1]) for each in (achieved, desired))
        return self.rules.reward(view_of_places(*flat)).reshape(achieved.shape[:-1])

    def rewards_of(self, rows: FloatArray, goal: FloatArray) -> NDArray[np.float64]:
        """Compute again the (B,) rewards of steps to (B, V) ``View.rows``, for other goals, (B, 3 K) metres."""
        return self.rules.reward(View.of_rows(rows, each_object(goal)))

    def state(self) -> EnvState:
        """Copy everything that ``restore`` needs."""
        random = [deepcopy(dict(each.bit_generator.state)) for each in self._random]
        kept = self._goal.copy(), self.rules.elapsed.copy(), self.rules.memory.copy()
        return EnvState(self._worlds.states.copy(), *kept, random)

    def restore(self, state: EnvState) -> Observation:
        """Go back to a saved state, of this or another environment of the same config; continues bit-identically.

        What wraps the environment does not go back: a time limit of ``gymnasium.make`` counts on
        (``max_episode_steps=-1`` is none), and ``ComposePrimitives`` has a ``restore`` of its own.

        Returns:
            The observation there.

        Raises:
            ValueError: a state of another number of worlds.
        """
        if state.worlds.shape != self._worlds.states.shape:
            raise ValueError(f"states: expected shape {self._worlds.states.shape}, got {state.worlds.shape}")
        self._worlds.restore(state.worlds)
        self._has_begun = True
        self._goal = state.goal.copy()
        self.rules.elapsed, self.rules.memory = state.elapsed.copy(), state.memory.copy()
        for generator, random in zip(self._random, state.random, strict=True):
            generator.bit_generator.state = deepcopy(random)
        return self._observe()[0]

    def _start(self, worlds: BoolArray, goal: StateArray | None = None) -> None:
        """Start new episodes, each from its own world's random numbers: no world depends on when others end.

        Args:
            worlds: (N,) where.
            goal: (N, 3 K) or (1, 3 K) in place of random goals, metres; random numbers go on as with these.
        """
        self._has_begun = True
        index = np.flatnonzero(worlds).tolist()
        starts = [self._worlds.draw_starts(self._random[world], 1) for world in index]
        self._worlds.restore(np.concatenate(starts), worlds)
        self.rules.begin(worlds)
        for world in index:
            here = slice(world, world + 1)
            self.rules.place(self._random[world], here)
            self._goal[here] = self.rules.draw(self._random[world], here)
        if goal is not None:
            self._goal[:] = goal

    def _given(self, options: dict[str, Any] | None) -> StateArray | None:
        """(N, 3 K) or (1, 3 K) goals that ``options`` of a reset give, metres; None where they give none.

        Raises:
            TandemError: another option, or a goal of another shape, out of reach or inside a fixture.
        """
        for name in (options or {}).keys() - {"goal"}:
            raise TandemError(f"reset: unknown option {name!r}; the only one is goal")
        if not options or options["goal"] is None:
            return None
        try:
            goal = np.array(options["goal"], dtype=np.float64)
        except (TypeError, ValueError):
            raise TandemError(f"reset: options['goal'] = {options['goal']!r}: give numbers, metres") from None
        num, size = self._worlds.num_worlds, self._goal.shape[1]
        if goal.shape[-2:] == (size // 3, 3):  # as tasks write the goals of several objects
            goal = goal.reshape(*goal.shape[:-2], size)
        if goal.shape not in ((size,), (num, size)):
            raise TandemError(
                f"reset: options['goal'] has shape {goal.shape}, not {(size,)} or {(num, size)}: give metres"
            )
        goal = goal.reshape(-1, size)
        if not np.isfinite(goal).all():
            raise TandemError(f"reset: options['goal'] = {options['goal']!r}: give finite numbers, metres")
        for bad in goal[self.rules.out_of_reach(goal)]:
            near = in_metres(self.rules.nearest(bad[None])[0])
            raise TandemError(
                f"reset: options['goal'] ({in_metres(bad)}) m is out of reach: the nearest the arm comes is ({near}) m"
            )
        for bad in goal[inside_fixtures(goal, self.config)]:
            raise TandemError(
                f"reset: options['goal'] ({in_metres(bad)}) m: an object would be inside a fixture, or the upright box "
                "around it"
            )
        for bad in goal[inside_each_other(goal, self.config)]:
            raise TandemError(f"reset: options['goal'] ({in_metres(bad)}) m: objects would be inside each other")
        return goal

    def _advance(self, actions: FloatArray) -> BoolArray:
        """Act by (N, 4) actions; (N,) whose physics diverged."""
        if not self._has_begun:
            raise gymnasium.error.ResetNeeded("call reset before step")
        diverged = self._worlds.step(np.asarray(actions, dtype=np.float32))
        self.rules.advance(self._goal)
        return diverged

    def _observe(self) -> tuple[Observation, View]:
        """(N, ...) observations, and what success and reward see: places as observed, where both are ours."""
        positions = np.clip(self._worlds.positions(), -FURTHEST_M, FURTHEST_M)
        achieved = np.clip(self._worlds.object_position, -FURTHEST_M, FURTHEST_M).astype(np.float32)  # without noise
        desired = self._goal.astype(np.float32)
        observation = {"observation": positions, "achieved_goal": achieved, "desired_goal": desired}
        own = self.rules.task.is_own
        return observation, self.rules.view(self._goal) if own else view_of_places(achieved, desired)


def goal_space(config: WorldConfig) -> gymnasium.spaces.Dict:
    """Make the space of the observations of one such world."""
    goal = 3 * config.num_objects
    sizes = {"observation": layouts(config).positions.size, "achieved_goal": goal, "desired_goal": goal}
    return gymnasium.spaces.Dict(
        {name: gymnasium.spaces.Box(-FURTHEST_M, FURTHEST_M, (size,), np.float32) for name, size in sizes.items()}
    )


def action_space() -> gymnasium.Space[FloatArray]:
    """Make the space of the actions of one world."""
    return gymnasium.spaces.Box(-1.0, 1.0, (ACTION.size,), np.float32)


class TabletopEnv(GoalWorlds, gymnasium.Env[Any, FloatArray]):
    """A Gymnasium environment: bring each of K objects to its goal, a place for its centre.

    - observation: ``observation`` (P,) positions as Bob's primitives see them (``service.envs.observations``), 11 or as
      many as ``config`` says, ``achieved_goal`` (3 K,) and ``desired_goal`` (3 K,) objects and goals in the world
      frame, metres, within +-10.
    - action: (4,) in [-1, 1]: way x, y, z from where the end effector is now to its set-point (1 is 5 cm, of which the
      arm covers about 3 cm in a step), change of the finger width (1 is 10 cm).
    - reward: 1 at every step each object is within ``success_distance_m`` of its goal, else 0 (paper, downstream
      tasks); or what the task says.
    - never terminates; truncated where the physics diverged, or the steps of the task are over. Another length:
      ``gymnasium.make("tandem/Push-v1", max_episode_steps=100)``, with -1 for no end. In ``tandem/Tabletop-v1`` the
      steps of the task count: ``task=replace(find_task("push"), episode_steps=100)``.

    ``info`` holds ``is_success`` (bool) and, after a step, ``diverged`` (bool).

    Args:
        config: the world; the paper's by default.
        task: a downstream task, by name or file as commands take it, or as an object. It replaces part of ``config``,
            and has its goals, success and reward.
        success_distance_m: greatest distance that counts as reached, metres.
        registered: the task of its Gymnasium name, whose episodes ``gymnasium.make`` ends; it gives this itself.
        render_mode: ``rgb_array`` or None.
        width: of rendered images, pixels.
        height: of rendered images, pixels.

    Raises:
        TandemError: unknown ``task`` or ``render_mode``, goals that the world cannot have, or a distance that is not
            positive.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 - as the base class has it

    def __init__(
        self,
        config: WorldConfig | None = None,
        *,
        task: Path | str | Task | None = None,
        success_distance_m: float = 0.05,
        registered: str | None = None,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise TandemError(f"TabletopEnv: render_mode = {render_mode!r}; choose rgb_array or None")
        super().__init__(1, 1, config, task, success_distance_m, registered)
        self.np_random, self.render_mode = self._random[0], render_mode
        self._counts_steps = registered is None
        step_s = self.config.step_s
        self.metadata = {**self.metadata, "render_fps": round(1.0 / step_s)}
        self.observation_space = goal_space(self.config)
        self.action_space = action_space()
        self._image_size = (width, height)
        self._renderer: SceneRenderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode: the arm at home, objects, goal and fixtures at random places.

        Args:
            seed: restarts the environment's random numbers; the same seed gives the same episodes, bit for bit.
            options: ``{"goal": (x, y, z)}``, metres, in place of the random goal; object and later episodes are the
                same with it and without.

        Raises:
            TandemError: an unknown option, a goal of another shape, not finite, out of reach or inside a fixture.
        """
        goal = self._given(options)
        super().reset(seed=seed, options=options)
        self._random = [self.np_random]
        self._start(np.ones(1, dtype=bool), goal)
        observation, view = self._observe()
        return _first(observation), {"is_success": bool(self.rules.success(view)[0])}

    def step(self, action: FloatArray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one control step of 40 ms.

        Args:
            action: (4,) in [-1, 1]; see the class.

        Raises:
            ValueError: action of the wrong shape.
            DivergedError: an action that is not finite.
        """
        command = np.asarray(action, dtype=np.float32)
        if command.shape != (ACTION.size,):
            raise ValueError(f"action: expected shape {(ACTION.size,)}, x, y, z and finger width, got {command.shape}")
        diverged = bool(self._advance(command[None])[0])
        observation, view = self._observe()
        truncated = diverged or (self._counts_steps and bool(self.rules.elapsed[0] >= self.rules.task.episode_steps))
        info = {"is_success": bool(self.rules.success(view)[0]), "diverged": diverged}
        return _first(observation), float(self.rules.reward(view)[0]), False, truncated, info

    def restore(self, state: EnvState) -> Observation:
        """Go back to a saved state; see ``GoalWorlds``."""
        return _first(super().restore(state))

    def render(self) -> Any:
        """(height, width, 3) uint8 picture of the world and its goal; None without a render mode."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            from service.envs.rendering.renderer import SceneRenderer

            self._renderer = SceneRenderer(self.config, *self._image_size)
        return self._renderer.render(self._worlds.states[0], self._goal[0])

    def __getstate__(self) -> dict[str, Any]:
        """Of a copy; it opens a renderer of its own when it draws."""
        return self.__dict__ | {"_renderer": None}

    def close(self) -> None:
        """Free the renderer and the physics; the environment cannot step afterwards."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._worlds.close()


def _first(observation: Observation) -> Observation:
    return {name: value[0] for name, value in observation.items()}
