"""JSON and YAML that anybody may have written, read within bounds.

The parsers alone follow wherever a text leads: brackets nested a hundred thousand deep, aliases of YAML that stand for
a billion values, whole numbers that no float holds. What is refused here is refused with one line that says why. How
long a text may be is for the reader of the file to say; YAML is slow, so it has a limit here.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import yaml

from service.base.errors import TandemError, one_line

MAX_DEPTH = 64
"""Groups within groups; a configuration has five."""
MAX_JSON_NUMBER = 10**300
"""Greatest whole number in JSON: greater ones are no floats. States of random generators have 39 digits."""
MAX_YAML_NUMBER = 2**63 - 1
"""Greatest whole number in YAML, which has configurations."""
NAME = r"[a-z0-9][a-z0-9._-]{0,63}"
"""What names are: no slash and no leading dot, so as part of a path none leads elsewhere."""
MAX_YAML_CHARACTERS = 256 * 1024
MAX_YAML_VALUES = 5000
"""Values of a YAML text, those that aliases repeat included; a configuration has 200."""


_Value = TypeVar("_Value")


class ParseError(TandemError):
    """A text is neither JSON nor YAML, or nothing that could be worked with.

    Args:
        where: named in the message.
        reason: why it is refused, in a few words.
    """

    def __init__(self, where: object, reason: str) -> None:
        super().__init__(f"{where}: {reason}; restore it from a copy, or remove it")
        self.reason = reason


def parse_with(parser: Callable[[Any], _Value], text: str | bytes, where: object, kind: str = "JSON") -> _Value:
    """What a parser makes of a text: the one place where texts of others meet a parser.

    Args:
        parser: called with the text, such as ``json.loads`` or the ``model_validate_json`` of a model.
        text: what it parses.
        where: its origin, named in errors.
        kind: what it should be, named in errors.

    Raises:
        ParseError: it is not that.
    """
    try:
        return parser(text)
    except RecursionError:
        raise ParseError(where, _TOO_DEEP) from None
    except MemoryError:  # nothing is wrong with the text
        raise
    except Exception as error:  # beside their own errors whatever they meet: "!!bool x" is a KeyError of PyYAML's
        raise ParseError(where, f"not {kind} ({one_line(str(error), 300)})") from None


def parse_json(text: str | bytes, where: object, *, allow_nan: bool = False) -> Any:
    """The value of a JSON text.

    Args:
        text: bytes are UTF-8, or what else JSON may be in.
        where: its origin, named in errors.
        allow_nan: let NaN and infinity pass, which JSON has no words for but Python's has.

    Raises:
        ParseError: no JSON; or nested too deep, a number that no float holds, or text that is no Unicode.
    """
    tree = parse_with(json.loads, text, where)
    _check(tree, where, MAX_JSON_NUMBER, allow_nan=allow_nan)
    return tree


def parse_yaml(text: str | bytes, where: object) -> Any:
    """The value of a YAML text, of plain types only.

    Args:
        text: bytes are UTF-8 or UTF-16.
        where: its origin, named in errors.

    Raises:
        ParseError: no YAML; or too long, nested too deep, too many values, a number that no float holds, or text that
            is no Unicode.
    """
    if len(text) > MAX_YAML_CHARACTERS:
        raise ParseError(where, f"too long for YAML ({len(text)} characters; {MAX_YAML_CHARACTERS} are the most)")
    tree = parse_with(lambda text: yaml.load(text, _Loader), text, where, "YAML")
    # NaN may pass: the field whose value it is refuses it where it is no good
    _check(tree, where, MAX_YAML_NUMBER, allow_nan=True, max_values=MAX_YAML_VALUES)
    return tree


EXPONENT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+\Z")
"""Numbers such as 1e-3 and 3e6, which PyYAML reads as text, as YAML 1.1 says."""
_TOO_DEEP = f"nested more than {MAX_DEPTH} deep"


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, which refuses a key that is there twice; PyYAML alone takes the last one."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Read one mapping with all that is in it."""
        node: yaml.MappingNode = super().compose_mapping_node(anchor)
        counts = Counter((key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for (_, key), count in counts.items():
            if count > 1:
                raise yaml.YAMLError(f"the key {key!r} is there {count} times")
        return node

    num_merged = 0

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Copy what a mapping merges (``<<``) into it: once for each use, so merges of merges multiply."""
        super().flatten_mapping(node)
        self.num_merged += len(node.value)
        if self.num_merged > 2 * MAX_YAML_VALUES:  # each mapping is counted, and again where it is merged
            raise yaml.YAMLError(f"more than {MAX_YAML_VALUES} values by merging")

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:  # noqa: N803
        """Begin a list or mapping in brackets; PyYAML's time grows with the square of how deep they are."""
        if self.flow_level > MAX_DEPTH:
            raise RecursionError
        super().fetch_flow_collection_start(TokenClass)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", EXPONENT, list("-+0123456789"))


def _check(tree: Any, where: object, greatest: int, *, allow_nan: bool, max_values: float = math.inf) -> None:
    """Refuse what parsers take but no program can use; without recursion, which deep trees would exhaust.

    A value that aliases repeat is looked at as often as it is there.
    """
    level, depth, num_values = [tree], 0, 0
    while level:
        inner: list[Any] = []
        for value in level:
            num_values += 1
            if num_values + len(inner) > max_values:
                raise ParseError(where, f"more than {max_values} values")
            if depth == MAX_DEPTH and isinstance(value, (dict, list, tuple, set)):
                raise ParseError(where, _TOO_DEEP)
            if isinstance(value, dict):
                inner += value
                inner += value.values()
            elif isinstance(value, (list, tuple, set)):
                inner += value
            elif isinstance(value, int) and abs(value) > greatest:
                raise ParseError(where, f"a whole number beyond {greatest:.3g}")
            elif isinstance(value, float) and not allow_nan and not math.isfinite(value):
                raise ParseError(where, f"the number {value}; only finite ones can be used")
            elif isinstance(value, str) and not value.isascii() and any("\ud800" <= each <= "\udfff" for each in value):
                raise ParseError(where, "text that is no Unicode (half of a surrogate pair)")
        level, depth = inner, depth + 1
