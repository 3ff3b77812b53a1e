"""Tandem: asymmetric self-play that pre-trains reusable robot-manipulation skills.

Importing this package is cheap: torch, MuJoCo and matplotlib come in with the rooms that need them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.downstream.orchestrators import Orchestrator
    from service.primitives.loading import TrainedBob, TrainedSkills

__all__ = ["load_policy", "load_primitives", "load_skills"]
__version__ = "0.2.0"


def is_service(registry: Path | str) -> bool:
    """Whether a registry is the URL of a ``tandem serve``, not a directory."""
    return str(registry).startswith(("http://", "https://"))


def load_primitives(reference: str = "panda-cube@champion", registry: Path | str = "registry") -> TrainedBob:
    """Primitives to act with and to compose, without torch; ``panda-cube@champion`` comes with the package.

    Args:
        reference: NAME, NAME@ALIAS or NAME@VERSION, a run directory, or the directory of an exported version.
        registry: directory to look in first; a version or alias it does not have is looked up among what comes with
            the package. Or the ``http://HOST:PORT`` of a ``tandem serve``, which alone is asked, with the token in
            TANDEM_TOKEN.

    Returns:
        ``.primitives``, which act and compose; ``.config`` and ``.manifest``, what it was trained with.

    Raises:
        TandemError: nothing there by that reference, or damaged; or the service cannot be reached or wants a token.
    """
    from service.primitives.loading import load_bob

    if is_service(registry):
        from service.status.client import fetch_primitives

        fetched, version = fetch_primitives(str(registry), reference)
        return load_bob(str(version), fetched.root)
    return load_bob(reference, Path(registry))


def load_skills(reference: str, registry: Path | str = "registry") -> TrainedSkills:
    """Frozen skills of a skill-discovery baseline, to act by a vector z, without torch.

    Args:
        reference: see ``load_primitives``.
        registry: see ``load_primitives``.

    Returns:
        ``.skills``, which act; ``.config`` and ``.manifest``, what they were trained with.

    Raises:
        TandemError: nothing there by that reference, damaged, or primitives; or the service cannot be reached.
    """
    from service.primitives.loading import load_skills

    if is_service(registry):
        from service.status.client import fetch_primitives

        fetched, version = fetch_primitives(str(registry), reference)
        return load_skills(str(version), fetched.root)
    return load_skills(reference, Path(registry))


def load_policy(reference: str, registry: Path | str = "registry", primitives: str | None = None) -> Orchestrator:
    """What ``tandem downstream`` has learned, with the primitives or skills that it acts with, without torch.

    Args:
        reference: directory of a training, or NAME, NAME@ALIAS or NAME@VERSION of a published orchestrator, or the
            directory of an exported one.
        registry: see ``load_primitives``; what the orchestrator acts with is looked up there by the version that it was
            trained with, and among what comes with the package.
        primitives: what it acts with, where that has moved: a reference or a run directory. The parameters have to be
            those it was trained with.

    Returns:
        ``.act_deterministic`` acts and ``.begin`` begins new episodes; ``.task``, ``.world`` and ``.trained``: on what
        task, in what world, and with what.

    Raises:
        TandemError: nothing there by that reference, damaged, or no orchestrator; or what it was trained with is not
            here.
    """
    from service.downstream.orchestrators import load_orchestrator

    if is_service(registry) and not Path(reference).is_dir():
        from service.status.client import fetch_primitives

        fetched, version = fetch_primitives(str(registry), reference)
        return load_orchestrator(str(version), fetched.root, registry, primitives)
    return load_orchestrator(reference, Path(registry), registry, primitives)
