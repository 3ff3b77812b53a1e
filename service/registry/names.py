"""Names, aliases and references such as ``panda-cube@champion``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from service.base.errors import RegistryError
from service.base.parsing import NAME

LATEST = "latest"
_RULE = "use 1 to 64 of a-z, 0-9, '.', '_', '-', the first a letter or digit"


class Version(NamedTuple):
    """One immutable version of a name."""

    name: str
    number: int

    def __str__(self) -> str:
        """``NAME@NUMBER``."""
        return f"{self.name}@{self.number}"


def check_name(name: str) -> str:
    """Return ``name``.

    Raises:
        RegistryError: it breaks the rule for names.
    """
    if not is_name(name):
        raise RegistryError(f"bad name {name!r}: {_RULE}")
    return name


def check_alias(alias: str) -> str:
    """Return ``alias``.

    Raises:
        RegistryError: it breaks the rule for aliases; digits alone would read as a version.
    """
    if not is_name(alias) or is_number(alias):
        raise RegistryError(f"bad alias {alias!r}: {_RULE}, and not digits alone")
    return alias


def is_name(text: str) -> bool:
    """Whether ``text`` follows the rule for names."""
    return re.fullmatch(NAME, text) is not None


def is_service(registry: Path | str) -> bool:
    """Whether a registry is the URL of a ``tandem serve``, not a directory."""
    return str(registry).startswith(("http://", "https://"))


def is_number(text: str) -> bool:
    """Whether ``text`` is ASCII digits alone."""
    return re.fullmatch(r"[0-9]+", text) is not None


def split_reference(reference: str) -> tuple[str, int | str]:
    """``"name@3"`` to ``("name", 3)``, ``"name@alias"`` to ``("name", "alias")``, ``"name"`` to ``("name", "latest")``.

    Raises:
        RegistryError: not a reference.
    """
    name, at, target = reference.partition("@")
    if not is_name(name) or (at and not is_name(target)):
        raise RegistryError(f"bad reference {reference!r}: expected NAME, NAME@VERSION or NAME@ALIAS")
    if is_number(target):
        return name, int(target)
    return name, target or LATEST
