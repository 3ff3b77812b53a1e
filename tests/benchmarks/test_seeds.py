"""Several seeds of a recipe: what is measured of each, and the table of them."""

import json
import sys

import pytest

from benchmarks import seeds
from benchmarks.report.pretraining import (
    dips,
    larger_updates,
    other_seeds,
    seeds_block,
    seeds_words,
    why_alice_table,
    why_alice_words,
)
from benchmarks.why_alice import ARMS
from tests.runs.runs import TREE, write_yaml


@pytest.fixture
def command(tmp_path, monkeypatch, no_artifacts):
    """Run the benchmark on a tiny recipe; returns what it wrote."""
    (tmp_path / "configs" / "pretrain").mkdir(parents=True)
    write_yaml(
        tmp_path / "configs" / "pretrain" / "tiny_one.yaml", TREE | {"run": TREE["run"] | {"checkpoint_interval": 1}}
    )
    monkeypatch.setattr(seeds, "ROOT", tmp_path)
    monkeypatch.setattr(seeds, "NUM_EPISODES", 4)
    monkeypatch.setattr(seeds, "NUM_EVALUATED", 2)

    def run(*words):
        given = ["tiny-one", "--runs", str(tmp_path / "runs"), "--json", str(tmp_path / "tiny.json"), *words]
        monkeypatch.setattr(sys, "argv", ["seeds", *given])
        code = seeds.main()
        return code, json.loads((tmp_path / "tiny.json").read_text())

    return run


def test_each_seed_is_measured_at_the_checkpoints_nearest_to_what_is_asked(command, capsys):
    code, found = command("--seeds", "3,4", "--at", "0.0001,0.0006", "--set", "run.evaluation_interval=1")
    assert (code, [run["seed"] for run in found["runs"]]) == (0, [3, 4])
    for run in found["runs"]:
        first, last = run["measured"]
        assert abs(first["env_steps"] - 100) < abs(last["env_steps"] - 100)
        assert last["env_steps"] >= 600
        assert all(set(first[kind]) == {"last", "ever"} for kind in ("mixed", "table", "air", "larger"))
        assert "one" not in first
        assert run["curve"][-1]["env_steps"] == last["env_steps"]
        assert set(run["curve"][-1]) >= {"mixed", "table", "air", "wall_s"}
    assert "seed 4 at 0.00 M: mixed" in capsys.readouterr().out
    again = command("--seeds", "4", "--at", "0.0001,0.0006", "--set", "run.evaluation_interval=1")[1]
    assert again == found  # a seed that the file has is not run again
    code, _ = command("--seeds", "5", "--at", "0.0001", "--set", "game.bob_steps=3")
    assert code == 2
    assert "its seeds had other settings; name another file" in capsys.readouterr().err


def test_dips_are_two_in_a_row_after_four_million():
    rates = [(3.9, 0.1), (4.1, 0.94), (4.2, 0.96), (4.3, 0.90), (4.4, 0.94), (4.5, 0.949), (4.6, 0.95)]
    curve = [{"env_steps": millions * 1e6, "mixed": rate} for millions, rate in rates]
    assert dips(curve) == "2 of 5"  # 0.90 and 0.94, 0.94 and 0.949; not 0.1 and 0.94, which begin earlier


def test_the_table_of_seeds_by_hand():
    def row(asked, mixed):
        return {"asked": asked} | {kind: {"last": mixed} for kind in kinds}

    kinds = ("mixed", "table", "air", "larger")
    lifted = (0.9, 0.1, 0.3, 0.0, 0.2, 0.4)  # of the last five the mean is 0.2
    curve = [{"env_steps": 1e6, "mixed": 0.9, "lifted": share, "wall_s": 2160.0} for share in lifted]
    runs = [
        {"seed": 1, "measured": [row(2e6, 0.95), row(5e6, 0.978)], "curve": curve},
        {"seed": 2, "measured": [row(2e6, 0.949)], "curve": curve[:1]},
    ]
    assert seeds_block({"runs": runs}).splitlines() == [
        "| seed | 2 M: mixed, table, air, *Larger* | 5 M: mixed, table, air, *Larger* | dips | Alice lifts |",
        "| --- | --- | --- | --- | --- |",
        "| 1 | 95.0, 95.0, 95.0, 95.0 | 97.8, 97.8, 97.8, 97.8 |  | 20 % |",
        "| 2 | 94.9, 94.9, 94.9, 94.9 |  |  | 90 % |",
        "",
        "At least 95 % of mixed goals: 1 of 2 at 2 M, 1 of 1 at 5 M env steps.",
    ]
    kinds = ("mixed", "table", "air", "one")  # with two objects
    measured = [row(2e6, 0.929), row(5e6, 0.93)]
    assert seeds_block({"runs": [{"seed": 1, "measured": measured, "curve": curve}]}).splitlines() == [
        "| seed | 2 M: mixed, table, air, one | 5 M: mixed, table, air, one | Alice lifts |",
        "| --- | --- | --- | --- |",
        "| 1 | 92.9, 92.9, 92.9, 92.9 | 93.0, 93.0, 93.0, 93.0 | 20 % |",
        "",
        "At least 93 % of one, 80 % of table, 60 % of air goals: 0 of 1 at 2 M, 1 of 1 at 5 M env steps.",
    ]
    words = seeds_words({"runs": runs})
    assert words.startswith("Runs that solve 95 % of random goals or more (")
    assert "):\n1 of 2 at 2 M, 1 of 1 at 5 M env steps (" in words
    assert words.endswith(" 5 M: 36 to 36 minutes, 36 at the median.")
    for run, day in zip(runs, (27, 28), strict=True):
        run |= {"git_commit": "fb14796" + 33 * "0", "machine": {"time": f"2026-11-{day}T08:00:00"}}
    first, _, head, *_ = other_seeds("panda-cube-paper", {"runs": runs}).splitlines()
    assert first == "`panda-cube-paper`, commit `fb14796`, 2026-11-27, 2026-11-28:"
    assert head.startswith("| seed | 2 M: mixed")


def test_larger_updates_are_beside_the_same_seeds_by_hand():
    def study(num_worlds, rates):
        runs = [
            {"seed": seed, "curve": [{"lifted": 0.5}], "measured": [{"asked": 2e6, "one": {"last": rate}}]}
            for seed, rate in rates.items()
        ]
        return {"runs": runs, "settings": {"recipe": {"game": {"num_worlds": num_worlds}}}}

    assert larger_updates(study(120, {1: 0.2, 2: 0.3}), study(240, {2: 0.4})).splitlines() == [
        "| seed | 2 M: one | Alice lifts |",
        "| --- | --- | --- |",
        "| 2, 120 worlds | 30.0 | 50 % |",
        "| 2, 240 worlds | 40.0 | 50 % |",
    ]


def test_what_alice_is_for_by_hand():
    def study(*rates):
        return {"runs": [{"measured": [{kind: {"last": rate} for kind in seeds.KINDS}]} for rate in rates]}

    some = {"recipe": study(0.98, 0.96, 0.94), "no-cloning": study(0.5)}
    lines = why_alice_table(some).splitlines()
    # the mean, and 4.303 times 0.02 / sqrt(3) to both sides
    assert lines[2].startswith("| the recipe | 96.0 % [91, 100] (3) |")
    assert lines[2].endswith("| 2 of 3 |")
    assert lines[3].startswith("| the recipe, and Bob clones nothing | 50.0 % [47, 53]")
    assert len(lines) == 4
    assert why_alice_words(some) == ""
    words = why_alice_words(dict.fromkeys(ARMS, study(0.1, 0.2)) | some)
    assert "solves 96 % of random goals; 50 % without cloning her turns; 15 % if she earns nothing by" in words
    assert "solves 15 %; 15 % (10 to 20 by seed) if Alice does not learn, 15 % without Alice" in words
    assert words.endswith(" (means of the 3 tuning seeds).")


@pytest.mark.parametrize("name", ARMS)
def test_each_arm_is_a_configuration_that_differs_in_what_it_says(name):
    arm = ARMS[name]
    config, recipe = (seeds.seed_config("panda-cube", 20, 1000, settings) for settings in (arm.settings, ()))
    same = config == recipe
    assert same == (name == "recipe")
    assert (arm.env_steps < 4_000_000) == (not config.game.alice_plays)
