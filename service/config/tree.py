"""Configurations as plain trees: read from YAML, changed by overrides."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from service.base.errors import ConfigError, did_you_mean, one_line
from service.base.files import read_regular
from service.base.parsing import MAX_YAML_CHARACTERS, ParseError, parse_yaml
from service.config.recipes import recipes, robots


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the tree of a YAML file; see ``config.load_config`` for its errors."""
    try:
        tree = parse_yaml(read_regular(path, MAX_YAML_CHARACTERS, follow=True), path)
    except FileNotFoundError:
        raise ConfigError(
            f"no configuration file {path}; tandem configs lists those that come with tandem"
            f"{did_you_mean(str(path), {**recipes(), **robots()})}"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}; name a YAML file") from None
    except ParseError as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error.reason}") from None
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: expected keys and values, got {type(tree).__name__}; {{}} stands for the defaults")
    return tree


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The keys of a tree as in ``--set``, such as ``learner.bob.gae_lambda``, with their values."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def apply_override(tree: dict[str, Any], override: str) -> None:
    """Apply one ``a.b=c`` string; see ``config.load_config`` for its errors."""
    key, separator, text = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"override {override!r}: expected KEY=VALUE, for example learner.bob.num_epochs=3")
    try:
        value = parse_yaml(text, "its value")
    except ParseError as error:
        raise ConfigError(f"override {one_line(override, 200)!r}: the value is {error.reason}") from None
    group, name = group_of(tree, key.strip(), where=f"override {override!r}")
    group[name] = value


def group_of(tree: dict[str, Any], key: str, *, where: str) -> tuple[dict[str, Any], str]:
    """The group of a dotted key, made if it is not there, and the key's name in it."""
    *parents, name = key.split(".")
    for parent in parents:
        tree = tree.setdefault(parent, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"{where}: {parent!r} is a value, not a group of keys")
    return tree, name
