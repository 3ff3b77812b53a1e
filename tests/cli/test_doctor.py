"""What a machine has, told by a command."""

import json
import re

import service
from service.base.errors import TandemError
from service.cli import doctor
from tests.cli.typed import tandem


def asked(*options):
    done = tandem("doctor", *options)
    assert done.exit_code == 0, done.output
    return done.output


def found():
    return {row["what"]: (row["found"], row["to_do"]) for row in json.loads(asked("--json"))}


def test_it_names_what_there_is():
    rows = found()
    assert rows["tandem"][0].startswith(service.__version__)
    assert rows["installed in"][0].endswith("service")
    assert rows["torch"][0].startswith("2.13.")
    assert re.fullmatch(r"\d+ of \d+", rows["cores"][0])
    assert rows["OpenGL"][0] in ("draws", "no")
    assert "OpenGL" in asked()


def test_it_says_what_to_do(monkeypatch):
    def no_opengl(*_):
        raise TandemError("cannot draw: install an OpenGL")

    monkeypatch.setattr("service.envs.rendering.renderer.SceneRenderer", no_opengl)
    monkeypatch.setattr(doctor, "_free_memory_gb", lambda: 0.5)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1e9}))
    monkeypatch.setattr(doctor.os, "sched_getaffinity", lambda process: {0, 1})
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None if name in ("ray", "franky") else True)
    monkeypatch.setattr(doctor.os, "cpu_count", lambda: 64)
    rows = found()
    assert rows["OpenGL"] == ("no", "cannot draw: install an OpenGL")
    assert rows["free memory"] == ("0.5 GB", "a run takes about 1 GB: end other programs")
    assert rows["free disk here"] == ("1.0 GB", "a run takes up to 1 GB")
    assert rows["cores"] == ("2 of 64", "")
    assert rows["extras"][1] == "for more: pip install 'tandem-skills[cluster]'"
