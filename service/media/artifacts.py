"""The pictures and the video of a run, made from its directory alone."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from service.actors.coverage import NUM_SKILLS, skill_paths, skill_trajectories
from service.base.errors import TandemError
from service.base.progress import counted
from service.config.self_play import SelfPlayConfig
from service.config.skills import SkillDiscoveryConfig
from service.media import recording, video
from service.media.plots import plot_coverage, plot_curves, plot_goals
from service.policies.numpy_policy import NumpyMCPPolicy
from service.registry.loading import Trained, load
from service.store.run_directory import RunDirectory

COVERAGE_STEPS = 100
NUM_RECORDED_ROUNDS = 4
NUM_RECORDED_SKILLS = 6
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
    if trained.kind == "orchestrator":
        makers["video"] = partial(_draw_episodes, directory, trained)
    elif trained.kind == "skills":
        makers["coverage"] = partial(_draw_skills, directory, trained)
        makers["video"] = partial(_draw_skill_video, directory, trained)
    else:
        makers["goals"] = partial(plot_goals, directory.path, config.world.workspace)
        if isinstance(trained.policy, NumpyMCPPolicy):
            makers["coverage"] = partial(_draw_coverage, directory, trained)
        makers["video"] = partial(_draw_rounds if trained.alice else _draw_episodes, directory, trained)
    files = {}
    for name, make in counted(makers.items(), "drawing", len(makers), "pictures"):
        try:
            files[name] = make()
        except TandemError as error:
            _logger.warning("no %s: %s", name, error)
    return files


def _draw_rounds(directory: RunDirectory, trained: Trained) -> Path:
    assert trained.alice is not None
    assert isinstance(trained.config, SelfPlayConfig)
    rounds = recording.record_rounds(
        trained.config, trained.alice, trained.policy, num_rounds=NUM_RECORDED_ROUNDS, seed=_SEED
    )
    path = directory.path / "rounds.mp4"
    directory.keep_recording(path)
    return video.write_video(rounds, trained.config.world, path)


def _draw_skills(directory: RunDirectory, trained: Trained) -> Path:
    config = trained.config
    assert isinstance(config, SkillDiscoveryConfig)
    steps = config.skills.episode_steps
    paths = skill_paths(trained.skills, config.world, num_skills=NUM_SKILLS, num_steps=steps, seed=_SEED)
    return plot_coverage(paths, config.world.workspace, directory.path / "coverage.png", config.name, of="skill")


def _draw_skill_video(directory: RunDirectory, trained: Trained) -> Path:
    config = trained.config
    assert isinstance(config, SkillDiscoveryConfig)
    steps = config.skills.episode_steps
    episodes = recording.record_skills(
        trained.skills, config.world, num_skills=NUM_RECORDED_SKILLS, num_steps=steps, seed=_SEED
    )
    path = directory.path / "skills.mp4"
    directory.keep_recording(path)
    return video.write_episode_video(episodes, config.world, path)


def _draw_episodes(directory: RunDirectory, trained: Trained) -> Path:
    episodes = recording.record_episodes(
        trained.player(),
        trained.world,
        trained.goals,
        num_episodes=NUM_RECORDED_SKILLS,
        num_steps=trained.num_steps,
        success_distance_m=trained.success_distance_m,
        seed=_SEED,
    )
    return video.write_episode_video(episodes, trained.world, directory.path / "episodes.mp4")


def _draw_coverage(directory: RunDirectory, trained: Trained) -> Path:
    world = trained.config.world
    paths = skill_trajectories(trained.primitives, world, num_skills=NUM_SKILLS, num_steps=COVERAGE_STEPS, seed=_SEED)
    return plot_coverage(paths, world.workspace, directory.path / "coverage.png", trained.config.name)
