"""What somebody reads who has not installed an extra."""

import re
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from service.base.errors import TandemError, needs_extra
from tests.cli.typed import assert_refused, tandem
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


WITHOUT = {
    "fastapi": (("status.server", "status.app"), ["serve"], "tandem serve needs", "serve"),
    # said before anything is played, or goals are read
    "h5py": ((), ["dataset", "panda-cube@champion", "--out", "x", "--goals", "y"], "tandem dataset needs", "data"),
    "ray": ((), ["pretrain", "--runtime", "ray"], "--runtime ray needs", "cluster"),
}


@pytest.mark.parametrize("package", WITHOUT)
def test_a_command_says_which_one_to_install(tmp_path, monkeypatch, without, package):
    ours, arguments, said, extra = WITHOUT[package]
    monkeypatch.chdir(tmp_path)
    without(package, ours=[f"service.{name}" for name in ours])
    missing = f"the package {package}, which is not installed"
    assert_refused(tandem(*arguments), said, missing, f"'tandem-skills[{extra}]'")


def test_what_fetches_says_which_one_to_install(without):
    without("httpx", ours=["service.registry.client"])
    with pytest.raises(TandemError) as error:
        import_module("service.registry.client")
    assert_one_line(error.value, "fetching primitives needs the package httpx", "'tandem-skills[serve]'")


def test_every_extra_that_a_command_needs_is_named_somewhere():
    """The others are for benchmarks, tests, docs and learners of one's own: nothing in ``service`` imports them."""
    code = "".join(path.read_text() for path in (ROOT / "service").rglob("*.py"))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r'needs_extra\(\s*"([a-z]+)"', code)) == set(extras) - {"bench", "dev", "docs", "downstream"}


def test_a_module_of_ours_that_is_missing_is_no_extra():
    with pytest.raises(ModuleNotFoundError) as error, needs_extra("serve", "this"):
        import_module("service.nothing")
    assert not isinstance(error.value, TandemError)
    with pytest.raises(TandemError, match=r"^this needs the package nothing, which"), needs_extra("x", "this"):
        import_module("nothing.at.all")
