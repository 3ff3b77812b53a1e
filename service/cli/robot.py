"""``tandem robot``: frozen policies on a robot, calibration of its arm, and videos of what was logged."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError

from service.base.errors import RobotError, TandemError, in_metres
from service.base.files import check_place
from service.base.jsonl import JsonlWriter
from service.base.types import StateArray
from service.base.user_code import naming_unexpected
from service.cli.common import CHAMPION, REFERENCE, SOURCE, ActsWithOption, CommandGroup, SourceOption, print_json
from service.cli.evaluate import parse_points
from service.config.load import explained
from service.config.tree import apply_override
from service.config.world import WorldConfig
from service.runs.signals import InterruptError, StopSignals

if TYPE_CHECKING:
    from service.registry.loading import Trained
    from service.robot.backends import Backend, BackendConfig
    from service.robot.limits import Box
    from service.robot.loop import BridgeConfig
    from service.robot.running import Outcome

robot_app = typer.Typer(name="robot", help="Frozen policies on a robot.", cls=CommandGroup, no_args_is_help=True)

_Policy = Annotated[
    str,
    typer.Option(metavar=REFERENCE, help="Primitives or an orchestrator: a version, a run or an export."),
]
_Robot = Annotated[
    str, typer.Option(metavar="NAME|FILE", help="mujoco, pybullet, franka, module:function, or a YAML file.")
]
_Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="A=B", help="Of the bridge, such as safety.max_speed_m_s=0.5.")
]
_DeadMan = Annotated[
    str | None,
    typer.Option(metavar="key|none", help="A key to be held; default: none for simulators and dry runs, else key."),
]


@robot_app.command()
def run(
    robot: _Robot,
    policy: _Policy = CHAMPION,
    primitives: ActsWithOption = None,
    goal: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Metres, of one object after the other; default: random ones.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Number of goals.", min=1)] = 1,
    steps: Annotated[
        int | None, typer.Option(help="Control steps of each; default: as the policy is evaluated.", min=1)
    ] = None,
    seed: Annotated[int, typer.Option(help="Of random goals.", min=0)] = 0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Command nothing, print what would be.")] = False,
    calibration: Annotated[Path | None, typer.Option(metavar="FILE", help="Of this robot's response.")] = None,
    log: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON lines, for tandem robot replay.")] = None,
    overrides: _Set = None,
    dead_man: _DeadMan = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    registry: SourceOption = SOURCE,
) -> None:
    """Bring objects to goals; Ctrl-C stops the robot first."""
    from service.robot.backends import read_backend
    from service.robot.calibrate import read_calibration
    from service.robot.loop import Bridge
    from service.robot.running import open_log, play

    config, described, player = _bridge_config(overrides), read_backend(robot), _load(policy, registry, primitives)
    goal_m = None if goal is None else parse_goal(goal, player.world)
    gain = (1.0, 1.0, 1.0)
    if calibration is not None:
        measured = read_calibration(calibration)
        measured.check(described.label, player.world, config)
        gain = measured.gain
    with _connected(described, player, seed, dead_man, dry_run) as (backend, held, wait):

        def record(row: dict[str, Any]) -> None:
            if written is not None:
                written.append({"episode": len(outcomes), **row})
            if dry_run:
                _print_step(row, bridge.safe.limiter.box, to_stderr=as_json)

        def ready(episode: int, goal_m: StateArray | None) -> None:
            where = "to be drawn from where objects lie" if goal_m is None else in_metres(goal_m)
            wait(f"goal {episode + 1} of {episodes}, {where}: put arm and objects to their start")

        bridge = Bridge(
            player.policy, backend.robot, backend.poses, player.world, config,
            gain=gain, held=held, dry_run=dry_run, record=record,
        )  # fmt: skip
        header = {
            "policy": player.label,
            "success_distance_m": player.success_distance_m,
            "robot": described.model_dump(mode="json"),
            "bridge": config.model_dump(mode="json"),
            "calibration": None if calibration is None else str(calibration),
            "gain": gain,
            "seed": seed,
            "dry_run": dry_run,
        }
        written = None if log is None else open_log(log, header, player.world)
        outcomes = []
        played = play(
            bridge,
            backend,
            player,
            goal_m=goal_m,
            num_episodes=episodes,
            num_steps=steps or player.num_steps,
            seed=seed,
            ready=ready,
            tell=lambda episode, goal_m: typer.echo(f"goal {episode + 1}: {in_metres(goal_m)}", err=True),
        )
        for outcome in _logged(played, written, lambda: bridge.safe.stopped):
            outcomes.append(outcome)
            if not as_json:
                reached = "reached" if outcome.reached else "not reached"
                typer.echo(f"goal {in_metres(outcome.goal_m)}: {reached}, {outcome.distance_m:.3f} m away in the end")
    num_reached = sum(outcome.reached for outcome in outcomes)
    if as_json:
        print_json({"policy": player.label, "robot": described.label, "reached": num_reached, "goals": len(outcomes)})
    elif len(outcomes) > 1:
        share = num_reached / len(outcomes)
        typer.echo(f"{num_reached} of {len(outcomes)} goals reached at the last step: {share:.1%}")


@robot_app.command()
def calibrate(
    robot: _Robot,
    out: Annotated[Path, typer.Option(metavar="FILE", help="YAML to write, for tandem robot run.")],
    policy: _Policy = CHAMPION,
    primitives: ActsWithOption = None,
    overrides: _Set = None,
    dead_man: _DeadMan = None,
    registry: SourceOption = SOURCE,
) -> None:
    """Measure the response of an arm by motions of some 6 cm about the middle of its safety box, without an object."""
    from service.robot import calibrate as measuring
    from service.robot.backends import read_backend

    config, described, player = _bridge_config(overrides), read_backend(robot), _load(policy, registry, primitives)
    check_place(out)  # now, not after the arm has moved
    with _connected(described, player, 0, dead_man) as (backend, held, wait):
        wait("take everything out of the arm's way")
        found = measuring.calibrate(described.label, backend.robot, player.world, config, held=held)
    measuring.write_calibration(out, found)
    for axis, share, wanted in zip("xyz", found.covered_share, found.training_share, strict=True):
        typer.echo(f"  {axis}: covers {share:.0%} of a commanded step; in training {wanted:.0%}")
    typer.echo(f"  is seen to move {found.delay_steps:.2f} control steps after a command")
    typer.echo(f"calibration: {out}")


@robot_app.command()
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="That tandem robot run --log wrote.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Video to write.")] = Path("robot.mp4"),
) -> None:
    """Make a video of a log: effector and object where they were measured, in the scene of training."""
    from service.media.video import write_episode_video
    from service.robot.running import read_log

    check_place(out)
    world, recorded = read_log(log)
    write_episode_video(recorded, world, out)
    typer.echo(f"video: {out}")


def _logged(played: Iterator[Outcome], log: JsonlWriter | None, stopped: Callable[[], str | None]) -> Iterator[Outcome]:
    """Append what came of each goal to a log, and why the robot was stopped."""
    num = 0
    try:
        for num, outcome in enumerate(played, start=1):
            if log is not None:
                log.append({"episode": num - 1, **asdict(outcome)})
            yield outcome
    except BaseException:
        if log is not None and (reason := stopped()) is not None:
            log.append({"episode": num, "stopped": reason})
        raise


def parse_goal(text: str, world: WorldConfig) -> StateArray:
    """(3 K,) a goal of a robot in metres.

    Raises:
        TandemError: another goal, or several; or as for ``parse_points``.
    """
    goals = parse_points("--goal", text, world, "a point")
    if len(goals) > 1:
        raise TandemError(f"--goal {text}: write one point")
    goal: StateArray = goals[0]
    return goal


def _bridge_config(overrides: list[str] | None) -> BridgeConfig:
    from service.robot.loop import BridgeConfig

    tree: dict[str, Any] = {}
    for override in overrides or ():
        apply_override(tree, override)
    try:
        return BridgeConfig.model_validate(tree)
    except ValidationError as error:
        raise TandemError(f"--set: {explained(error, BridgeConfig)}") from None


def _load(policy: str, registry: str, primitives: str | None) -> Trained:
    from service.registry.loading import load
    from service.robot.running import for_robot

    return for_robot(load(policy, registry, primitives))


@contextlib.contextmanager
def _connected(
    described: BackendConfig, player: Trained, seed: int, dead_man: str | None, dry_run: bool = False
) -> Iterator[tuple[Backend, Callable[[], bool], Callable[[str], None]]]:
    """A robot with its dead-man's switch, and what asks people to get ready; signals come as exceptions.

    A simulator and a dry run ask no question, and no key has to be held: they endanger no person.
    """
    from service.robot.backends import connect, file_of
    from service.robot.safety import always_held
    from service.robot.watchdogs import HeldKey

    if dead_man not in (None, "key", "none"):
        raise TandemError(f"--dead-man {dead_man!r}: choose key or none")
    with StopSignals() as signals, contextlib.ExitStack() as stack:
        backend = stack.enter_context(contextlib.closing(connect(described, player.world, seed=seed)))
        harmless = backend.simulator is not None or dry_run
        needed = dead_man == "key" or (dead_man is None and not harmless)
        key = stack.enter_context(HeldKey()) if needed else None

        def wait(what: str) -> None:
            if key is not None:
                typer.echo(f"{what}, then hold any key; letting go stops the robot", err=True)
                key.wait()
            elif not harmless:
                typer.echo(f"{what}, then press Enter", err=True)
                if not sys.stdin.readline():
                    raise TandemError("standard input has ended, so nobody can press Enter: run this in a terminal")

        def held() -> bool:
            # a back-end of a user's may have swallowed what the signal raised
            return signals.first is None and (key or always_held)()

        with naming_unexpected(file_of(described)):
            try:
                yield backend, held, wait
            except RobotError:
                if signals.first is not None:
                    raise InterruptError(signals.first) from None
                raise


def _print_step(row: dict[str, Any], box: Box, *, to_stderr: bool) -> None:
    if "width_m" not in row:
        return
    typer.echo(
        f"step {row['step']:>3}  gripper {in_metres(row['effector_m'])}  object {in_metres(row['object_m'])}"
        f"  would go to {in_metres(box.clip(row['target_m']))}"
        f"  width {row['width_m']:.3f} m",
        err=to_stderr,
    )
