"""What somebody reads who has not installed an extra."""

import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.base.extras import MissingPackageError, needs_extra
from service.cli.main import app
from tests.runs.runs import assert_one_line

ROOT = Path(__file__).parents[2]


@pytest.fixture
def without(monkeypatch):
    """Make packages missing, and let modules of ours be imported anew."""

    def forget(*packages, ours=()):
        for name in ours:
            monkeypatch.delitem(sys.modules, name, raising=False)
        for name in packages:
            monkeypatch.setitem(sys.modules, name, None)

    return forget


@pytest.mark.parametrize(
    ("package", "ours", "arguments", "said"),
    [
        (
            "fastapi",
            ("status.server", "status.app"),
            ["serve"],
            "tandem serve needs the package fastapi, .*'tandem-skills[serve]'",
        ),
        (
            "h5py",  # said before anything is played, or goals are read
            (),
            ["dataset", "panda-cube@champion", "--out", "some", "--goals", "nowhere"],
            "tandem dataset needs the package h5py, .*'tandem-skills[data]'",
        ),
        (
            "ray",
            (),
            ["pretrain", "--runtime", "ray"],
            "--runtime ray needs the package ray, .*'tandem-skills[cluster]'",
        ),
        (
            "httpx",
            ("registry.client",),
            ["train", "wall", "--registry", "http://127.0.0.1:9"],
            "fetching primitives needs the package httpx, .*'tandem-skills[serve]'",
        ),
    ],
)
def test_a_command_says_which_one_to_install(tmp_path, monkeypatch, without, package, ours, arguments, said):
    monkeypatch.chdir(tmp_path)
    without(package, ours=[f"service.{name}" for name in ours])
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2, result.output
    assert_one_line(result.stderr, "which is not installed: pip install")
    assert re.search(said.replace("[", r"\[").replace("]", r"\]"), result.stderr), result.stderr


def test_every_extra_that_a_command_needs_is_named_somewhere():
    """The others are for benchmarks, tests, docs and learners of one's own: nothing in ``service`` imports them."""
    code = "".join(path.read_text() for path in (ROOT / "service").rglob("*.py"))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r'needs_extra\(\s*"([a-z]+)"', code)) == set(extras) - {"bench", "dev", "docs", "downstream"}


def test_a_module_of_ours_that_is_missing_is_no_extra():
    with pytest.raises(ModuleNotFoundError) as error, needs_extra("serve", "this"):
        import_module("service.nothing")
    assert not isinstance(error.value, MissingPackageError)
    with pytest.raises(MissingPackageError, match=r"^this needs the package nothing, which"), needs_extra("x", "this"):
        import_module("nothing.at.all")
