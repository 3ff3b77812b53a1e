"""Recorded skill-discovery runs, and self-play recorded as skills."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import measuring, record_run, run_files
from benchmarks.report.skills import coverage_table, episodes_table, phi_table
from benchmarks.steps_in_phi import steps_in_phi
from service.actors.coverage import skill_paths, visited_share
from service.base.errors import TandemError
from service.config import parse_config
from service.config.skills import SkillsConfig
from service.config.world import WorkspaceConfig
from service.policies.frozen_skills import FrozenSkills
from service.registry.loading import load
from service.store.run_directory import RunDirectory
from tests.methods.test_skill_run import play, small_config
from tests.runs.runs import TREE
from tests.runs.runs import play as play_rounds


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(record_run, "EPISODE_STEPS", 8)
    monkeypatch.setitem(record_run.measure_coverage.__kwdefaults__, "num_sets", 2)


def test_a_skill_run_is_recorded(tmp_path):
    config = small_config("dads", total_env_steps=400)
    play(tmp_path, config)
    run = record_run.record_skills(RunDirectory(tmp_path), "dads-0")
    assert (run["name"], run["method"], run["config"]["seed"]) == ("dads-0", "dads", 0)
    assert run["series"]["env_steps"][-1] == 400
    assert {name.partition("/")[0] for name in run["series"]} == {
        "iteration", "env_steps", "time", "evaluation", "skills", "learner"
    }  # fmt: skip
    kept = {
        f"learner/{name}"
        for name in ("entropy", "entropy_coefficient", "critic_loss", "actor_loss", "representation_loss")
    }
    assert {name for name in run["series"] if name.startswith("learner/")} == kept
    found = run["coverage"]["stages"]
    assert {name: stage.get("env_steps") for name, stage in found.items()} == {
        "random policy": None, "beginning": 0, "middle": 200, "end": 400
    }  # fmt: skip
    newest = FrozenSkills(record_run.read_stages(RunDirectory(tmp_path))[400], SkillsConfig(method="dads"))
    paths = skill_paths(newest, config.world, num_skills=32, num_steps=8, seed=0)
    assert found["end"]["shares"][0] == round(visited_share(paths, config.world.workspace), 4)
    np.testing.assert_allclose(run_files.paths_m(found["end"]), paths[:, ::4], atol=0.0005)
    json.loads(measuring.to_text(run))


def test_self_play_is_recorded_as_skills(tmp_path):
    play_rounds(tmp_path)
    run = record_run.record_skills(RunDirectory(tmp_path), "ours-0")
    assert run["method"] == "ours"
    assert "bob/env_steps_fraction" in run["series"]
    assert not any(name.startswith("alice/") for name in run["series"])


def test_a_published_version_is_recorded_by_its_end():
    champion = load("panda-cube@champion")
    run = record_run.record_skills(champion, "ours-0")
    assert run["config"]["generator"]["goal_source"] == "reached" != champion.config.generator.goal_source
    assert run["primitives_digest"] == champion.digest
    assert run["series"] == {"env_steps": [champion.manifest.metrics["env_steps"]]}
    assert run["coverage"]["stages"].keys() == {run_files.RANDOM, "end"}
    row = coverage_table([run]).splitlines()[-1]
    assert re.fullmatch(r"\| ours \| 1 \| 10 M \|  \|  \| [1-9][\d.]* % \|", row)


def test_a_monolithic_bob_is_refused(tmp_path):
    policy = {"monolithic_bob": {"hidden_sizes": [8]}}
    play_rounds(tmp_path, parse_config(TREE | {"policy": TREE.get("policy", {}) | policy}, where="a test"))
    with pytest.raises(TandemError, match="monolithic Bob, who has no skills"):
        record_run.record_skills(RunDirectory(tmp_path), "none")


def test_what_episodes_do_is_told_for_each_seed():
    """Hand-computed: of 20 points the last two count, and of the swings those from the sixth on."""
    outside = [1.0, *[0.1] * 7, 0.6, *[0.1] * 9, 0.2, 0.4]
    series = {"env_steps": list(range(20)), "skills/outside_fraction": outside}
    series |= {"skills/moved_fraction": [0.0] * 18 + [0.5, 1.0], "skills/lifted_fraction": [1.0] * 18 + [0.0, 0.0]}
    text = episodes_table([{"method": "lsd", "config": {"seed": 3}, "series": series}])
    assert text.splitlines()[-1] == "| LSD | 3 | 75 % | - | 0 % | 30 % | 60 % |"  # raised: not recorded then


def test_steps_in_phi_by_hand():
    """A phi of three times the place along x, four times along y, and half of it along z; a unit is 12 cm."""
    slopes = np.array([[3.0, 0.0, 0.0, 0.0], [0.0, 4.0, 0.0, 0.0], [0.0, 0.0, 0.5, 0.0]], dtype=np.float32)
    skills = SimpleNamespace(network=[(slopes, np.ones(4, dtype=np.float32))])
    found = steps_in_phi(skills, WorkspaceConfig(), num=5)
    assert found["sideways"] == pytest.approx(3.5 * 0.02 / 0.12, rel=1e-4)
    assert found["upward"] == pytest.approx([0.5 * 0.02 / 0.12] * 3, rel=1e-4)
    assert found["table_to_top"] == pytest.approx(0.5 * (0.35 - 0.025) / 0.12, rel=1e-4)
    result = {"heights_m": [0.025, 0.1, 0.2], "skills": [{"method": "lsd", "name": "cube-lsd-7", **found}]}
    assert phi_table(result).splitlines()[-1] == "| LSD | 7 | 0.58 | 0.08 | 0.08 | 0.08 | 1.4 |"
