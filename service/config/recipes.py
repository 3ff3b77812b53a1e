"""The configurations that come with tandem, by name: recipes of pre-training, and descriptions of robots."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

DEFAULT_RECIPE = "panda-cube"
"""The recipe of a run for which none is named."""
_PACKAGE = Path(__file__).parents[1]
CONFIGS = next(path for path in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if path.is_dir())
"""Directory of them: in the wheel ``setup.py`` puts it into the package; in a checkout it is beside it."""


def recipes() -> dict[str, Path]:
    """Configurations for ``tandem train NAME``, by name."""
    return _files("pretrain")


def robots() -> dict[str, Path]:
    """Descriptions of robots for ``world.robot``, by name."""
    return _files("robots")


def first_comment(path: Path) -> str:
    """The sentence at the head of a configuration that says what it is."""
    line = path.read_text(encoding="utf-8").partition("\n")[0]
    return line.removeprefix("#").strip().split(". ")[0]


@cache
def _files(folder: str) -> dict[str, Path]:
    found: Iterable[Path] = sorted((CONFIGS / folder).glob("*.yaml"))
    return {path.stem.replace("_", "-"): path for path in found}
