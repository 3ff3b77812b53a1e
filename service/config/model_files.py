"""Files of models that descriptions name: where they are, and whether they are still those that were described."""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from pathlib import Path

from service.base.errors import ConfigError
from service.base.files import read_regular

MAX_BYTES = 64 * 1024 * 1024
"""Of a file; usual are some ten thousand."""
PACKAGE = "package:"
"""Begins the name of a file in a Python package."""


def model_file(name: str, sha256: str | None = None) -> Path:
    """The file that a description names as its model.

    Args:
        name: an absolute path, or ``package:NAME/FILE``.
        sha256: digest that it must have.

    Raises:
        ConfigError: no such file or package, or one that has changed.
    """
    path = Path(name)
    if name.startswith(PACKAGE):
        package, _, rest = name.removeprefix(PACKAGE).partition("/")
        found = find_spec(package) if package.isidentifier() else None
        if found is None or not found.submodule_search_locations:
            raise ConfigError(f"model {name}: no Python package {package!r} is installed here")
        path = Path(found.submodule_search_locations[0]) / rest
    if sha256 is not None and (digest := _digest(path, name)) != sha256:
        raise ConfigError(
            f"model {name} is not the one that was described: sha256 {digest[:12]}, not {sha256[:12]}; "
            "put that file back, or begin a new run"
        )
    return path


def absolute(name: str, directory: Path) -> str:
    """A file's name that means the same from everywhere; a relative one is from ``directory``."""
    return name if name.startswith(PACKAGE) else str((directory / name).resolve())


def digest_of(name: str) -> str:
    """The sha256 of a file that a description names.

    Raises:
        ConfigError: as for ``model_file``.
    """
    return _digest(model_file(name), name)


def _digest(path: Path, name: str) -> str:
    try:
        return hashlib.sha256(read_regular(path, MAX_BYTES, follow=True)).hexdigest()
    except OSError as error:
        raise ConfigError(f"model {name}: {error.strerror}: name a file that is there") from None
