"""Tandem: asymmetric self-play that pre-trains reusable robot-manipulation skills.

Importing this package is cheap: torch, MuJoCo and matplotlib come in with the rooms that need them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from service.base.version import __version__ as __version__

if TYPE_CHECKING:
    from service.registry.loading import Trained

__all__ = ["load", "load_policy", "load_primitives", "load_skills"]


def load(
    reference: str = "panda-cube@champion", registry: Path | str = "registry", primitives: str | None = None
) -> Trained:
    """Load what was trained, ready to act, without torch; ``panda-cube@champion`` comes with the package.

    Args:
        reference: NAME, NAME@ALIAS or NAME@VERSION; or the path of a run, of a checkpoint of a run, or of an
            exported version.
        registry: directory to look in first; a version or alias it does not have is looked up among what comes with
            the package. Or the ``http://HOST:PORT`` of a ``tandem serve``, which alone is asked, with the token in
            TANDEM_TOKEN. What a policy of a task acts with is looked up there, too, by the version that it was trained
            with, and among what comes with the package.
        primitives: what a policy of a task acts with, where that has moved. The parameters have to be those it was
            trained with.

    Returns:
        ``.policy``, ``.act_deterministic`` and ``.begin`` act; ``.primitives`` or ``.skills``, where there are some,
        compose or act by a vector; ``.config`` and ``.manifest``: what it was trained with; ``.kind``: what it is.

    Raises:
        TandemError: nothing there by that reference, damaged, or not finished; or what it acts with is not here; or the
            service cannot be reached or wants a token.
    """
    from service.registry import loading

    return loading.load(reference, registry, primitives)


def load_primitives(reference: str = "panda-cube@champion", registry: Path | str = "registry") -> Trained:
    """``load`` what has to be a Bob, whose ``.primitives`` compose."""
    return load(reference, registry).expect("primitives", by="load_primitives")


def load_skills(reference: str, registry: Path | str = "registry") -> Trained:
    """``load`` what has to be ``.skills`` of a skill-discovery baseline."""
    return load(reference, registry).expect("skills", by="load_skills")


def load_policy(reference: str, registry: Path | str = "registry", primitives: str | None = None) -> Trained:
    """``load`` what has to be a policy of a downstream task."""
    return load(reference, registry, primitives).expect("orchestrator", by="load_policy")
