"""The base of every pydantic model here: frozen, without unknown keys, with finite numbers only."""

from __future__ import annotations

import re
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


_UNIT = re.compile(r"(?<!_m)(?<!_n)(?<!_rad)_(m|kg|s|rad)$")
"""The end of a key that has a unit alone, and no quotient or product of some."""
_WORDS = {"m": "metres", "kg": "kg", "s": "seconds", "rad": "radians"}
_BOUNDS = ("less_than", "greater_than")
"""Begin the types of errors about a number that is out of range."""
_WANTED = {
    "tuple_type": "give a list, such as [A, B]",
    "model_type": "give a group of keys, such as {KEY: VALUE}",
    "model_attributes_type": "give a group of keys, such as {KEY: VALUE}",
    "dict_type": "give a group of keys, such as {KEY: VALUE}",
    "missing": "is missing, and has no default",
}
"""What to do about the types of errors whose own words are Python's."""


def first_of(error: ValidationError) -> Any:
    """What is wrong first: a key that is unknown, which may be another one misspelt, before one that is missing."""
    errors = error.errors()
    return next((each for each in errors if each["type"] == "extra_forbidden"), errors[0])


def first_error(error: ValidationError) -> str:
    """The first thing that is wrong with plain values, in a few words."""
    first = first_of(error)
    key = ".".join(str(part) for part in first["loc"] if part not in NO_KEYS)
    if first["type"] == "extra_forbidden":
        return f"unknown key {key!r}"
    found = "" if isinstance(first["input"], dict) else f" = {first['input']!r}"  # a whole group says nothing
    words = _WANTED.get(first["type"], first["msg"].removeprefix("Value error, "))  # which our own checks have
    if first["type"] == "literal_error" and {BUILT_IN, NAMED} & {*first["loc"]}:
        words += ", or describe one: {KEY: VALUE}"
    if first["type"].startswith(_BOUNDS) and (unit := _UNIT.search(key.rstrip(".0123456789"))) is not None:
        words += f" ({_WORDS[unit[1]]})"
    if not key and first["type"] == "value_error":  # our own checks of what belongs together name the keys
        return str(words)
    return f"{key or 'the top level'}{found}: {words}"
