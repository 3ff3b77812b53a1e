"""The benchmark of robots by description: what it says of a run, and its page."""

import numpy as np
import pytest

from benchmarks.report import robots as page
from benchmarks.robots import ROBOTS, summarise_run, write_frustum
from benchmarks.world_speed import player
from service.errors import TandemError
from service.io.jsonl import read_jsonl
from service.mesh_files import measure
from tests.runtime.runs import assert_one_line, play, tiny_config

MACHINE = {"num_cpus": 2, "cpu": "a processor", "git_commit": "a" * 40, "time": "2026-11-24T10:00:00+00:00"}


def test_a_run_is_summarised_by_its_end(tmp_path, monkeypatch):
    play(tmp_path, tiny_config(total_env_steps=1200))
    rows = read_jsonl(tmp_path / "metrics.jsonl")
    monkeypatch.setattr("benchmarks.robots.LAST_STEPS", rows[-1]["env_steps"] - rows[2]["env_steps"])
    found = summarise_run(tmp_path)
    assert found["env_steps"] == rows[-1]["env_steps"]
    assert found["success_rate"] == pytest.approx(np.mean([row["bob/success_rate"] for row in rows[3:]]))
    assert found["valid_fraction"] == pytest.approx(np.mean([row["alice/valid_fraction"] for row in rows[3:]]))
    assert found["object"] == "box"


def test_the_page_has_a_row_for_each():
    run = {"env_steps": 2_000_000, "valid_fraction": 0.42, "lifted_fraction": 0.3, "success_rate": 0.65}
    speed = {"8": {"median": 0.5}, "240": {"median": 1.25}}
    robots = {
        "one": {"num_joints": 6, "picks": {"num": 100, "held": 99}, "speed_to_panda": speed},
        "other": {"run": run},
    }
    text = page.robots_table({"robots": robots})
    assert "| one | 99 of 100 | 0.50 (0.33) with 8 worlds, 1.25 (0.83) with 240 worlds | not run |" in text
    assert (
        "| other |  |  | after 2.0 M env steps 42 % of Alice's goals are valid and 30 % in the air; Bob reaches 65 % |"
        in text
    )
    assert "aaaaaaa" in page.robots_words({"machine": MACHINE})


def test_the_mesh_of_the_recorded_run_is_a_closed_convex_frustum(tmp_path):
    write_frustum(tmp_path / "frustum.obj")
    found = measure([str(tmp_path / "frustum.obj")], 1.0)
    np.testing.assert_allclose(found.extent_m, (0.06, 0.06 * np.sqrt(3) / 2, 0.045), atol=1e-6)
    below, above = (3 * np.sqrt(3) / 2 * radius**2 for radius in (0.03, 0.022))
    assert found.volume_m3 == pytest.approx(0.045 / 3 * (below + above + np.sqrt(below * above)), rel=1e-4)


def test_a_commit_that_cannot_be_played_is_one_line(tmp_path):
    with player(tmp_path) as broken, pytest.raises(TandemError) as error:
        broken.measure(8, 0.0)
    assert_one_line(error.value, "cannot be played", "exit code 1")


def test_the_page_says_what_descriptions_cost():
    ratios = {"8": {"cpu": 0.97}, "240": {"cpu": 1.02}}
    commits = {"old": "b" * 40, "new": "c" * 40}
    text = page.speed_words({"ratios": ratios, "commits": commits, "settings": {"num_pairs": 7}, "machine": MACHINE})
    assert "0.97 with 8 and 1.02 with 240 worlds" in text
    assert "`ccccccc` by `bbbbbbb`" in text


def test_every_description_that_ships_has_a_row_in_the_guide():
    guide = (ROBOTS.parents[1] / "docs" / "robots.md").read_text()
    for path in ROBOTS.glob("*.yaml"):
        assert f"| `{path.name}` |" in guide
