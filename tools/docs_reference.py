"""The pages below ``docs/reference``, made from the code: commands, configuration, public API.

``python -m tools.docs_reference`` writes them; a test tells when they are old.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import re
import textwrap
from collections.abc import Callable, Iterator
from typing import Any, get_args

import annotated_types
import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import tandem_skills
from benchmarks.measuring import ROOT
from service.base.markdown import table
from service.cli.main import app
from service.config import Config, load_config
from service.config.find import METHODS, find_class
from service.config.recipes import DEFAULT_RECIPE, recipes
from service.config.self_play import SelfPlayConfig

SECTIONS = ("Args", "Returns", "Raises", "Yields", "Attributes")
SIGNS = {annotated_types.Ge: ">=", annotated_types.Gt: ">", annotated_types.Le: "<=", annotated_types.Lt: "<"}
RETURNED = (
    ("service.policies.numpy_policy", "NumpyMCPPolicy"),
    ("service.policies.frozen_skills", "FrozenSkills"),
    ("service.runs.train", "Finished"),
)
"""What the public functions return."""


def pages() -> dict[str, str]:
    """Markdown of every page, by its path below ``docs/``."""
    return {"reference/cli.md": commands(), "reference/config.md": configuration(), "reference/api.md": api()}


def commands() -> str:
    """Every command with its arguments and options."""
    parts = ["# Commands and options", "Made from the program; `tandem VERB --help` says the same."]
    for name, command in walk_commands(typer.main.get_command(app), "tandem"):
        context = command.make_context(name, [], resilient_parsing=True)
        usage = " ".join([name, *command.collect_usage_pieces(context)])
        parts += [f"{'#' * min(3, 1 + len(name.split()))} {name}", inspect.cleandoc(command.help or "")]
        if not hasattr(command, "commands"):
            parts.append(f"```text\n{usage}\n```")
        rows = [record for each in command.get_params(context) if (record := each.get_help_record(context))]
        parts.append(table(("option", "meaning"), [(f"`{option}`", prose(text)) for option, text in rows]))
    return "\n\n".join(parts) + "\n"


def walk_commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every command below one, itself first, with its whole name."""
    yield name, command
    for each, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield from walk_commands(below, f"{name} {each}")


def configuration() -> str:
    """Every key of a run's configuration: all of self-play, then what other methods have beside them or otherwise."""
    recipe = load_config(recipes()[DEFAULT_RECIPE])
    parts = [
        "# Configuration",
        "Every key of a run, made from the code. `--set a.b=c` changes one, a YAML file many. "
        f"The column *recipe* says what `{DEFAULT_RECIPE}`, the recipe of a run for which none is named, has instead "
        "of the default. The key `method` says which keys there are: first come those of self-play, and then what "
        "other methods have besides, or with another default. Unknown keys are errors.",
        *_models(SelfPlayConfig, "", recipe),
    ]
    for kind in method_classes()[1:]:
        names = ", ".join(name for name in METHODS if find_class(name, {}) is kind)
        parts += [f"## method: {names}", *list(_models(kind, "", None, SelfPlayConfig))[1:]]
    return "\n\n".join(parts) + "\n"


def method_classes() -> list[type[Config]]:
    """The classes of the configurations of all methods, that of self-play first."""
    return list(dict.fromkeys(find_class(name, {}) for name in METHODS))


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Every key of a model, ``a.b.c``, those of models inside it included."""
    for name, field in model.model_fields.items():
        yield f"{prefix}{name}"
        for inner in _inner(field):
            yield from keys(inner, f"{prefix}{name}.")


def _models(
    model: type[BaseModel], prefix: str, recipe: BaseModel | None, known: type[BaseModel] | None = None
) -> Iterator[str]:
    """A heading and a table of a model's own keys, then those of the models inside it; not those that ``known`` has."""
    others = known.model_fields if known is not None else {}
    fields = {name: each for name, each in model.model_fields.items() if not _same(each, others.get(name))}
    yield f"{'##' if prefix.count('.') < 2 else '###'} {prefix.removesuffix('.') or 'The run'}"
    yield first_line(model)
    rows: list[tuple[str, ...]] = []
    for name, field in fields.items():
        default = _default(field)
        chosen = getattr(recipe, name, field.default)
        differs = recipe is not None and not _inner(field) and chosen != field.get_default(call_default_factory=True)
        shown = _shown(chosen) if differs else ""
        rows.append((f"`{prefix}{name}`", default, shown, _range(field), prose(field.description or "")))
    if recipe is None:
        rows = [(*row[:2], *row[3:]) for row in rows]
        yield table(("key", "default", "range", "meaning"), rows)
    else:
        yield table(("key", "default", "recipe", "range", "meaning"), rows)
    for name, field in fields.items():
        for inner in _inner(field):
            below = getattr(recipe, name, None) if recipe is not None else None
            yield from _models(inner, f"{prefix}{name}.", below if isinstance(below, inner) else None)


def _same(field: FieldInfo, other: FieldInfo | None) -> bool:
    return other is not None and (field.annotation, field.default) == (other.annotation, other.default)


def _inner(field: FieldInfo) -> list[type[BaseModel]]:
    """Models among the types of a field."""

    def models(annotation: Any) -> Iterator[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        for each in get_args(annotation):
            yield from models(each)

    return list(dict.fromkeys(models(field.annotation)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "*required*"
    value = field.get_default(call_default_factory=True)
    return "" if value is PydanticUndefined else _shown(value)


def _shown(value: object) -> str:
    """A value as it is written in YAML."""
    if value is None or isinstance(value, bool):
        return f"`{ {None: 'null', True: 'true', False: 'false'}[value] }`".replace(" ", "")
    if isinstance(value, tuple):
        return f"`[{', '.join(str(each) for each in value)}]`"
    if isinstance(value, BaseModel):
        return "see below"
    return f"`{value}`"


def _range(field: FieldInfo) -> str:
    """Choices and bounds of a field."""
    choices = [repr(each) for each in _literals(field.annotation)]
    bounds = []
    for limit in field.metadata:
        for kind, sign in SIGNS.items():
            if isinstance(limit, kind):
                bounds.append(f"{sign} {getattr(limit, kind.__name__.lower())}")
    return ", ".join(f"`{each}`" for each in [*(each.replace("'", "") for each in choices), *bounds])


def _literals(annotation: Any) -> Iterator[str]:
    for each in get_args(annotation):
        if isinstance(each, str):
            yield each
        else:
            yield from _literals(each)


def api() -> str:
    """Every name of ``tandem_skills``, and what its functions return."""
    ours = {name: getattr(tandem_skills, name) for name in tandem_skills.__all__}
    parts = ["# Python API", "Made from the docstrings. `import tandem_skills as tandem`", "## Functions"]
    for name, function in ours.items():
        if inspect.isfunction(function):
            parts += [f"### tandem.{name}", signature(f"tandem.{name}", function), docstring(function)]
    for title, classes in (
        ("Classes", [each for each in ours.values() if isinstance(each, type)]),
        ("What functions return", [getattr(importlib.import_module(module), name) for module, name in RETURNED]),
    ):
        parts.append(f"## {title}")
        for cls in classes:
            parts += [f"### {cls.__name__}", docstring(cls), "\n".join(_attributes(cls)), *_members(cls)]
    parts += ["## tandem.errors", docstring(tandem_skills.errors)]
    errors = [each for each in vars(tandem_skills.errors).values() if inspect.isclass(each)]
    known = [each for each in errors if issubclass(each, Exception)]
    parts.append("\n".join(f"- `{each.__name__}`: {first_line(each)}" for each in known))
    return "\n\n".join(filter(None, parts)) + "\n"


def _attributes(cls: type) -> Iterator[str]:
    """The fields of a class, with the text below each."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(tree, ast.ClassDef)
    for field, below in itertools.pairwise([*tree.body, ast.Pass()]):
        if isinstance(field, ast.AnnAssign) and not ast.unparse(field.target).startswith("_"):
            said = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            text = f": {prose(str(ast.literal_eval(below.value)))}" if said else ""  # type: ignore[attr-defined]
            yield f"- `{ast.unparse(field)}`{text}"


def _members(cls: type) -> Iterator[str]:
    """Public methods and properties of a class, those of its bases in Tandem included."""
    for base in cls.__mro__:
        if not base.__module__.startswith("service."):
            continue
        for name, member in vars(base).items():
            inherited = base is not cls and name in vars(cls)
            if name.startswith("_") or inherited or not (isinstance(member, property) or inspect.isfunction(member)):
                continue
            function = member.fget if isinstance(member, property) else member
            if function is not None and function.__doc__:
                called = signature(name, function) if inspect.isfunction(member) else ""
                yield "\n\n".join(filter(None, (f"#### {cls.__name__}.{name}", called, docstring(function))))


def signature(name: str, function: Callable[..., object]) -> str:
    """A call as Python writes it, in a block of code."""
    call = inspect.signature(function)
    call = call.replace(parameters=[each for each in call.parameters.values() if each.name != "self"])
    text = f"{name}{_plain(str(call))}"
    if len(text) > 80:
        listed = [_plain(str(each)) for each in call.parameters.values()]
        by_name = [each.kind is each.KEYWORD_ONLY for each in call.parameters.values()]
        if True in by_name:
            listed.insert(by_name.index(True), "*")
        text = "\n".join([f"{name}(", *(f"    {each}," for each in listed), f"){text.rpartition(')')[2]}"])
    return f"```python\n{text}\n```"


def _plain(signature: str) -> str:
    """A signature whose annotations are no strings."""
    return re.sub(r"(: |-> )'([^']*)'", r"\1\2", signature)


def docstring(thing: object) -> str:
    """A Google docstring as Markdown: its sections become lists."""
    text = inspect.getdoc(thing) or ""
    parts: list[str] = []
    for block in re.split(r"\n\n+", text):
        head, _, rest = block.partition(":\n")
        if head in SECTIONS:
            whole = textwrap.dedent(rest)
            items = [re.sub(r"^(\w+): ", r"`\1`: ", prose(item)) for item in re.split(r"\n(?=\S)", whole)]
            listed = prose(whole) if head == "Returns" else "\n".join(f"- {item}" for item in items)
            parts.append(f"**{head}**\n\n{listed}")
        elif block.startswith("- "):
            parts.append("\n".join(prose(item) for item in re.split(r"\n(?=- )", block)))
        else:
            parts.append(prose(block))
    return "\n\n".join(parts)


def first_line(thing: object) -> str:
    """The first line of a docstring."""
    return prose((inspect.getdoc(thing) or "").partition("\n")[0])


def prose(text: str) -> str:
    """Text of a docstring or an option as one line of Markdown."""
    text = re.sub(r":class:`~?([^`]*)`", r"`\1`", text).replace("``", "`")
    return re.sub(r"(?<!`)<(\w+)>", r"`<\1>`", " ".join(text.split()))


if __name__ == "__main__":
    for name, page in pages().items():
        path = ROOT / "docs" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(page, encoding="utf-8")
