"""Trials: what is recorded of a run, beside what was recorded before; and how it is read."""

import json

import pytest

from benchmarks import trials
from benchmarks.report.results import by_method_and_task, read_all
from benchmarks.reproduce import RESULTS
from benchmarks.trials import run_trial, trial_config
from service.base.errors import TandemError

REGISTRY = RESULTS / "primitives"
SMALL = (
    "run.num_threads=1", "run.total_env_steps=600", "run.evaluation_interval=1", "run.evaluation_episodes=4",
    "run.final_episodes=6", "sac.num_worlds=4", "sac.gradient_steps=2", "sac.batch_size=16",
    "sac.learning_starts=200", "sac.hidden_sizes=[8]",
)  # fmt: skip


def recorded(name):
    """A trial of the table, but for how long a skill was held."""
    found = json.loads((RESULTS / "downstream" / f"{name}.json").read_text())
    del found["cell"]["skill_steps"]
    return found


def keys(tree):
    return {key: keys(value) if isinstance(value, dict) and key != "world" else None for key, value in tree.items()}


@pytest.mark.usefixtures("no_artifacts")
def test_a_run_is_recorded_as_trials_were_before(tmp_path):
    config = trial_config("wall", "ours-her", 0, "panda-cube@seed-30", SMALL)
    result = run_trial(config, REGISTRY, tmp_path / "run")
    before = recorded("wall-ours-her-0")
    assert keys(result) == keys(before)
    assert result["primitives"] == before["primitives"]
    assert [point["env_steps"] for point in result["curve"]] == [200, 400, 600]
    assert result["curve"][0].keys() == before["curve"][0].keys()
    assert (result["env_steps"], result["cell"]["num_env_steps"], result["evaluation"]["num_episodes"]) == (600, 600, 6)
    assert run_trial(config, REGISTRY, tmp_path / "run") == result  # it is there, and is not run again
    other = trial_config("wall", "ours-her", 1, "panda-cube@seed-30", SMALL)
    with pytest.raises(TandemError, match="another configuration"):
        run_trial(other, REGISTRY, tmp_path / "run")


def test_settings_are_those_that_were_recorded():
    for name in ("wall-ours-her-0", "push-scratch-mcp-her-0", "wall-asp-only-0"):
        before = recorded(name)
        task, method, seed = (before["cell"][key] for key in ("task", "method", "seed"))
        begun = trial_config(task, method, seed, "panda-cube@seed-30", ["run.num_threads=1"]).begin(REGISTRY, None)
        result = {"evaluation": {}, "made": {}, "env_steps": 0, "wall_s": 0.0}
        found = trials._recorded(begun, REGISTRY, result, [])
        assert (found["cell"], found["primitives"]) == (before["cell"], before["primitives"])


def test_what_learns_nothing_plays_and_is_recorded(tmp_path, monkeypatch, capsys):
    out = tmp_path / "wall-asp-only-0.json"
    command = ["trials", "wall", "asp-only", "0", "--primitives", "panda-cube@seed-30", "--registry", str(REGISTRY)]
    command += ["--set", "run.final_episodes=40", "--set", "run.num_threads=1", "--out", str(out)]
    monkeypatch.setattr("sys.argv", command)
    assert trials.main() == 0
    (result,) = read_all(tmp_path).values()
    assert keys(result) == keys(recorded("wall-asp-only-0"))
    assert (result["env_steps"], result["curve"], result["evaluation"]["num_episodes"]) == (0, [], 40)
    assert trials.main() == 0
    assert "skipped" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", [*command[:1], "wall", "none", *command[3:-1], str(tmp_path / "other.json")])
    assert trials.main() == 2
    assert "unknown method 'none'" in capsys.readouterr().err


def test_seeds_of_a_method_on_a_task_are_in_order():
    results = [{"cell": {"method": "ours", "task": "wall", "seed": seed}} for seed in (2, 0, 10)]
    found = by_method_and_task([*results, {"cell": {"method": "ours", "task": "box", "seed": 0}}])
    assert [each["cell"]["seed"] for each in found["ours", "wall"]] == [0, 2, 10]
    assert len(found) == 2
