"""The log of a robot: JSON lines, the first says what was run, each of the others what happened in a control step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from service.base.errors import TandemError
from service.base.jsonl import JsonlWriter, read_jsonl
from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.media.recording import RecordedEpisodes

FORMAT_VERSION = 1
_LONG_WAY = 30
"""Iterations that find the arm's joints from its home."""


class RobotLog:
    """Writes a log.

    Args:
        path: a file that is not there yet.
        header: what is run: policy, robot, configuration.
        world: of the policy.

    Raises:
        TandemError: the file is there, or cannot be written.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], world: WorldConfig) -> None:
        if path.exists():
            raise TandemError(f"--log {path}: there is a file already; name another")
        self._writer = JsonlWriter(path)
        self._writer.append({"format_version": FORMAT_VERSION, **header, "world": world.model_dump(mode="json")})
        self.episode = 0
        """Number that steps are logged under."""

    def record(self, row: Mapping[str, Any]) -> None:
        """Add a step; see ``loop.Bridge.run``."""
        self._writer.append({"episode": self.episode, **row})


@dataclass(frozen=True, slots=True)
class LoggedRun:
    """What a log holds."""

    header: dict[str, Any]
    world: WorldConfig
    episodes: list[list[dict[str, Any]]]
    """Steps of each episode in which anything was measured."""


def read_log(path: Path) -> LoggedRun:
    """Read a log.

    Raises:
        TandemError: no such file, or no log of a robot.
    """
    header, *rows = read_jsonl(path) or [{}]
    if header.get("format_version") != FORMAT_VERSION or not {"world", "success_distance_m"} <= header.keys():
        raise TandemError(f"{path} is no log of tandem robot run, format {FORMAT_VERSION}; name what --log wrote")
    try:
        world = WorldConfig.model_validate(header["world"])
    except ValidationError as error:
        raise TandemError(f"{path}: its world cannot be read: {error.errors()[0]['msg']}") from None
    episodes: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        if "effector_m" in row:
            episodes.setdefault(row["episode"], []).append(row)
    return LoggedRun(header, world, list(episodes.values()))


def states_of(run: LoggedRun) -> RecordedEpisodes:
    """What was logged as states of the policy's world: effector and object where they were measured.

    The object is drawn upright, as only its place was seen, and shorter episodes end with a still picture.

    Raises:
        TandemError: nothing was logged.
    """
    if not run.episodes:
        raise TandemError("the log has no step in which anything was measured: nothing to show")
    num_steps = max(map(len, run.episodes))
    padded = [steps + steps[-1:] * (num_steps - len(steps)) for steps in run.episodes]
    effector, fingers, places = (
        np.array([[step[key] for step in steps] for steps in padded], dtype=np.float64).swapaxes(0, 1)  # (T, N, ...)
        for key in ("effector_m", "fingers_m", "object_m")
    )
    goal = np.array([steps[0]["goal_m"] for steps in run.episodes])
    with WorldBatch(run.world, len(run.episodes), num_threads=1) as worlds:
        arm, layout = worlds.robot.arm, worlds.layout
        states = np.tile(worlds.states, (num_steps, 1, 1))
        joints = np.tile(arm.home, (len(run.episodes), 1))
        for step in range(num_steps):
            joints = arm.solve(joints, effector[step], num_iterations=2 if step else _LONG_WAY)
            states[step][:, layout["joints"]] = joints
            states[step][:, layout["fingers"]] = worlds.robot.finger_values(fingers[step].sum(axis=1))
            states[step][:, layout["object"]] = places[step]
    reached = np.linalg.norm(places - goal, axis=2) <= run.header["success_distance_m"]
    return RecordedEpisodes(states, goal, reached)
