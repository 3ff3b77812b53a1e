"""Packages that only some commands need, and what to type where they are not installed.

What is typed names the project, not an index or a clone: pip and uv take the one that is installed, and add its extra.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from service.base.errors import TandemError


class MissingPackageError(TandemError):
    """A package that an extra of tandem-skills brings is not installed."""


@contextmanager
def needs_extra(extra: str, what: str) -> Iterator[None]:
    """Say which extra to install where an import of the block does not find its package.

    Args:
        extra: of ``pyproject.toml``, such as ``serve``.
        what: needs it; the message begins with that.

    Raises:
        MissingPackageError: a package is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "service"):  # a mistake of ours
            raise
        raise MissingPackageError(
            f"{what} needs the package {package}, which is not installed: pip install 'tandem-skills[{extra}]'"
        ) from None
