"""What a run leaves for a person to look at, made from its directory alone."""

from __future__ import annotations

import logging
from pathlib import Path

from service.actors.coverage import skill_trajectories, visited_share
from service.errors import TandemError
from service.policies.evaluator import MCPEvaluator
from service.runtime.plots import plot_coverage, plot_curves, plot_goals
from service.runtime.primitives import load_players
from service.runtime.rundir import RunDirectory

NUM_SKILLS = 32
"""Random compositions in the coverage picture (paper)."""
COVERAGE_STEPS = 100
NUM_FILMED_ROUNDS = 4
_SEED = 7
_logger = logging.getLogger(__name__)


def make_artifacts(directory: RunDirectory) -> dict[str, Path]:
    """Draw the curves, the goals and the coverage, and film a few rounds.

    Returns:
        Files by what they show. Without an OpenGL library there is no video, and a warning says what to install.
    """
    config = directory.read_config()
    alice, bob = load_players(directory)
    files = {
        "curves": plot_curves(directory.path),
        "goals": plot_goals(directory.path, config.world.workspace),
    }
    if isinstance(bob, MCPEvaluator):
        paths = skill_trajectories(bob, config.world, num_skills=NUM_SKILLS, num_steps=COVERAGE_STEPS, seed=_SEED)
        share = visited_share(paths, config.world.workspace)
        files["coverage"] = plot_coverage(
            list(paths),
            config.world.workspace,
            directory.path / "coverage.png",
            f"{config.name}, {share:.0%} of the table's cells visited",
        )
    try:
        from service.runtime.video import film_rounds, write_video

        takes = film_rounds(config, alice, bob, num_rounds=NUM_FILMED_ROUNDS, seed=_SEED)
        files["video"] = write_video(takes, config.world, directory.path / "rounds.mp4")
    except TandemError as error:
        _logger.warning("no video: %s", error)
    return files
