"""The base of every pydantic model here: frozen, without unknown keys, with finite numbers only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

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


def reason(error: ErrorDetails) -> str:
    """What is wrong, in words, without pydantic's prefix of what our own checks say."""
    return error["msg"].removeprefix("Value error, ")
