"""The pictures and the video of a run, made from its directory alone."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path

from service.actors.coverage import NUM_SKILLS, skill_trajectories
from service.baselines.coverage import skill_paths
from service.config import Config
from service.errors import TandemError
from service.io.run_directory import RunDirectory
from service.media import recording, video
from service.media.plots import plot_coverage, plot_curves, plot_goals
from service.policies.numpy_policy import NumpyMCPPolicy
from service.primitives.loading import load_players, load_skills, read_parameters
from service.progress import counted

COVERAGE_STEPS = 100
NUM_RECORDED_ROUNDS = 4
NUM_RECORDED_SKILLS = 6
_SEED = 7
_logger = logging.getLogger(__name__)


def make_artifacts(directory: RunDirectory) -> dict[str, Path]:
    """Draw the curves, the goals, the coverage and a video of a few rounds.

    Returns:
        Files by what they show. What cannot be made, for want of an OpenGL library or of room on the disk, is left
        out, and a warning says why.
    """
    config = directory.read_config()
    if config.skills is not None:
        return _make(
            {
                "curves": partial(plot_curves, directory.path, "skills"),
                "coverage": partial(_draw_skills, directory, config),
                "video": partial(_draw_skill_video, directory, config),
            }
        )
    if config.distillation is not None:
        student = NumpyMCPPolicy(read_parameters(directory, "bob"))
        return _make(
            {
                "curves": partial(plot_curves, directory.path, "distillation"),
                "goals": partial(plot_goals, directory.path, config.world.workspace),
                "coverage": partial(_draw_coverage, directory, config, student),
                "video": partial(_draw_episodes, directory, config, student),
            }
        )
    alice, bob = load_players(directory)

    def draw_video() -> Path:
        rounds = recording.record_rounds(config, alice, bob, num_rounds=NUM_RECORDED_ROUNDS, seed=_SEED)
        path = directory.path / "rounds.mp4"
        directory.keep_recording(path)
        return video.write_video(rounds, config.world, path)

    makers: dict[str, Callable[[], Path]] = {
        "curves": partial(plot_curves, directory.path),
        "goals": partial(plot_goals, directory.path, config.world.workspace),
    }
    if isinstance(bob, NumpyMCPPolicy):
        makers["coverage"] = partial(_draw_coverage, directory, config, bob)
    return _make(makers | {"video": draw_video})


def _make(makers: dict[str, Callable[[], Path]]) -> dict[str, Path]:
    files = {}
    for name, make in counted(makers.items(), "drawing", len(makers), "pictures"):
        try:
            files[name] = make()
        except TandemError as error:
            _logger.warning("no %s: %s", name, error)
    return files


def _draw_skills(directory: RunDirectory, config: Config) -> Path:
    assert config.skills is not None
    skills = load_skills(str(directory.path), directory.path).skills
    steps = config.skills.episode_steps
    paths = skill_paths(skills, config.world, num_skills=NUM_SKILLS, num_steps=steps, seed=_SEED)
    return plot_coverage(paths, config.world.workspace, directory.path / "coverage.png", config.name, of="skill")


def _draw_skill_video(directory: RunDirectory, config: Config) -> Path:
    assert config.skills is not None
    skills = load_skills(str(directory.path), directory.path).skills
    steps = config.skills.episode_steps
    episodes = recording.record_skills(
        skills, config.world, num_skills=NUM_RECORDED_SKILLS, num_steps=steps, seed=_SEED
    )
    path = directory.path / "skills.mp4"
    directory.keep_recording(path)
    return video.write_episode_video(episodes, config.world, path)


def _draw_episodes(directory: RunDirectory, config: Config, bob: NumpyMCPPolicy) -> Path:
    episodes = recording.record_episodes(
        bob,
        config.world,
        "mixed",
        num_episodes=NUM_RECORDED_SKILLS,
        num_steps=config.run.evaluation_steps,
        success_distance_m=config.game.success_distance_m,
        seed=_SEED,
    )
    return video.write_episode_video(episodes, config.world, directory.path / "episodes.mp4")


def _draw_coverage(directory: RunDirectory, config: Config, bob: NumpyMCPPolicy) -> Path:
    paths = skill_trajectories(bob, config.world, num_skills=NUM_SKILLS, num_steps=COVERAGE_STEPS, seed=_SEED)
    return plot_coverage(paths, config.world.workspace, directory.path / "coverage.png", config.name)
