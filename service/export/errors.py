"""Errors of exporting."""

from __future__ import annotations

from service.errors import TandemError


class ExportError(TandemError):
    """What was asked for cannot be exported; the message says why, and what to do."""


class ParityError(ExportError):
    """What was written does not compute what the evaluator's policy does."""

    exit_code = 1
