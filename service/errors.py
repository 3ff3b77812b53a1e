"""The base of every error a user can mend."""

from __future__ import annotations

from typing import ClassVar


class TandemError(ValueError):
    """A mistake the user can mend; the message says what, where, which value, and what to do, in one line."""

    exit_code: ClassVar[int] = 2
    """Of a command that ends with it: 2 for what was asked for, 1 for what happened on the way."""


class ConfigError(TandemError):
    """A configuration the user can mend; the message says what, where, which value, and what to do."""


class DivergedError(TandemError):
    """A policy no longer acts in finite numbers; what it did before is not in doubt."""

    exit_code = 1


class GroupError(TandemError):
    """The ranks of a learner do not hear each other; the message says which rank noticed it."""

    exit_code = 1
