"""Copies of what the next workers begin with, at the driver's node."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import ray
from ray.exceptions import RayError


class Copies:
    """Copies of the newest weights and states at this node: they outlive the node that they are from.

    On one machine, where all processes share a store, nothing is copied.
    """

    def __init__(self) -> None:
        self._values: dict[Any, Any] = {}
        """By reference; None until it is here."""

    def keep(self, references: Iterable[Any]) -> dict[Any, Callable[[Any], None]]:
        """Keep these, and forget what is older; those to wait for, each with what to call when it can be copied."""
        self._values = {each: self._values.get(each) for each in references}
        return {each: self._on_ready for each, value in self._values.items() if value is None}

    def _on_ready(self, reference: Any) -> None:
        if reference in self._values:
            with suppress(RayError):  # it went with its node, and who needs it will say so
                self._values[reference] = ray.get(reference)
