"""Files of users: how they are named, what is run of them, and how their mistakes are told."""

import sys
from contextlib import nullcontext

import pytest

from service.base.user_code import (
    PRIVATE,
    CodeError,
    Reference,
    changed_since,
    check_members,
    find,
    naming_errors_of,
    parse_reference,
    run,
    text_of,
)
from tests.runs.runs import assert_one_line


def is_int(found):
    return isinstance(found, int)


def found_in(text, name=None, origin="numbers.py"):
    return find(Reference(origin, name), {origin: text}, is_int, "number")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a/b.py", Reference("a/b.py", None)),
        ("a/b.py:LIFT", Reference("a/b.py", "LIFT")),
        ("my.tasks:LIFT", Reference("my.tasks", "LIFT")),
        ("push", None),
        ("panda-cube@champion", None),
        ("b.py:", None),
        (":LIFT", None),
        ("b.py:not a name", None),
    ],
)
def test_what_names_a_file(text, expected):
    assert parse_reference(text) == expected


def test_one_of_a_kind_needs_no_name():
    assert found_in("A = 3\n_B = 4\nC = 'text'") == 3
    assert found_in("A = 3\nB = 4", "B") == 4


@pytest.mark.parametrize(
    ("text", "name", "said"),
    [
        (
            "A = 3\nB = 4",
            None,
            "numbers.py: it has to define one number, and has 2 of them: A, B; write numbers",
        ),
        ("A = 'text'", None, "numbers.py: it has to define one number, and has none"),
        ("A = 3", "B", "numbers.py:B: no number of that name; there is A"),
        ("A = 1\nB = 1 / 0", None, "numbers.py:2: ZeroDivisionError: division by zero"),
        ("A = 1\nB = (", None, "numbers.py:2: SyntaxError: "),
        ("import gone_for_ever", None, "numbers.py:1: ModuleNotFoundError: "),
        ("from . import helper", None, "import with no known parent package; a file stands alone"),
        ("raise KeyError", None, "numbers.py:1: KeyError"),
        ("A = 1\n\neval('(')", None, "numbers.py:3: SyntaxError: "),
    ],
)
def test_what_is_wrong_is_said_with_its_line(text, name, said):
    with pytest.raises(CodeError) as error:
        found_in(text, name)
    assert_one_line(error.value, said)


@pytest.mark.parametrize("text", ["import beside_it\nA = 3", "from beside_it import twice\nA = 3"])
def test_a_file_beside_it_is_refused_though_it_can_be_imported(tmp_path, monkeypatch, text):
    (tmp_path / "beside_it.py").write_text("def twice(x): return 2 * x\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "beside_it", raising=False)
    origin = str(tmp_path / "mine.py")
    with pytest.raises(CodeError) as error:
        run(origin, text)
    assert_one_line(error.value, origin, "it has beside_it from", "a file stands alone")
    assert run(str(tmp_path / "elsewhere" / "mine.py"), text)  # as of what is installed


def test_a_text_runs_once_under_a_name_of_its_own():
    text = "import types\nSEEN = types.SimpleNamespace()\nclass Mine: ...\n"
    one, again, other = (run("once.py", text), run("once.py", text), run("once.py", text + "#"))
    assert one is again
    assert one.SEEN is not other.SEEN
    assert one.Mine.__module__ == one.__name__
    assert one.__name__.startswith(PRIVATE)
    assert "once" not in sys.modules


def test_what_did_not_run_is_told_again():
    """No half of it is left, of which a second try would say that it has nothing."""
    for _ in range(2):
        with pytest.raises(CodeError) as error:
            run("bad.py", "from service.base.errors import TandemError\nraise TandemError('no')")
        assert_one_line(error.value, "bad.py:2: TandemError: no")


def test_the_line_of_an_error_is_that_of_the_file_that_is_blamed():
    module = run("deep.py", "import json\n\ndef read(text):\n    return json.loads(text)\n")
    with pytest.raises(CodeError) as error, naming_errors_of("deep.py"):
        module.read("{")
    assert_one_line(error.value, "deep.py:4: JSONDecodeError: ")


def test_files_and_modules_are_read(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text("A = 1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert text_of("mine.py") == text_of("mine") == "A = 1"
    (tmp_path / "bytes.py").write_bytes(b"\xff\xfe")
    (tmp_path / "long.py").write_text("#" * 1_000_001)
    for origin, said in (
        ("gone.py", "no such file"),
        ("gone", "no module of that name"),
        ("sys", "no module of that name with Python code"),
        ("bytes.py", "no UTF-8 text (invalid"),
        ("long.py", "longer than 40000 bytes; name a shorter file"),
    ):
        with pytest.raises(CodeError) as error:
            text_of(origin)
        assert_one_line(error.value, f"{origin}: ", said)


def test_what_has_changed_since(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("same", "other"):
        (tmp_path / f"{name}.py").write_text("A = 1")
    assert changed_since({"same.py": "A = 1", "other.py": "A = 2", "gone.py": "A = 1"}) == ["other.py"]


def test_a_file_that_ends_the_program_is_told_as_any_error():
    with pytest.raises(CodeError) as error:
        found_in("import sys\nN = 1\nsys.exit(0)\n")
    assert_one_line(error.value, "numbers.py:3: SystemExit: 0")


class Base:
    def step(self): ...
    def measure(self): ...


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ("steps = 3\n    def step(self): ...", None),  # beside the member that it is like
        ("_measur = 3", None),
        ("paid = 3", None),
        ("measur = 3", "Mine.measur is no member of Base; did you mean 'measure'?"),
    ],
)
def test_a_misspelt_member_is_none_that_is_merely_alike(members, said):
    text = f"from tests.base.test_user_code import Base\nclass Mine(Base):\n    {members}"
    with pytest.raises(CodeError, match=said) if said else nullcontext():
        check_members(run("mine.py", text).Mine, Base, ("step", "measure"))


def test_what_a_file_prints_is_no_output_of_the_command(capsys):
    assert found_in("print('loading')\nN = 3\n") == 3
    assert capsys.readouterr() == ("", "loading\n")
