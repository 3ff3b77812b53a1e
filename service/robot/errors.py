"""Errors of robots and of those who ask them."""

from __future__ import annotations

from service.errors import TandemError


class RobotError(TandemError):
    """A robot did not answer or refused; the message says which, and what to look at."""

    exit_code = 1


class SafetyStopError(RobotError):
    """The robot was stopped; the message says why."""
