"""Reading configurations: YAML, ``--set a.b=c``, and the class that the method's name stands for."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError

from service.base.errors import ConfigError, did_you_mean
from service.base.parsing import EXPONENT
from service.base.user_code import parse_reference, recorded
from service.config.find import METHODS, find_class
from service.config.frozen import NO_KEYS, first_error, first_of
from service.config.run import Config
from service.config.tree import apply_override, read_yaml


def load_config(
    path: Path | str | None = None,
    overrides: Sequence[str] = (),
    code: Mapping[str, str] | None = None,
    name: str | None = None,
) -> Config:
    """Read a run's configuration.

    Args:
        path: YAML file; None for the defaults.
        overrides: ``a.b=c`` strings, applied in order; the value is parsed as YAML.
        code: texts that a run has recorded, which stand for those that the files of a user's have now.
        name: of a file that says none, nor do the overrides; None: the file's own.

    Raises:
        ConfigError: file missing or not YAML, unknown key, value out of range; one line a user can act on.
    """
    tree = read_yaml(Path(path)) if path is not None else {}
    for override in overrides:
        apply_override(tree, override)
    if path is not None and not tree.keys() & {"name", "task"}:  # or else it is published as one of ours
        tree["name"] = name or _name_of(Path(path))
    if code:
        tree.setdefault("code", dict(code))
    if path is None:
        return parse_config(tree, where="the overrides")
    return parse_config(tree, where=f"{path} and the overrides" if overrides else str(path))


def parse_config(tree: dict[str, Any], *, where: str) -> Config:
    """Validate a plain tree.

    Args:
        tree: nested as the class of its ``method``; without one that of self-play.
        where: its origin, named in errors.

    Raises:
        ConfigError: unknown method or key, or value out of range.
    """
    method = tree.get("method", "self-play")
    if not isinstance(method, str):
        raise ConfigError(f"{where}: method = {method!r}: expected a name")
    given = tree.get("code")
    code = given if isinstance(given, dict) else {}
    try:
        texts = recorded(method, code)
        kind = find_class(method, texts)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    if texts is not code:
        tree = {**tree, "code": texts}
    if (reference := parse_reference(method)) is not None:
        if "task" in tree and "task" not in kind.model_fields:
            raise ConfigError(f"{where}: {method} learns no task: leave out task = {tree['task']!r}")
        if "name" not in tree and kind.model_fields["name"].default == Config.model_fields["name"].default:
            is_file = reference.origin.endswith(".py")
            file = Path(reference.origin if is_file else reference.origin.rpartition(".")[2])
            tree = {**tree, "name": _name_of(file)}
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(f"{where}: {explained(error, kind)}") from None


def explained(error: ValidationError, kind: type[BaseModel]) -> str:
    """The first thing that is wrong with the tree of a model; of an unknown key, too, which are known there."""
    first = first_of(error)
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "extra_forbidden":
        *groups, name = (part for part in first["loc"] if isinstance(part, str) and part not in NO_KEYS)
        prefix, keys = "".join(f"{group}." for group in groups), list(_keys(kind))
        known = sorted(name for before, name in keys if before == prefix)
        meant = _elsewhere(keys, groups, name, kind) or did_you_mean(name, known)
        more = f"; known there: {', '.join(known)}{more}{meant}"
    return f"{first_error(error)}{more}"


def changed_config(config: Config, overrides: Sequence[str]) -> Config:
    """The same configuration with ``a.b=c`` overrides applied in order.

    Raises:
        ConfigError: see ``load_config``.
    """
    tree = config.model_dump(mode="json")
    for override in overrides:
        apply_override(tree, override)
    return parse_config(tree, where="the overrides")


def dump_config(config: Config) -> str:
    """The resolved configuration as YAML that ``load_config`` reads back to an equal object."""
    text: str = yaml.dump(config.model_dump(mode="json"), Dumper=_Dumper, sort_keys=False)
    return text


def _name_of(file: Path) -> str:
    """The name of a file as a name of the registry."""
    return re.sub(r"[^a-z0-9]+", "-", file.stem.lower()).strip("-")[:64] or "run"


class _Dumper(yaml.SafeDumper):
    """Writes texts of several lines as they are."""


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", EXPONENT, list("-+0123456789"))  # a text like that: in quotes
_Dumper.add_representer(
    str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, "|" if "\n" in text else None)
)


def _keys(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, str]]:
    """All keys of a model and of its groups, each after the groups that it is in, such as ``learner.bob.``."""
    for name, field in model.model_fields.items():
        yield prefix, name
        group = _group_in(field.annotation)
        if group is not None:
            yield from _keys(group, f"{prefix}{name}.")


def _elsewhere(keys: Sequence[tuple[str, str]], groups: Sequence[str], name: str, kind: type[BaseModel]) -> str:
    """The end of a message about a key that is not in its groups, where another group or method has it."""
    above, own = "".join(f"{group}." for group in groups[:-1]), "".join(groups[-1:])
    near = [above + other for prefix, other in keys if prefix == above and other in (f"{own}_{name}", name)]
    found = near or sorted(prefix + name for prefix, other in keys if other == name)
    if found:
        return f"; did you mean {' or '.join(found)}?"
    if not issubclass(kind, Config):
        return ""
    others: dict[type[Config], str] = {}  # one method of each class
    for method in METHODS:
        if name in (other := find_class(method, {})).model_fields:
            others.setdefault(other, method)
    return f"; it is a key of method={' and '.join(others.values())}" if others else ""


def _group_in(annotation: Any) -> type[BaseModel] | None:
    """The group of keys that an annotation has: itself, or in a union or a tuple."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for each in get_args(annotation) if (found := _group_in(each)) is not None), None)
