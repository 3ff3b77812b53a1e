"""Goals of a robot, one after another: which policies play them, where they are, what came of them, and the log of it.

A log is JSON lines. The first says what was run. Then there is a line for each control step, one for what came of a
goal, and one for why the robot was stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from service.base.errors import RobotError, TandemError
from service.base.files import open_regular, os_errors
from service.base.jsonl import JsonlWriter, read_jsonl
from service.base.types import BoolArray, StateArray
from service.config.frozen import first_error
from service.config.world import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.observations import distances, each_object
from service.envs.sampling import Places, draw_first, draw_goals, draw_starts
from service.envs.state_layout import object_columns, places_at
from service.media.recording import RecordedEpisodes
from service.methods.compose import check_robot
from service.registry.loading import Trained
from service.robot.backends import Backend
from service.robot.loop import Bridge

FORMAT_VERSION = 1
"""Of a log."""
_LONG_WAY = 30
"""Iterations that find the arm's joints from its home."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One goal that was played."""

    goal_m: StateArray
    distance_m: float
    """From the object that is furthest from its goal at the last step; of a simulator in truth, else as it was seen."""
    reached: bool


def for_robot(trained: Trained) -> Trained:
    """The same in its nominal world, where it was trained in worlds that are drawn: a robot is one.

    Raises:
        TandemError: skills, a policy that composes nothing, one of another robot, or one that observes obstacles.
    """
    trained.expect("primitives", "orchestrator", by="tandem robot")
    if trained.kind == "orchestrator" and trained.acts_with is None:
        raise TandemError(f"{trained.label} acts without primitives; a bridge plays what composes them")
    check_robot(trained.acts_with or trained)
    found = trained.nominal
    if found.world.num_observed_obstacles:
        raise TandemError(f"{found.label} observes obstacles, and the bridge measures objects alone; train without")
    return found


def play(
    bridge: Bridge,
    backend: Backend,
    policy: Trained,
    *,
    goal_m: StateArray | None,
    num_episodes: int,
    num_steps: int,
    seed: int,
    ready: Callable[[int, StateArray | None], None],
    tell: Callable[[int, StateArray], None] = lambda episode, goal_m: None,
) -> Iterator[Outcome]:
    """Play goals; a simulator starts each with its objects anywhere, as an evaluation does.

    Args:
        bridge: plays the policy on the back-end's robot.
        backend: the robot.
        policy: says which goals are drawn, and what counts as reached; of a user's task whose goals are a function,
            those of the kind that comes nearest.
        goal_m: (3 K,) the goal of all episodes; None: random ones.
        num_episodes: how many.
        num_steps: of each.
        seed: of starts and goals.
        ready: called with the episode's number and its goal, before anything moves: people put things back then. The
            goal is None where it depends on where they put them.
        tell: called with the episode's number and such a goal, once it is known and before anything moves.

    Raises:
        RobotError: the robot was stopped.
    """
    rng = np.random.default_rng(seed)
    places = _starts(rng, num_episodes, policy.world, simulated=backend.simulator is not None)
    kind, goals = policy.tried_on.goal_kind, np.zeros((num_episodes, 3 * policy.world.num_objects))
    depends = policy.world.fixture != "none" or kind == "one"  # on where the objects are
    if goal_m is None and (backend.simulator is not None or not depends):
        goals = draw_goals(kind, rng, policy.world, policy.success_distance_m, places)
    for episode in range(num_episodes):
        simulator = backend.simulator
        backend.begin(places.object[episode])
        goal = goals[episode] if goal_m is None else goal_m
        if simulator is None and goal_m is None and depends:
            ready(episode, None)
            goal = _goal_from(backend, rng, policy)
            tell(episode, goal)
        else:
            ready(episode, goal)
        distance_m = bridge.run(goal, num_steps, truth=None if simulator is None else simulator.object_position)
        yield Outcome(goal, distance_m, distance_m <= policy.success_distance_m)


def _starts(rng: np.random.Generator, num: int, world: WorldConfig, *, simulated: bool) -> Places:
    """Random starts as in training; of a real robot nothing is put there, and no world has to be built."""
    if not simulated:
        return draw_first(rng, num, world)
    with WorldBatch(world, 1, num_threads=1) as worlds:
        return draw_starts(rng, num, world, worlds.gripper_at_start)


def _goal_from(backend: Backend, rng: np.random.Generator, policy: Trained) -> StateArray:
    """(3 K,) a goal for objects where they lie: it is behind the wall from there, or asks some to stay."""
    pose = backend.poses.read()
    object_m = (
        np.full(3 * policy.world.num_objects, np.nan) if pose is None else np.asarray(pose.position_m, dtype=float)
    )
    if object_m.shape != (3 * policy.world.num_objects,) or not np.isfinite(object_m).all():
        raise RobotError("an object is not seen: put it on the table in view of what sees it")
    if policy.world.fixture == "box":
        raise RobotError(f"{policy.label} brings the object into a box, and nothing tells a bridge where it is: --goal")
    places = Places(object_m[None], np.empty((1, 0)), np.empty((1, 0, 3)))
    goal: StateArray = draw_goals(policy.tried_on.goal_kind, rng, policy.world, policy.success_distance_m, places)[0]
    return goal


# --- the log ---------------------------------------------------------------------------------------------------------


def open_log(path: Path, header: Mapping[str, Any], world: WorldConfig) -> JsonlWriter:
    """Begin a log, to which steps are appended as ``loop.Bridge.run`` has them, each with its ``episode``.

    Args:
        path: a file that is not there yet.
        header: what is run: policy, robot, configuration.
        world: of the policy.

    Raises:
        TandemError: the file is there, or cannot be written.
    """
    if path.exists():
        raise TandemError(f"--log {path}: there is a file already; name another")
    log = JsonlWriter(path)
    log.append({"format_version": FORMAT_VERSION, **header, "world": world.model_dump(mode="json")})
    return log


def read_log(path: Path) -> tuple[WorldConfig, RecordedEpisodes]:
    """The world of a log, and what was logged as its states: effector and objects where they were measured.

    Objects are drawn upright, as only their places were seen, and shorter episodes end with a still picture.

    Raises:
        TandemError: no such file, no log of a robot, or nothing was logged.
    """
    with os_errors("read", path), open_regular(path, follow=True) as file:
        is_json = file.read(1) == b"{"
    header, *rows = read_jsonl(path) if is_json else [{}]
    if header.get("format_version") != FORMAT_VERSION or not {"world", "success_distance_m"} <= header.keys():
        raise TandemError(f"{path} is no log of tandem robot run, format {FORMAT_VERSION}; name what --log wrote")
    try:
        world = WorldConfig.model_validate(header["world"])
    except ValidationError as error:
        raise TandemError(f"{path}: its world cannot be read: {first_error(error)}") from None
    episodes: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        if "effector_m" in row:
            episodes.setdefault(row["episode"], []).append(row)
    if not episodes:
        raise TandemError("the log has no step in which anything was measured: nothing to show")
    return world, _recorded(world, list(episodes.values()), header["success_distance_m"])


def _recorded(world: WorldConfig, episodes: list[list[dict[str, Any]]], success_distance_m: float) -> RecordedEpisodes:
    """The steps of each episode as states of the world."""
    num_steps = max(map(len, episodes))
    padded = [steps + steps[-1:] * (num_steps - len(steps)) for steps in episodes]
    effector, fingers, places = (
        np.array([[step[key] for step in steps] for steps in padded], dtype=np.float64).swapaxes(0, 1)  # (T, N, ...)
        for key in ("effector_m", "fingers_m", "object_m")
    )
    goal = np.array([steps[0]["goal_m"] for steps in episodes])
    with WorldBatch(world, len(episodes), num_threads=1) as worlds:
        arm, layout = worlds.robot.arm, worlds.layout
        objects = object_columns(layout, world.num_objects)
        states = np.tile(worlds.states, (num_steps, 1, 1))
        joints = np.tile(arm.home, (len(episodes), 1))
        for step in range(num_steps):
            joints = arm.solve(joints, effector[step], num_iterations=2 if step else _LONG_WAY)
            states[step][:, layout["joints"]] = joints
            states[step][:, layout["fingers"]] = worlds.robot.finger_values(fingers[step].sum(axis=1))
            places_at(states[step], objects)[:] = each_object(places[step])
    reached: BoolArray = np.all(distances(places, goal) <= success_distance_m, axis=-1)
    return RecordedEpisodes(states, goal, reached)
