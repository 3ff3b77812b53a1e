"""The base of every error a user can mend."""

from __future__ import annotations

from collections.abc import Iterable
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
    """A policy no longer acts in finite numbers; what it did before is not in doubt."""

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
