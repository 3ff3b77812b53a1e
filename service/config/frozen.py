"""The base of every pydantic model here: frozen, without unknown keys, with finite numbers only."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

NO_KEYS = BUILT_IN, DESCRIBED, NAMED = "built-in", "described", "named"
"""Tags of what a key may hold; pydantic's locations have them between the keys."""
_NUMBERS = (int, float, int | None, float | None)


class FrozenModel(BaseModel):
    """A pydantic model that cannot be changed once it is made."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_flag_for_a_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false where a number is expected: pydantic makes 1 and 0 of them."""
        if isinstance(value, bool) and cls.model_fields[str(info.field_name)].annotation in _NUMBERS:
            raise ValueError("expected a number, not true or false")
        return value


def first_error(error: ValidationError) -> str:
    """The first thing that is wrong with plain values, in a few words."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"] if part not in NO_KEYS) or "the top level"
    if first["type"] == "extra_forbidden":
        return f"unknown key {key!r}"
    found = "" if isinstance(first["input"], dict) else f" = {first['input']!r}"  # a whole group says nothing
    return f"{key}{found}: {first['msg'].removeprefix('Value error, ')}"  # which our own checks have
