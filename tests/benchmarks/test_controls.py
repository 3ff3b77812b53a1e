"""Controls of self-play: what differs from the recipe, and what is recorded."""

import json

import pytest

from benchmarks import controls
from benchmarks.measuring import RECIPE_FILE
from service.config import load_config
from service.runs import train
from tests.runs.runs import TREE, write_yaml


def leaves(tree, prefix=""):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


@pytest.mark.parametrize("name", controls.CONTROLS)
def test_a_control_differs_in_what_it_says(name):
    recipe, control = (
        dict(leaves(each.model_dump(mode="json")))
        for each in (load_config(RECIPE_FILE), controls.control_config(RECIPE_FILE, name, 3, 600, []))
    )
    differing = {key for key in recipe if recipe[key] != control[key]}
    said = {override.partition("=")[0] for override in controls.CONTROLS[name]}
    own_name = set() if name == "ours" else {"name"}  # a run of the recipe itself serves as the control
    assert differing == said | own_name | {"seed", "run.total_env_steps"}
    assert control["run.total_env_steps"] == (1000 if name == "ours" or name.endswith("-alice") else 600)


def test_bobs_env_steps_by_hand():
    records = [{"env_steps": 100, "bob/env_steps_fraction": 0.5}, {"env_steps": 300, "bob/env_steps_fraction": 0.75}]
    assert controls.bob_env_steps(records) == 50 + 150


def test_a_control_is_run_and_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr(controls, "TASKS", ("wall",))
    monkeypatch.setattr(controls, "NUM_EPISODES", 4)
    monkeypatch.setattr(train, "make_artifacts", lambda *arguments: {})  # a video takes half a minute
    recipe = write_yaml(
        tmp_path / "tiny.yaml", TREE | {"generator": TREE.get("generator", {}) | {"replay_invalid": True}}
    )
    run = controls.run_control(controls.control_config(recipe, "uniform", 2, 400, []), "uniform", tmp_path, 7000)
    assert (run["name"], run["control"], run["config"]["seed"]) == ("uniform-2", "uniform", 2)
    assert run["overrides"] == list(controls.CONTROLS["uniform"])
    assert run["env_steps"] == run["bob_env_steps"] >= 400  # Bob is alone
    assert {row["num_episodes"] for row in run["evaluations"]} == {4}
    assert run["downstream"]["wall"]["evaluation"]["num_episodes"] == 4
    assert str(tmp_path) not in json.dumps(run)
