"""Every error that a user can mend, among them the packages that only some commands need."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import ClassVar

TRACEBACK_PREFIX = "tandem-error-"
"""Begins the names of the files that `UnexpectedError` names."""


class TandemError(ValueError):
    """A mistake the user can mend; the message says what, where, which value, and what to do, in one line."""

    exit_code: ClassVar[int] = 2
    """Of a command that ends with it: 2 for what was asked for, 1 for what happened on the way."""


class UnexpectedError(TandemError):
    """A mistake of this program's own; the message names the file that has its traceback."""

    exit_code = 1


class NoRoomError(TandemError):
    """There is not enough memory, or no room on a disk; nothing is wrong with the program."""

    exit_code = 1


class ConfigError(TandemError):
    """A configuration the user can mend; the message says what, where, which value, and what to do."""


class DivergedError(TandemError):
    """A policy's actions or losses are not finite; earlier checkpoints are valid."""

    exit_code = 1


class StorageError(TandemError):
    """A file or directory cannot be read or written."""


class FormatVersionError(StorageError):
    """A file was written in another format than this program reads."""

    @classmethod
    def of(cls, where: object, *, found: object, supported: int) -> FormatVersionError:
        """The error for ``where``, a file whose format version is ``found``."""
        return cls(
            f"{where}: format version {found!r} found, this tandem reads {supported}; "
            "read it with the tandem that wrote it, or train and publish again with this one"
        )


class CheckpointError(StorageError):
    """A run's checkpoint is missing, unusable, or cannot be written."""


class RunTakenError(StorageError):
    """Another process uses this directory, or runs this run."""


class RegistryError(StorageError):
    """Something about the registry's files or a request to it is wrong."""


class UnknownVersionError(RegistryError):
    """A name, version or alias that does not exist; the message lists those that do."""


class DamagedBlobError(RegistryError):
    """A saved file whose bytes are not those that were written."""


class StatusError(TandemError):
    """The service cannot start with these options, or its URL or token is not valid."""


class FetchError(TandemError):
    """An answer that cannot be used: the service is down or has an error, or something else listens at the URL."""

    exit_code = 1


class WrongTokenError(FetchError):
    """The service needs a token, or another one than was sent."""

    exit_code = 2


class StoreError(TandemError):
    """The store cannot do what was asked."""


class UnknownRunError(StoreError):
    """A run id that does not exist; the message lists those that do."""

    @classmethod
    def of(cls, run_id: str, where: object, known: list[str]) -> UnknownRunError:
        """The error for ``run_id``, which is not among the runs ``known`` to be at ``where``."""
        shown = ", ".join(known[:20]) + (f" and {len(known) - 20} more" if len(known) > 20 else "")
        return cls(f"no run {run_id[:128]!r} in {where}; it holds: {shown or 'nothing yet'}")


class StoreUnavailableError(StoreError):
    """The store cannot be reached at the moment."""

    exit_code = 1


class DamagedStoreError(StoreError):
    """The store holds a value that no run has written."""

    exit_code = 1


class ParityError(TandemError):
    """What was written does not compute what the evaluator's policy does."""

    exit_code = 1


class RobotError(TandemError):
    """A robot did not answer or refused; the message says which, and what to look at."""

    exit_code = 1


def one_line(text: str, max_characters: int = 2000) -> str:
    """A message as one line of printable characters; of one that is too long, the middle is left out.

    What a file holds may come into a message, and may be made to look like other lines, or to move a terminal's cursor.
    """
    joined = " ".join(line.strip() for line in text.splitlines())
    line = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in joined)
    if len(line) <= max_characters:
        return line
    half = max_characters // 2
    return f"{line[:half]} ... {line[-half:]}"


def in_metres(point: Iterable[float]) -> str:
    """A place in words, to the millimetre."""
    return ", ".join(f"{each:.3f}" for each in point)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The end of a message about a misspelt name, ``; did you mean 'x'?``; empty where no known name is like it.

    Args:
        name: as it was typed. Capitals do not count, nor does ``_`` for ``-``.
        known: the names that there are.
    """
    from difflib import get_close_matches

    plain = {each.lower().replace("_", "-"): each for each in known}
    found = get_close_matches(name[:200].lower().replace("_", "-"), plain, n=1)
    return f"; did you mean {plain[found[0]]!r}?" if found else ""


@contextmanager
def needs_extra(extra: str, what: str) -> Iterator[None]:
    """Say which extra to install where an import of the block does not find its package.

    What the message says to type names the project, not an index or a clone: pip and uv take the one that is installed,
    and add its extra.

    Args:
        extra: of ``pyproject.toml``, such as ``serve``.
        what: needs it; the message begins with that.

    Raises:
        TandemError: a package is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "service"):  # a mistake of ours
            raise
        raise TandemError(
            f"{what} needs the package {package}, which is not installed: pip install 'tandem-skills[{extra}]'"
        ) from None
