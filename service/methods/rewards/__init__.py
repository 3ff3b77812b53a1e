"""The intrinsic rewards that come with Tandem, a file each, as a user's own would be; and finding one."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module

from service.base.user_code import find_class
from service.config.skills import SKILLS_OF
from service.methods.intrinsic_reward import IntrinsicReward


def find_reward(method: str, code: Mapping[str, str]) -> type[IntrinsicReward]:
    """The class of a method's reward.

    Args:
        method: one of ours, or a reference to a class of a user's.
        code: has the text of that.

    Raises:
        CodeError: no such class.
    """
    if method in SKILLS_OF:
        ours: type[IntrinsicReward] = getattr(import_module(f"{__name__}.{method}"), method.upper())
        return ours
    found: type[IntrinsicReward] = find_class(method, code, IntrinsicReward)
    return found
