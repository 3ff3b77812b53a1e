"""Methods by their names: the class of a run's configuration, which makes the method."""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from service.base import user_code
from service.base.errors import ConfigError, did_you_mean
from service.config.run import Config
from service.config.task_methods import TASK_METHODS

METHODS: Mapping[str, str] = {
    "self-play": "service.config.self_play:SelfPlayConfig",
    "skills": "service.config.skills:SkillDiscoveryConfig",
    "distillation": "service.config.distillation:DistillingConfig",
    **{name: "service.config.task:TaskConfig" for name, method in TASK_METHODS.items() if method.learns},
}
"""Where the class of each method is, as ``MODULE:CLASS``; it is imported when it is needed."""


def find_class(method: str, code: Mapping[str, str]) -> type[Config]:
    """The class of the configuration of a method.

    Args:
        method: a name of ``METHODS``; or ``FILE.py``, ``FILE.py:CLASS`` or ``MODULE:CLASS``.
        code: texts of files of a user's, by their origins.

    Raises:
        ConfigError: no such name, file or class, or a class that is none of a configuration.
    """
    if user_code.parse_reference(method) is not None:
        found: type[Config] = user_code.find_class(method, code, Config)
        if found.build is Config.build and not found.made_in:
            raise ConfigError(
                f"{method}: {found.__name__} has no build(self, registry, start_from), which makes the Method"
            )
        return found
    if method not in METHODS:
        raise ConfigError(
            f"method = {method!r}: choose one of {', '.join(METHODS)}, or FILE.py:CLASS{did_you_mean(method, METHODS)}"
        )
    module_name, _, name = METHODS[method].partition(":")
    known: type[Config] = getattr(importlib.import_module(module_name), name)
    return known
