"""The base of every pydantic model here: frozen, without unknown keys, with finite numbers only."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class FrozenModel(BaseModel):
    """A pydantic model that cannot be changed once it is made."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def reason(error: ErrorDetails) -> str:
    """What is wrong, in words, without pydantic's prefix of what our own checks say."""
    return error["msg"].removeprefix("Value error, ")
