"""What somebody has right after ``pip install``: the wheel as it is built, with the primitives in it."""

import json
import os
import re
import shlex
import subprocess
import sys
import sysconfig
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import service
from service.base.errors import TandemError, needs_extra
from service.config import load_config
from service.config.recipes import recipes, robots
from service.policies.numpy_policy import NumpyMCPPolicy
from service.registry.bundled import BUNDLED
from service.registry.manifest import acting_config
from service.registry.registry import Registry
from tests.registry.helpers import files_in
from tools.wheel_in_empty_environment import build_wheel

ROOT = Path(__file__).parents[1]
LOAD = """
import sys
from pathlib import Path
import service
assert "numpy" not in sys.modules
bob = service.load("panda-cube@champion")
assert "torch" not in sys.modules
print(bob.label, Path(service.__file__).parents[1], sep="\\n")
"""


def without_this_checkout():
    """The environment of a process that has to find the installed wheel."""
    return {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "TANDEM_REGISTRY")}


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The place of packages in a new environment with the wheel of this checkout."""
    home = tmp_path_factory.mktemp("wheel")
    wheel = build_wheel(home)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home / "venv"], check=True, timeout=600)
    python = home / "venv" / "bin" / "python"
    install = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel)
    subprocess.run(install, check=True, timeout=600, env=without_this_checkout())
    (site,) = (home / "venv" / "lib").glob("python*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))  # what it depends on; that takes minutes to install
    return site


def run(installed, directory, *arguments, program="python"):
    """A program of the environment with the wheel, in another directory."""
    result = subprocess.run(
        [installed.parents[2] / "bin" / program, *arguments],
        cwd=directory, env=without_this_checkout(), capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_wheel_has_the_primitives_byte_for_byte(installed):
    assert files_in(installed / "service" / "registry" / "data") == files_in(BUNDLED)
    assert (installed / "service" / "py.typed").exists()


def test_what_a_missing_package_asks_for_needs_no_index(installed, tmp_path):
    with pytest.raises(TandemError) as error, needs_extra("play", "this"):
        import_module("nothing.at.all")
    said = re.search(r"pip install .*", str(error.value))
    assert said is not None
    pip = [sys.executable, "-m", "pip", "--python", installed.parents[2] / "bin" / "python"]
    options = ["--no-deps", "--no-index", "--disable-pip-version-check"]
    done = subprocess.run(
        [*pip, *shlex.split(said[0])[1:], *options],
        cwd=tmp_path, env=without_this_checkout(), capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f"already satisfied: tandem-skills[play] in {installed}" in done.stdout


def test_an_installed_tandem_evaluates_them_in_any_directory(installed, tmp_path):
    label, site = run(installed, tmp_path, "-c", LOAD).splitlines()
    assert (label, site) == (f"{Registry(BUNDLED).resolve('panda-cube@champion')} (bundled)", str(installed))
    command = ("evaluate", "panda-cube@champion", "--episodes", "4", "--steps", "2", "--json")
    assert list(json.loads(run(installed, tmp_path, "-m", "service", *command))) == [label, "idle"]
    assert list(tmp_path.iterdir()) == []


def test_loading_the_champion(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bob = service.load()
    manifest, parameters = Registry(BUNDLED).load("panda-cube@champion")
    assert bob.manifest == manifest
    assert bob.config == acting_config(manifest.config, where="the manifest")
    assert bob.config.policy.bob.num_primitives == bob.primitives.num_primitives == 8
    rows = 0.1 * np.random.default_rng(0).standard_normal((5, 14)).astype(np.float32)
    expected = NumpyMCPPolicy(parameters)
    assert np.array_equal(bob.primitives.act_deterministic(rows), expected.act_deterministic(rows))
    with pytest.raises(TandemError, match=r"no 'nobody' in the registry here; .* with tandem comes: panda-cube"):
        service.load("nobody", registry="here")


def test_the_champion_has_what_its_manifest_says():
    """Its rate, which pages repeat, on other goals: not lower than chance explains."""
    from service.actors.evaluation import evaluate
    from service.base.intervals import wilson_interval

    bob, num = service.load(), 60
    said = bob.manifest.metrics["evaluation/mixed_success_last"]
    assert said >= 0.95  # what was asked for
    reach_m = bob.config.game.success_distance_m
    found = evaluate(
        bob.policy, bob.config.world, "mixed", num_episodes=num, num_steps=50, success_distance_m=reach_m, seed=3
    )
    least, _ = wilson_interval(round(said * bob.config.run.final_episodes), bob.config.run.final_episodes)
    _, most = wilson_interval(round(found.success_last * num), num)
    assert most >= least, found.success_last  # of 98 % said, 54 of 60 fail


def test_the_recipes_and_robots_are_in_it(installed, tmp_path):
    assert files_in(installed / "service" / "configs") == files_in(ROOT / "configs") != {}
    assert run(installed, tmp_path, "--version", program="tandem") == f"tandem {service.__version__}\n"
    listed = json.loads(run(installed, tmp_path, "configs", "--json", program="tandem"))
    assert [row["name"] for row in listed] == [*recipes(), *robots()]


SHORT_DEMO = """
import functools, sys
from service.actors import evaluation
from service.runs import train
train.make_artifacts = lambda directory, registry: {}
real = evaluation.evaluate
evaluation.evaluate = lambda *all, **more: real(*all, **more | {"num_episodes": 2, "num_steps": 2})
sys.argv = ["tandem", "demo", "--no-browser", "--env-steps", "1"]
from service.cli.main import main
main()
"""


def test_the_demo_needs_no_checkout(installed, tmp_path):
    said = run(installed, tmp_path, "-c", SHORT_DEMO)
    assert "panda-cube-demo@1 in runs/demo-1/registry" in said
    assert "tandem serve --runs runs" in said
    config = load_config(tmp_path / "runs" / "demo-1" / "config.yaml")
    chosen = [
        "name=panda-cube-demo",
        "run.total_env_steps=1",
        "run.evaluation_interval=60",
        "run.checkpoint_interval=10",
    ]
    assert config == load_config(recipes()["panda-cube"], chosen)


def test_the_web_page_is_in_it(installed):
    page = Path("service") / "status" / "page"
    assert files_in(installed / page) == files_in(ROOT / page) != {}
