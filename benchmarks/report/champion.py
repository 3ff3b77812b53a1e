"""Which recorded run the bundled champion is, in words for ``docs/results/pretraining.md``."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.report.markdown import millions, percent
from benchmarks.run_files import Run
from service.config.self_play import SelfPlayConfig
from service.registry.bundled import BUNDLED
from service.registry.digest import parameters_digest
from service.registry.loading import load

CHAMPION = "panda-cube@champion"
DIGITS = 12
"""Of a digest on a page, as in the table of tasks."""


def champion_words(runs: Sequence[Run]) -> str:
    """The bundled champion: its version, digest, run, and what its manifest says it solved when it was published."""
    bob = load(CHAMPION, BUNDLED)
    assert bob.manifest is not None  # it is a published version
    assert isinstance(bob.config, SelfPlayConfig)
    alike = [run["name"] for run in runs if run["config"] == bob.manifest.config]
    made_by = f"the run {alike[0]}" if alike else "made by no run that is recorded here"
    manifest, config = bob.manifest, bob.config
    rates = ", ".join(
        f"{percent(manifest.metrics[f'evaluation/{goals}_success_last'], 1)} of {goals}"
        for goals in ("mixed", "air", "table")
    )
    return (
        f"`{CHAMPION}`, in the package, is version {manifest.version}, {made_by}: seed {manifest.config['seed']}, "
        f"{config.policy.bob.num_primitives} primitives, {millions(manifest.metrics['env_steps'])} env steps, "
        f"parameters `{parameters_digest(bob.primitives)[:DIGITS]}`. When it was published it had {rates} "
        f"goals, {config.run.final_episodes} of each."
    )
