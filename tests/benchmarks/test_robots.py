"""The benchmark of robots by description: what it says of a run."""

import numpy as np
import pytest

from benchmarks.robots import ROBOTS, summarise_run
from service.base.jsonl import read_jsonl
from tests.runs.runs import play, tiny_config


def test_a_run_is_summarised_by_its_end(tmp_path, monkeypatch):
    play(tmp_path, tiny_config(total_env_steps=1200))
    rows = read_jsonl(tmp_path / "metrics.jsonl")
    monkeypatch.setattr("benchmarks.robots.LAST_STEPS", rows[-1]["env_steps"] - rows[2]["env_steps"])
    found = summarise_run(tmp_path)
    assert found["env_steps"] == rows[-1]["env_steps"]
    assert found["success_rate"] == pytest.approx(np.mean([row["bob/success_rate"] for row in rows[3:]]))
    assert found["valid_fraction"] == pytest.approx(np.mean([row["alice/valid_fraction"] for row in rows[3:]]))
    assert found["object"] == "box"


def test_every_description_that_ships_has_a_row_in_the_guide():
    guide = (ROBOTS.parents[1] / "docs" / "robots.md").read_text()
    for path in ROBOTS.glob("*.yaml"):
        assert f"| `{path.name}` |" in guide
