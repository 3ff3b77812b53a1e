"""Tandem: asymmetric self-play that pre-trains reusable robot-manipulation skills.

Importing this package is cheap: torch, MuJoCo and matplotlib come in with the rooms that need them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.primitives.loading import TrainedBob

__all__ = ["load_primitives"]
__version__ = "0.2.0"


def is_service(registry: Path | str) -> bool:
    """Whether a registry is the URL of a ``tandem serve``, not a directory."""
    return str(registry).startswith(("http://", "https://"))


def load_primitives(reference: str = "panda-cube@champion", registry: Path | str = "registry") -> TrainedBob:
    """Primitives to act with and to compose, without torch; ``panda-cube@champion`` comes with the package.

    Args:
        reference: NAME, NAME@ALIAS or NAME@VERSION, or a run directory.
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
