"""Methods by their names: the class of a run's configuration, which makes the method."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from types import ModuleType

from service.base.errors import ConfigError, did_you_mean
from service.config.run import Config

_TASK = "service.config.task:TaskConfig"
METHODS: Mapping[str, str] = {
    "self-play": "service.config.self_play:SelfPlayConfig",
    "skills": "service.config.skills:SkillDiscoveryConfig",
    "distillation": "service.config.distillation:DistillingConfig",
    "ours": _TASK,
    "ours-her": _TASK,
    "ours-residual-her": _TASK,
    "scratch-monolithic-her": _TASK,
    "scratch-mcp-her": _TASK,
    "scratch-monolithic": _TASK,
    "scratch-mcp": _TASK,
    "lsd": _TASK,
    "dads": _TASK,
    "diayn": _TASK,
    "metra": _TASK,
}
"""Where the class of each method is, as ``MODULE:CLASS``; it is imported when it is needed."""


def find_class(method: str) -> type[Config]:
    """The class of the configuration of a method.

    Args:
        method: a name of ``METHODS``, or ``FILE.py:CLASS``.

    Raises:
        ConfigError: no such name, file or class, or a class that is none of a configuration.
    """
    file, separator, name = method.rpartition(":")
    if not separator:
        if method not in METHODS:
            raise ConfigError(
                f"method = {method!r}: choose one of {', '.join(METHODS)}, or FILE.py:CLASS"
                f"{did_you_mean(method, METHODS)}"
            )
        module_name, _, name = METHODS[method].partition(":")
        module = importlib.import_module(module_name)
    else:
        module = _module_of(Path(file), method)
    found = getattr(module, name, None)
    if not (isinstance(found, type) and issubclass(found, Config)):
        raise ConfigError(f"method = {method!r}: {name} is no class that derives from service.config.Config")
    return found


def exact_name(method: str) -> str:
    """The same name, with the whole path of a file: a run that is resumed elsewhere finds it again."""
    file, separator, name = method.rpartition(":")
    return f"{Path(file).absolute()}:{name}" if separator else method


def _module_of(file: Path, method: str) -> ModuleType:
    """The module of a user's file, imported once under a name of its own."""
    if not file.is_file():
        raise ConfigError(f"method = {method!r}: no file {file}; write FILE.py:CLASS")
    name = f"tandem_method_{sha256(str(file.resolve()).encode()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ConfigError(f"method = {method!r}: {file} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise ConfigError(f"method = {method!r}: {file}: {type(error).__name__}: {error}") from error
    return module
