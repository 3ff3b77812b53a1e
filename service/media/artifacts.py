"""The pictures and the video of a run, made from its directory alone; and what commands draw of anything trained."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from service.actors.coverage import NUM_SKILLS, composition_paths, skill_paths
from service.base.errors import TandemError
from service.base.progress import track
from service.base.types import StateArray
from service.config.self_play import SelfPlayConfig
from service.config.skills import SkillDiscoveryConfig
from service.envs.sampling import GoalKind
from service.media import recording, video
from service.media.plots import plot_coverage, plot_curves, plot_goals
from service.policies.numpy_policy import NumpyMCPPolicy
from service.registry.loading import Trained, load
from service.store.run_directory import RunDirectory

COVERAGE_STEPS = 100
NUM_RECORDED_ROUNDS = 4
NUM_RECORDED_EPISODES = 6
_SEED = 7
_logger = logging.getLogger(__name__)


def make_artifacts(directory: RunDirectory, registry: Path | str = "registry") -> dict[str, Path]:
    """Draw the curves, the goals, the coverage and a video of a few rounds.

    Returns:
        Files by what they show. What cannot be made, for want of an OpenGL library or of room on the disk, is left
        out, and a warning says why.
    """
    config = directory.read_config()
    if config.makes is None:
        return {}
    trained = load(str(directory.path), registry)
    makers: dict[str, Callable[[], Path]] = {"curves": partial(plot_curves, directory.path, config.method)}
    if trained.kind == "primitives":
        makers["goals"] = partial(plot_goals, directory.path, config.world.workspace)
    if trained.kind == "skills" or (trained.kind == "primitives" and isinstance(trained.policy, NumpyMCPPolicy)):
        makers["coverage"] = partial(_draw_coverage, directory, trained)
    makers["video"] = partial(_draw_video, directory, trained)
    files = {}
    for name, make in track(makers.items(), "drawing", len(makers), "pictures"):
        try:
            files[name] = make()
        except TandemError as error:
            _logger.warning("no %s: %s", name, error)
        except Exception as error:  # whatever a library raises, what was learned is saved and published
            _logger.warning("no %s: %s: %s", name, type(error).__name__, error, exc_info=error)
    return files


def _draw_coverage(directory: RunDirectory, trained: Trained) -> Path:
    config = trained.config
    steps = config.skills.episode_steps if isinstance(config, SkillDiscoveryConfig) else COVERAGE_STEPS
    paths, of = paths_of(trained, NUM_SKILLS, steps, _SEED)
    return plot_coverage(paths, config.world.workspace, directory.path / "coverage.png", config.name, of=of)


def _draw_video(directory: RunDirectory, trained: Trained) -> Path:
    kind = "skills" if trained.kind == "skills" else "rounds" if _has_rounds(trained) else "episodes"
    path = directory.path / f"{kind}.mp4"
    directory.keep_recording(path)
    return film(trained, path, NUM_RECORDED_ROUNDS if kind == "rounds" else NUM_RECORDED_EPISODES, _SEED)


def _has_rounds(trained: Trained) -> bool:
    """Whether it is a run in which Alice plays."""
    config = trained.config
    return trained.alice is not None and isinstance(config, SelfPlayConfig) and config.game.alice_plays


def paths_of(trained: Trained, num: int, num_steps: int, seed: int) -> tuple[StateArray, str]:
    """(num, num_steps + 1, 3) metres where random skills or compositions move the object; what one is called.

    Of K objects K times as many.

    Raises:
        TandemError: it has neither.
    """
    if trained.kind == "skills":
        return skill_paths(trained.skills, trained.world, num_skills=num, num_steps=num_steps, seed=seed), "skill"
    return (
        composition_paths(trained.primitives, trained.world, num_skills=num, num_steps=num_steps, seed=seed),
        "composition" if trained.world.num_objects == 1 else "path",
    )


def film(
    trained: Trained,
    path: Path,
    num: int,
    seed: int,
    options: video.FilmOptions | None = None,
    goals: GoalKind | StateArray | None = None,
) -> Path:
    """Film random skills, rounds of a run's Alice and Bob, or episodes on goals; see ``record_on_goals``.

    Args:
        trained: who acts.
        path: of the film.
        num: of skills, rounds or episodes.
        seed: of all of them.
        options: of the film.
        goals: that are filmed in place of rounds; skills have some on a task alone.

    Raises:
        TandemError: see ``write_video``; or no goal leads what was trained.
    """
    trained = trained.nominal  # pictures show that world alone
    config = trained.config
    if isinstance(config, SkillDiscoveryConfig) and trained.kind == "skills" and trained.task is None:
        steps = config.skills.episode_steps
        recorded = recording.record_skills(trained.skills, config.world, num_skills=num, num_steps=steps, seed=seed)
    elif isinstance(config, SelfPlayConfig) and trained.alice is not None and _has_rounds(trained) and goals is None:
        rounds = recording.record_rounds(config, trained.alice, trained.policy, num_rounds=num, seed=seed)
        return video.write_video(rounds, config.world, path, options)
    else:
        recorded = recording.record_on_goals(trained.expect_goals("tandem render"), num, seed, goals)
    return video.write_episode_video(recorded, trained.world, path, options)
