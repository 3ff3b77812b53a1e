"""JSON and YAML within bounds; what commands make of such texts is in tests/cli/test_attacks.py."""

from itertools import pairwise

import pytest

from service.base.parsing import MAX_DEPTH, ParseError, parse_json, parse_yaml
from tests.runs.runs import assert_one_line


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('{"a": [1, 2.5, null, true, "\\u00e4"]}', {"a": [1, 2.5, None, True, "\u00e4"]}),
        ("[" * MAX_DEPTH + "]" * MAX_DEPTH, None),
        (str(10**300), 10**300),  # states of random generators have 39 digits
    ],
)
def test_json_is_read_as_it_is(text, value):
    found = parse_json(text, "a file")
    assert value is None or found == value
    assert parse_json(text.encode(), "a file") == found


def test_json_of_pythons_own_numbers():
    assert parse_json("[Infinity]", "a file", allow_nan=True) == [float("inf")]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not JSON (Expecting value"),
        (b"\xff", "not JSON ('utf-8' codec"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "nested more than 64 deep"),
        ("[" * 10**6, "nested more than 64 deep"),
        ("9" * 10_000, "not JSON (Exceeds the limit"),
        (str(10**301), "a whole number beyond 1e+300"),
        ("-1e400", "the number -inf"),
        ("[NaN]", "the number nan"),
        ('["\\udfff"]', "text that is no Unicode"),
        ('{"\\ud800": 1}', "text that is no Unicode"),
    ],
)
def test_json_that_is_refused(text, reason):
    with pytest.raises(ParseError) as error:
        parse_json(text, "a file")
    assert_one_line(error.value, f"a file: {reason}")


def test_yaml_with_aliases():
    text = "base: &base {x: 1, y: [1, 2]}\nother: {<<: *base, x: 2}\nagain: *base\n"
    base = {"x": 1, "y": [1, 2]}
    assert parse_yaml(text, "a file") == {"base": base, "other": base | {"x": 2}, "again": base}


def test_yaml_with_exponents():
    text = "[1e-3, 3e6, -2.E+4, '1e5', 6e82ca6f, 1e5.npz, 2e2-cubes, e5]"
    assert parse_yaml(text, "a file") == [0.001, 3e6, -2e4, "1e5", "6e82ca6f", "1e5.npz", "2e2-cubes", "e5"]


def test_yaml_of_nothing():
    assert parse_yaml(b"# nothing\n", "a file") is None


NAMES = "abcdefgh"
LAUGHS = "a: &a [x, x, x]\n" + "".join(
    f"{name}: &{name} [*{last}, *{last}, *{last}, *{last}]\n" for last, name in pairwise(NAMES)
)


MERGED = "a0: &a0 {x: 1}\n" + "".join(
    f"a{level}: &a{level} {{<<: [{', '.join([f'*a{level - 1}'] * 9)}]}}\n" for level in range(1, 10)
)


WIDE = f"a: &a {{{', '.join(f'k{number}: 1' for number in range(2000))}}}\nb: {{<<: [{', '.join(['*a'] * 4000)}]}}\n"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: [1", "not YAML (while parsing a flow sequence"),
        (b"\x00", "not YAML (unacceptable character"),
        ("x" * 300_000, "too long for YAML (300000 characters"),
        ("- " * 100_000, "nested more than 64 deep"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "nested more than 64 deep"),
        (LAUGHS, "more than 5000 values"),
        (MERGED, "not YAML (more than 5000 values by merging)"),
        (WIDE, "not YAML (more than 5000 values by merging)"),
        ("a: &a {b: {c: *a}}", "nested more than 64 deep"),
        ("!!python/object/apply:os.system [id]", "not YAML (could not determine a constructor"),
        ("!!bool x", "not YAML ('x')"),
        ("2026-02-30", "not YAML (day is out of range"),
        ("0x" + "f" * 20, "a whole number beyond 9.22e+18"),
        ("9" * 10_000, "not YAML (Exceeds the limit"),
        ('"\\ud800"', "text that is no Unicode"),
        ("name: x\nseed: 1\nname: y\n", "not YAML (the key 'name' is there 2 times)"),
        ("game: {a: 1, b: {c: 2, 'c': 3}}", "not YAML (the key 'c' is there 2 times)"),
    ],
)
def test_yaml_that_is_refused(text, reason):
    with pytest.raises(ParseError) as error:
        parse_yaml(text, "a file")
    assert_one_line(error.value, f"a file: {reason}")


def test_aliases_may_repeat_as_much_as_is_allowed():
    """Aliases count for all that they stand for, and not for more."""
    tens = "[1, 1, 1, 1, 1, 1, 1, 1, 1]"  # with the list itself ten values
    repeated = f"- &a {tens}\n" + "- *a\n" * 498
    assert len(parse_yaml(repeated, "a file")) == 499
    with pytest.raises(ParseError, match="5000"):
        parse_yaml(repeated + "- *a\n- *a\n", "a file")
