"""What the directory of a downstream training tells beside its status: its settings, and the commands for it."""

from __future__ import annotations

import json
import re
import shlex
import socket
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.config import WorldConfig
from service.downstream.files import made_with
from service.errors import TandemError
from service.io.lock import holder
from service.io.run_directory import TRIAL_FILE
from service.status.schemas import RunCommand, RunSetup
from service.store.models import ACTIVE, RunStatus
from service.store.trial_reader import read_trial_settings

if TYPE_CHECKING:
    from service.downstream.settings import TrialConfig

_PUBLISHED = re.compile(r"[a-z0-9][a-z0-9._-]*@[0-9]+")


def setup(run: RunStatus, directory: Path, registry: Path) -> RunSetup:
    """Read a training's settings, and write the commands that go on with it or use what it has learned."""
    path = directory.absolute()
    nothing = RunSetup(run_id=run.run_id, directory=str(path), config=None, stop_command=None, resume_command=None)
    try:
        trial, primitives, world = resolved(directory)
    except TandemError as error:
        return nothing.model_copy(update={"problem": str(error)})
    config = {"trial": trial.model_dump(mode="json"), "primitives": primitives, "world": world}
    place = ["--registry", str(registry.absolute())]
    active, ended = run.state in ACTIVE, run.state == "finished"
    return RunSetup(
        run_id=run.run_id,
        directory=str(path),
        config=config,
        stop_command=_stop(directory) if active else None,
        resume_command=None if ended else _resume(run, trial, path, place),
        commands=_uses(run, trial, path, place) if ended else (),
    )


def resolved(directory: Path) -> tuple[TrialConfig, dict[str, Any] | None, dict[str, Any] | None]:
    """A training's settings, primitives and world; settings that are younger than its files have their defaults.

    Raises:
        TandemError: there are none, or they are damaged.
    """
    from service.downstream.directory import read_trial  # with Gymnasium, which few views need
    from service.downstream.settings import validate

    tree = read_trial_settings(directory)
    made = made_with(tree)
    primitives, world = (found if isinstance(found, dict) else None for found in made.values())
    with suppress(TandemError, OSError):  # such as the file of a robot that is not here
        world = validate(WorldConfig, world).model_dump(mode="json") if world is not None else None
    return read_trial(tree, directory / TRIAL_FILE), primitives, world


def _stop(directory: Path) -> str | None:
    """The command that does what Ctrl-C does; None where its process is on another machine."""
    host, pid = holder(directory) or ("", 0)
    return shlex.join(["kill", "-INT", str(pid)]) if pid and host == socket.gethostname() else None


def _resume(run: RunStatus, trial: TrialConfig, path: Path, place: list[str]) -> str | None:
    """The command that goes on with a training; None where it was begun with settings that no option has."""
    from service.downstream.methods import METHODS
    from service.downstream.settings import TrialConfig
    from service.off_policy_config import SACConfig

    method, usual = METHODS.get(trial.method), TrialConfig(task=trial.task, method=trial.method)
    if method is None or (trial.curve_every, trial.curve_episodes) != (usual.curve_every, usual.curve_episodes):
        return None
    words = ["tandem", "downstream", "train", "--resume", "--run-dir", str(path)]
    words += ["--task", trial.task, "--method", trial.method, "--seed", str(trial.seed)]
    words += ["--episodes", str(trial.num_episodes)]
    if method.player is None:
        words += ["--steps", str(trial.num_env_steps), "--reward-margin-m", f"{trial.reward_margin_m:g}"]
        standard = SACConfig().model_dump(mode="json")
        for key, value in trial.sac.model_dump(mode="json").items():
            if value != standard[key]:
                words += ["--set", f"{key}={json.dumps(value)}"]
    if method.takes == "skills":
        words += ["--skill-steps", str(trial.skill_steps)]
    if run.trial is not None and run.trial.primitives is not None:
        words += ["--primitives", run.trial.primitives]
    return shlex.join([*words, *place])


def _uses(run: RunStatus, trial: TrialConfig, path: Path, place: list[str]) -> tuple[RunCommand, ...]:
    from service.downstream.methods import METHODS

    def command(what: str, *words: str) -> RunCommand:
        return RunCommand(what=what, command=shlex.join(["tandem", "downstream", *words, *place]))

    found = [
        command("Measure it again, beside Bob alone and a policy that does nothing", "evaluate", str(path)),
        command("Watch it live in the browser", "play", str(path)),
        command("Make a film of it", "render", str(path), "--out", f"{trial.name}.mp4"),
    ]
    method, primitives = METHODS.get(trial.method), run.trial.primitives if run.trial is not None else None
    learned = method is not None and method.player is None and method.takes is not None
    if learned and primitives is not None and _PUBLISHED.fullmatch(primitives):
        name = f"{trial.task}-orchestrator"
        found.append(command("Publish it in the registry", "publish", str(path), "--name", name))
    return tuple(found)
