"""What a run's directory tells beside its status and its metrics: its configuration, what happened to it, its goals."""

from __future__ import annotations

import os
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from service.base.errors import ConfigError, StorageError
from service.base.files import last_lines, open_regular, read_regular
from service.base.parsing import ParseError, parse_json
from service.base.user_code import parse_reference
from service.config.run import CELL_SIZE_M
from service.config.tree import read_yaml
from service.generator.records import of_furthest
from service.status.schemas import GoalFrame, GoalFrames, RunCommand, RunLog, RunSetup
from service.store.disk_reader import is_study
from service.store.models import (
    ACTIVE,
    CONFIG_FILE,
    GOALS_FILE,
    MAX_BYTES,
    OUTPUT_FILE,
    STUDY_FILE,
    GoalGrid,
    RunStatus,
)
from service.store.run_history import read_history
from service.store.run_log import LogLine, read_log

FRAME_BYTES = 256 * 1024
"""Of the records of goals that are read for one frame, some thousand goals."""


def setup(run: RunStatus, directory: Path | None, registry: Path) -> RunSetup:
    """Read a run's configuration, and write the commands for it."""
    if directory is None:
        return RunSetup(run_id=run.run_id, directory=None, config=None, stop_command=None, resume_command=None)
    config, problem = None, None
    try:
        config = read_yaml(file := directory / CONFIG_FILE)
    except ConfigError as error:
        # no exists() of Path: it raises where the directory may not be read
        problem = (
            str(error) if os.path.lexists(file) else f"{file} is not there: the run has only begun, or it was removed"
        )
    path = directory.absolute()
    place = ["--registry", str(registry.absolute())]
    begun, options = (path.parent, _study_options(path.parent)) if is_study(path.parent) else (path, run.options)
    return RunSetup(
        run_id=run.run_id,
        directory=str(path),
        config=config,
        problem=problem,
        stop_command=shlex.join(["touch", str(path / "stop")]),
        resume_command=shlex.join(["tandem", "train", "--resume", "--run-dir", str(begun), *place, *options]),
        commands=_uses(run, path, place, config) if config is not None and run.state not in ACTIVE else (),
    )


def _study_options(path: Path) -> list[str]:
    """Options of the command that goes on with a study."""
    try:
        found = parse_json(read_regular(path / STUDY_FILE, MAX_BYTES), STUDY_FILE)["options"]
        return [str(each) for each in found]
    except (OSError, ParseError, KeyError, TypeError):  # the study itself says what is wrong with its file
        return []


def _uses(run: RunStatus, path: Path, place: list[str], config: dict[str, Any]) -> tuple[RunCommand, ...]:
    """The commands that use what a run has learned, but for those that its method refuses."""
    if parse_reference(str(config.get("method"))) is not None and not config.keys() & {"policy", "skills", "task"}:
        return ()  # a method of a user's that makes nothing of a known kind
    refused = set()
    skills = config.get("skills")
    if isinstance(skills, dict) and skills.get("zero_shot") == "none":  # no skill leads to a goal
        refused |= {"evaluate", "play"}
    if "task" in config and config.get("primitives_digest") is None:  # what acts by itself is not published
        refused |= {"publish"}
    words = {
        "Measure what it learned": ["evaluate", str(path)],
        "Watch it live in the browser": ["play", str(path)],
        "Make a film of it": ["render", str(path), "--out", f"{run.name}.mp4"],
        "Publish it in the registry": ["publish", str(path), "--name", run.name],
    }
    return tuple(
        RunCommand(what=what, command=shlex.join(["tandem", *each, *place]))
        for what, each in words.items()
        if each[0] not in refused
    )


def log(directory: Path | None, limit: int) -> RunLog:
    """Read what happened to a run: what its process said, and the changes between its processes."""
    if directory is None:
        return RunLog(entries=(), num_entries=0)
    entries = read_log(directory)
    history = None
    with suppress(StorageError):  # the run itself says so
        history = read_history(directory)
    for event in history.events if history is not None else ():
        said = [f"{name} was {before!r} and is {now!r}" for name, (before, now) in event.changed.items()]
        said += [f"lost and left out: {text}" for text in event.damaged_records]
        text = f"from iteration {event.after_iteration}: {'; '.join(said)}"
        entries.append(LogLine(at=event.at, level="info", text=text))
    entries.sort(key=lambda entry: entry.at)
    output = tuple(line[:500] for line in last_lines(directory / OUTPUT_FILE)[-100:])
    return RunLog(entries=tuple(entries[-limit:]), num_entries=len(entries), output=output)


def goal_frames(directory: Path | None, grid: GoalGrid | None, num_frames: int) -> GoalFrames:
    """Read how goals changed: of each of equal parts of the record, how often Bob reached those of a cell."""
    cell_m = grid.cell_size_m if grid is not None else CELL_SIZE_M
    lower = np.array(grid.lower_m if grid is not None else (0.0, 0.0, 0.0))
    frames = []
    if directory is not None:
        try:
            with open_regular(directory / GOALS_FILE) as file:
                size = file.seek(0, 2)
                for index in range(num_frames):
                    begin, end = size * index // num_frames, size * (index + 1) // num_frames
                    file.seek(max(0, begin - 1))
                    if begin:
                        file.readline(FRAME_BYTES)  # which the part before has
                    lines = []
                    while file.tell() < min(end, begin + FRAME_BYTES) and (line := file.readline(FRAME_BYTES)):
                        lines.append(line)
                    if (frame := _frame(lines, lower, cell_m)) is not None:
                        frames.append(frame)
        except OSError:  # an older run has none; one that is being deleted has none any more
            frames = []
    return GoalFrames(cell_size_m=cell_m, frames=tuple(frames))


def _frame(lines: list[bytes], lower: np.ndarray[Any, np.dtype[np.float64]], cell_m: float) -> GoalFrame | None:
    steps, rows = list[int](), list[Any]()
    for line in lines:
        try:
            record = parse_json(line, GOALS_FILE)
            goals = of_furthest(record["goals"])
            steps.append(int(record["env_steps"]))
        except (ParseError, KeyError, TypeError, ValueError):
            continue
        rows.append(goals[np.isfinite(goals).all(axis=1)])
    goals = np.concatenate(rows) if rows else np.zeros((0, 7))
    if not len(goals):
        return None
    cells = np.floor((goals[:, 3:6] - lower) / cell_m + 1e-9).astype(int)
    places, which = np.unique(cells, axis=0, return_inverse=True)
    tries = np.bincount(which.reshape(-1), minlength=len(places))
    solved = np.bincount(which.reshape(-1), weights=goals[:, 6] > 0.5, minlength=len(places))
    centers = np.round(lower + (places + 0.5) * cell_m, 4)
    return GoalFrame(
        first_env_steps=min(steps),
        last_env_steps=max(steps),
        num_goals=len(goals),
        centers_m=tuple((x, y, z) for x, y, z in centers.tolist()),
        num_tries=tuple(tries.tolist()),
        success_rate=tuple(np.round(solved / tries, 4).tolist()),
    )
