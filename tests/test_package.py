"""What somebody has right after ``pip install``: the wheel as it is built, with the primitives in it."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import service
from service.config import parse_config
from service.errors import TandemError
from service.policies.numpy_policy import NumpyMCPPolicy
from service.primitives.bundled import BUNDLED
from service.registry.registry import Registry
from tests.registry.helpers import files_in

ROOT = Path(__file__).parents[1]
LOAD = """
import sys
from pathlib import Path
import service
assert "numpy" not in sys.modules
bob = service.load_primitives("panda-cube@champion")
assert "torch" not in sys.modules
print(bob.label, Path(service.__file__).parents[1], sep="\\n")
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Where the wheel of this checkout is unpacked."""
    home = tmp_path_factory.mktemp("wheel")
    source = home / "source"
    shutil.copytree(ROOT / "service", source / "service", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", home, source], check=True, timeout=600
    )
    (wheel,) = home.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(home / "site")
    return home / "site"


def run(installed, directory, *arguments):
    """Python with the unpacked wheel before this checkout, in another directory."""
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    environment.pop("TANDEM_REGISTRY", None)
    result = subprocess.run(
        [sys.executable, *arguments], cwd=directory, env=environment, capture_output=True, text=True, timeout=600
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_wheel_has_the_primitives_byte_for_byte(installed):
    assert files_in(installed / "service" / "primitives" / "data") == files_in(BUNDLED)
    assert (installed / "service" / "py.typed").exists()


def test_an_installed_tandem_evaluates_them_in_any_directory(installed, tmp_path):
    label, site = run(installed, tmp_path, "-c", LOAD).splitlines()
    assert (label, site) == (f"{Registry(BUNDLED).resolve('panda-cube@champion')} (bundled)", str(installed))
    command = ("evaluate", "--primitives", "panda-cube@champion", "--episodes", "4", "--steps", "2", "--json")
    assert list(json.loads(run(installed, tmp_path, "-m", "service", *command))) == [label, "idle"]
    assert list(tmp_path.iterdir()) == []


def test_load_primitives(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bob = service.load_primitives()
    manifest, parameters = Registry(BUNDLED).load("panda-cube@champion")
    assert bob.manifest == manifest
    assert bob.config == parse_config(manifest.config, where="the manifest", recorded=True)
    assert bob.config.policy.bob.num_primitives == bob.primitives.num_primitives == 8
    rows = 0.1 * np.random.default_rng(0).standard_normal((5, 14)).astype(np.float32)
    expected = NumpyMCPPolicy(parameters)
    assert np.array_equal(bob.primitives.act_deterministic(rows), expected.act_deterministic(rows))
    with pytest.raises(TandemError, match=r"no 'nobody' in the registry here; .* with tandem comes: panda-cube"):
        service.load_primitives("nobody", registry="here")


def test_they_do_more_than_nothing():
    """The champion, whichever he is, moves the object to random goals on the table and above it."""
    from service.actors.evaluation import IdlePolicy, evaluate

    bob = service.load_primitives()
    common = {"num_episodes": 60, "num_steps": 50, "success_distance_m": bob.config.game.success_distance_m, "seed": 3}
    champion, idle = (evaluate(policy, bob.config.world, "mixed", **common) for policy in (bob.policy, IdlePolicy()))
    assert champion.success_ever > idle.success_ever + 0.1


def test_the_web_page_is_in_it(installed):
    page = Path("service") / "status" / "page"
    assert files_in(installed / page) == files_in(ROOT / page) != {}
