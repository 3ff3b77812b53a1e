"""The base of every error a user can mend."""

from __future__ import annotations


class TandemError(ValueError):
    """A mistake the user can mend; the message says what, where, which value, and what to do, in one line."""
