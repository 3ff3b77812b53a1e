"""tandem registry, as typed."""

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import service
from service.cli.registry import registry_app
from service.registry.bundled import BUNDLED
from service.registry.digest import parameters_digest
from service.registry.manifest import parse_manifest
from service.registry.registry import Registry
from tests.cli.typed import assert_refused, tandem
from tests.registry.helpers import Publish, files_in

Run = Callable[..., Any]
BUNDLED_NAMES = ("panda-cube", "panda-cube-robust", "panda-two-cubes")


@pytest.fixture
def run(registry: Registry, publish: Publish) -> Run:
    """Run a command on a registry of two versions."""
    publish(value=1.0, parent=publish())

    return partial(tandem, "registry", TANDEM_REGISTRY=str(registry.root))


def test_list(run: Run) -> None:
    lines = [line.split("\t") for line in run("list").stdout.splitlines()]
    assert lines[0] == ["name", "version", "where", "created", "bytes", "aliases", "parent", "kind"]
    assert [line[:3] for line in lines[1:3]] == [["panda-cube", str(n), "yours"] for n in (1, 2)]
    assert lines[2][5:] == ["latest", "panda-cube@1", "primitives"]
    bundled = [Registry(BUNDLED).resolve(f"{name}@champion") for name in BUNDLED_NAMES]
    assert [line[:3] for line in lines[3:]] == [[each.name, str(each.number), "bundled"] for each in bundled]
    rows = json.loads(run("list", "--json").stdout)
    assert [(row["name"], row["version"], row["aliases"], row["parent"], row["where"]) for row in rows[:2]] == [
        ("panda-cube", 1, [], None, "yours"),
        ("panda-cube", 2, ["latest"], "panda-cube@1", "yours"),
    ]
    assert {row["where"] for row in rows[2:]} == {"bundled"}


def test_list_has_the_other_versions_beside_a_damaged_one(run: Run, registry: Registry) -> None:
    (registry.root / "models/panda-cube/versions/1").write_text("{")
    listed = run("list", "--json")
    assert [row["version"] for row in json.loads(listed.stdout) if row["where"] == "yours"] == [2]
    assert listed.stderr.startswith("panda-cube@1: ")
    assert "damaged" in listed.stderr


@pytest.mark.parametrize("directory", [".", "none"])
def test_list_of_an_empty_registry_has_what_comes_with_tandem(tmp_path: Path, directory: str) -> None:
    path = tmp_path / directory
    result = tandem("registry", "list", "--json", "--registry", path)
    assert result.exit_code == 0
    assert result.stderr == f"nothing published in {path} yet\n"
    rows = json.loads(result.stdout)
    assert [(row["name"], row["aliases"], row["where"]) for row in rows] == [
        (name, ["champion", "latest"], "bundled") for name in BUNDLED_NAMES
    ]
    assert list(tmp_path.iterdir()) == []


def test_what_comes_with_tandem_is_listed_once_shown_verified_and_exported_but_not_changed(tmp_path: Path) -> None:
    run, own = partial(tandem, "registry"), ("--registry", tmp_path / "none")
    assert len(json.loads(run("list", "--json", "--registry", BUNDLED).stdout)) == len(Registry(BUNDLED).names())
    tree = json.loads(run("show", "panda-cube@champion", "--json", *own).stdout)
    assert (tree["name"], tree["aliases"], tree["where"]) == ("panda-cube", ["champion", "latest"], "bundled")
    assert run("verify", "panda-cube", *own).exit_code == 0
    assert run("export", "panda-cube", tmp_path / "out", *own).exit_code == 0
    assert parse_manifest((tmp_path / "out" / "manifest.json").read_bytes(), tmp_path) == Registry(BUNDLED).manifest(
        "panda-cube"
    )
    assert_refused(run("alias", "panda-cube", "best", *own), "cannot write", str(BUNDLED), "only read")
    assert_refused(run("verify", *own), "no registry at", "--registry")


def test_show(run: Run) -> None:
    rows = dict(line.split("\t") for line in run("show", "panda-cube").stdout.splitlines())
    assert rows["reference"] == "panda-cube@2"
    assert (rows["aliases"], rows["where"]) == ("latest", "yours")
    assert rows["tensors.gate.weight"] == "float32 [2, 3]"
    assert rows["config.seed"] == "3"
    rows = dict(line.split("\t") for line in run("show", "panda-cube@champion").stdout.splitlines())
    assert (rows["aliases"], rows["where"]) == ("champion, latest", "bundled")
    tree = json.loads(run("show", "panda-cube@1", "--json").stdout)
    assert (tree["version"], tree["aliases"], tree["metrics"]) == (1, [], {"bob/success_rate": 0.5})


@pytest.mark.parametrize("terminal", [True, False])
def test_tables_on_a_terminal(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    registry_app(["list", "--registry", str(BUNDLED)], standalone_mode=False)
    shown = capsys.readouterr().out
    assert "panda-cube" in shown
    assert ("\t" in shown) is not terminal


def test_alias(run: Run, registry: Registry) -> None:
    assert run("alias", "panda-cube@1", "champion").stdout == "panda-cube@champion is now panda-cube@1\n"
    assert registry.aliases("panda-cube") == {"champion": 1, "latest": 2}


def test_what_is_exported_is_a_version_for_every_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TANDEM_REGISTRY", "none")
    assert tandem("registry", "export", "panda-cube@champion", "given").exit_code == 0
    tree = json.loads(tandem("registry", "show", "given", "--json").stdout)
    champion = Registry(BUNDLED).manifest("panda-cube@champion")
    assert (tree["version"], tree["where"], tree["aliases"]) == (champion.version, "exported", [])
    assert tandem("registry", "verify", "given").exit_code == 0
    assert tandem("registry", "export", "given", "again").exit_code == 0
    assert files_in(tmp_path / "again") == files_in(tmp_path / "given")
    played = [
        json.loads(tandem("evaluate", each, "--episodes", 3, "--steps", 5, "--json").stdout)
        for each in ("given", "./again", "panda-cube@champion")
    ]
    assert played[0] == played[1]
    assert list(played[0]) == [champion.reference, "idle"]
    assert list(played[0].values()) == list(played[2].values())
    assert_refused(tandem("registry", "alias", "given", "best"), "cannot write given", "only read")
    downstream = service.load("given")
    assert parameters_digest(downstream.policy) == parameters_digest(service.load().policy)

    parameters = tmp_path / "given" / "primitives.safetensors"
    parameters.write_bytes(parameters.read_bytes()[:-1] + b"x")
    result = tandem("registry", "verify", "given")
    assert (result.exit_code, result.stderr.count("\n")) == (1, 1)
    result = tandem("evaluate", "given")
    assert result.stderr.startswith("error: given/primitives.safetensors is damaged: expected sha256")
    parameters.unlink()
    assert "given/primitives.safetensors is missing" in tandem("evaluate", "given").stderr
    (tmp_path / "given" / "manifest.json").write_text("{}")
    assert tandem("evaluate", "given").stderr.startswith("error: given/manifest.json")


def test_verify(run: Run, registry: Registry) -> None:
    assert run("verify").exit_code == 0
    assert run("verify", "panda-cube@1").exit_code == 0
    next((registry.root / "blobs" / "sha256").iterdir()).write_bytes(b"")
    result = run("verify")
    assert result.exit_code == 1
    assert "is damaged" in result.stderr


def test_mistakes_are_one_line_and_exit_code_2(run: Run, tmp_path: Path) -> None:
    assert_refused(run("show", "panda-cube@best"), "no alias 'best'", "latest -> 2", "champion -> ")
    assert_refused(run("show", "panda-cup"), "it holds: panda-cube")
    assert_refused(run("alias", "panda-cube", "7"), "bad alias '7'")
    assert_refused(run("verify", "../x"), "bad reference")
    assert_refused(run("show", "nobody", "--registry", str(tmp_path / "none")), "none", "with tandem comes: panda-cube")
    (tmp_path / "manifest.json").write_text("")
    assert_refused(run("export", "panda-cube", str(tmp_path)), "exists")
    assert run("show").exit_code == 2


@pytest.mark.parametrize("command", [["list"], ["show", "tiny"]])
def test_a_service_is_no_directory(command):
    refused = tandem("registry", *command, "--registry", "http://127.0.0.1:9")
    assert_refused(refused, "http://127.0.0.1:9 is a service; give the directory of a registry")
