"""Tandem: asymmetric self-play that pre-trains reusable robot-manipulation skills.

Importing this package is cheap: torch, MuJoCo and matplotlib come in with the parts that need them.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from service.base.version import __version__ as __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from service.actors.evaluation import Evaluation
    from service.envs.gym.vector import TabletopVectorEnv
    from service.envs.sampling import GoalKind
    from service.envs.task import Task
    from service.registry.loading import Trained
    from service.runs.run import Ending
    from service.runs.train import Finished

__all__ = ["evaluate", "load", "make_env", "train"]


def load(
    reference: Path | str = "panda-cube@champion",
    registry: Path | str | None = None,
    primitives: str | None = None,
    *,
    run_task_code: bool = False,
) -> Trained:
    """Load a trained policy, primitives or skills, ready to act without torch.

    Args:
        reference: NAME, NAME@ALIAS or NAME@VERSION; or the path of a run, of a checkpoint of a run, or of an
            exported version. ``panda-cube@champion`` comes with the package.
        registry: directory to look in first, by default TANDEM_REGISTRY or ``registry``; a version or alias it does not
            have is looked up among what comes with the package. Or the ``http://HOST:PORT`` of a ``tandem serve``,
            which alone is asked, with the token in TANDEM_TOKEN if TANDEM_URL or TANDEM_REGISTRY names that service.
            What a policy of a task acts with is looked up there, too, by the version that it was trained with, and
            among what comes with the package.
        primitives: what a policy of a task acts with, where that has moved. The parameters have to be those it was
            trained with.
        run_task_code: run what code the task of a published policy brings; acting needs none. The directory of a run
            has such code, too, and loading it runs that: load runs of those whom you trust.

    Returns:
        ``.policy``, ``.act_deterministic`` and ``.begin`` act; ``.primitives`` or ``.skills``, where there are some,
        compose or act by a vector; ``.kind``: what it is; ``.config``: its world, networks and evaluation (of a
        version other keys have their defaults: ``.manifest.config`` has all that it was trained with).

    Raises:
        TandemError: nothing there by that reference, damaged, or not finished; or what it acts with is not here; or the
            service cannot be reached or wants a token.
    """
    from service.registry import loading

    return loading.load(reference, registry or _registry(), primitives, run_task_code=run_task_code)


def train(
    what: Path | str | None = None,
    settings: Sequence[str] = (),
    *,
    method: str | None = None,
    primitives: Path | str | None = None,
    run_dir: Path | str | None = None,
    registry: Path | str | None = None,
    resume: bool = False,
    publish: bool = False,
    on_iteration: Callable[[dict[str, float]], Ending | None] | None = None,
) -> Finished:
    """Run a training in this process, as ``tandem train`` does, and return what came out.

    Args:
        what: a recipe, a task, a YAML file, or a task of yours in ``FILE.py``; None: the recipe panda-cube, or what a
            run has that goes on.
        settings: ``a.b=c`` overrides.
        method: of a task, or of skill discovery.
        primitives: that the method of a task takes, a reference as ``load`` has it.
        run_dir: where it keeps everything; default: NAME in TANDEM_RUNS or ``runs``.
        registry: where it publishes, and finds what it takes; by default TANDEM_REGISTRY or ``registry``.
        resume: go on with the run there.
        publish: publish what was learned; the command does so by itself, but for tasks.
        on_iteration: called with the metrics of every iteration; what it returns, if anything, ends the run.

    Returns:
        Why and where it ended, metrics of the final evaluation, files that were made, and the version if one was
        published.

    Raises:
        TandemError: a setting, a file or a directory that cannot be used.
    """
    from service.base.errors import TandemError
    from service.config import load_config
    from service.config.recipes import DEFAULT_RECIPE, recipes
    from service.runs import train as training
    from service.runs.named import named
    from service.runs.resuming import resumed_config
    from service.store.run_directory import RunDirectory

    for key, value in (("what", what), ("primitives", primitives)):
        if not isinstance(value, Path | str | None):
            raise TandemError(f"{key} is a {type(value).__name__}: a run records names and files, so give one of those")
    settings = [settings] if isinstance(settings, str) else settings
    target, takes = (None if each is None else str(each) for each in (what, primitives))
    file, first = named(target, method, takes)
    overrides = [*first, *settings]
    begun = file if file is not None or first else recipes()[DEFAULT_RECIPE]
    registry = registry or _registry()
    runs = Path(os.environ.get("TANDEM_RUNS") or "runs")
    path = Path(run_dir) if run_dir is not None else runs / load_config(begun, overrides).directory_name
    directory = RunDirectory(path)
    if resume:
        _, said = named(target, method, takes, resumed=True)
        config = resumed_config(directory, [*said, *settings], file)
    else:
        config = load_config(begun, overrides).begin(registry, None)
    told = on_iteration or (lambda metrics: None)
    return training.train(config, directory, registry, resume=resume, publish=publish, on_iteration=told)


def evaluate(
    trained: Trained,
    task: Path | str | Task | None = None,
    *,
    goals: GoalKind | None = None,
    num_episodes: int = 300,
    seed: int = 0,
) -> Evaluation:
    """Measure a policy without noise on random goals, as ``tandem evaluate`` does.

    Args:
        trained: as ``load`` gives it.
        task: to be played in place of its own, by name or file, or an object.
        goals: ``table``, ``air``, ``volume``, ``mixed`` or ``one`` in place of the task's.
        num_episodes: each from a fresh reset.
        seed: of the episodes.

    Returns:
        Success at the last step with its 95 % interval, success at any step, and the distance at the end, metres.

    Raises:
        ValueError: ``num_episodes`` below 1.
        TandemError: no such task or goals, a task of another number of objects, or nothing that ``load`` gave.
    """
    from service.actors import evaluation
    from service.methods.task_evaluation import FINAL_SEED

    trained = _loaded(trained)
    if num_episodes < 1:
        raise ValueError(f"num_episodes = {num_episodes}; give at least 1")
    name = str(task) if isinstance(task, Path) else task
    on = trained.on(name) if name is None or isinstance(name, str) else trained.playing(name)
    first_seed = seed if on.task is None else seed + FINAL_SEED
    return evaluation.evaluate(
        on.player(), on.world, on.on_goals(goals), num_episodes=num_episodes,
        num_steps=on.num_steps, success_distance_m=on.success_distance_m, seed=first_seed,
    )  # fmt: skip


def _loaded(given: object) -> Trained:
    """What ``load`` gave, or a reminder to call it."""
    from service.base.errors import TandemError
    from service.registry.loading import Trained

    if isinstance(given, Trained):
        return given
    raise TandemError(f"{given!r}, a {type(given).__name__}: give what tandem_skills.load returns")


def _registry() -> str:
    """Where commands look, too."""
    return os.environ.get("TANDEM_REGISTRY") or "registry"


def make_env(
    task: Path | str | Task | None = None, trained: Trained | None = None, *, num_envs: int = 1
) -> TabletopVectorEnv:
    """Make a Gymnasium vector environment of N worlds of a task; ``gymnasium.make`` has single ones.

    Args:
        task: by name or file, or an object; None: goals in the volume and on the table; beside a fixture on the table.
        trained: its world is taken, with the task's settings; None: the paper's world.
        num_envs: N.

    Raises:
        TandemError: no such task, or goals that the world cannot have.
        ValueError: ``num_envs`` below 1.
    """
    from service.envs.gym.vector import TabletopVectorEnv

    world = None if trained is None else _loaded(trained).config.world
    return TabletopVectorEnv(num_envs, world, task=task)
