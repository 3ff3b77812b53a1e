"""Recorded skill-discovery runs, and self-play recorded as skills."""

import json

import numpy as np
import pytest

from benchmarks import measuring, record_run, run_files
from benchmarks.report import figures, skills
from service.actors.coverage import skill_paths, visited_share
from service.base.errors import TandemError
from service.config import WorldConfig, parse_config
from service.policies.frozen_skills import FrozenSkills
from service.registry.loading import read_stages
from service.store.run_directory import RunDirectory
from tests.methods.test_skill_run import play, small_config
from tests.runs.runs import TREE
from tests.runs.runs import play as play_rounds


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(record_run, "EPISODE_STEPS", 8)


def test_a_skill_run_is_recorded(tmp_path):
    config = small_config("dads", total_env_steps=400)
    play(tmp_path, config)
    run = record_run.record_skills(RunDirectory(tmp_path), "dads-0", "a test")
    assert (run["name"], run["note"], run["method"], run["config"]["seed"]) == ("dads-0", "a test", "dads", 0)
    assert run["series"]["env_steps"][-1] == 400
    assert {name.partition("/")[0] for name in run["series"]} == {
        "iteration", "env_steps", "time", "evaluation", "skills"
    }  # fmt: skip
    found = run["coverage"]["stages"]
    assert {name: stage.get("env_steps") for name, stage in found.items()} == {
        "random policy": None, "beginning": 0, "middle": 200, "end": 400
    }  # fmt: skip
    newest = FrozenSkills(read_stages(RunDirectory(tmp_path))[400], "dads")
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


def test_a_monolithic_bob_is_refused(tmp_path):
    policy = {"monolithic_bob": {"hidden_sizes": [8]}}
    play_rounds(tmp_path, parse_config(TREE | {"policy": TREE.get("policy", {}) | policy}, where="a test"))
    with pytest.raises(TandemError, match="monolithic Bob, who has no skills"):
        record_run.record_skills(RunDirectory(tmp_path), "none")


# --- the page ---------------------------------------------------------------------------------------------------------


def recorded(method, seed, *shares):
    """A recorded run whose stages have these shares; its random policy has a tenth."""
    path = [0, 0, 25, 40, 40, 25]
    stages = {"random policy": {"shares": [0.1, 0.1], "paths_mm": [path]}}
    for place, (name, share) in enumerate(zip(("beginning", "middle", "end"), shares, strict=True)):
        stages[name] = {"env_steps": 500_000 * place, "shares": [share, share + 0.1], "paths_mm": [path]}
    return {
        "name": f"{method}-{seed}",
        "method": method,
        "config": {"seed": seed, "world": WorldConfig().model_dump(mode="json")},
        "series": {
            "env_steps": [500_000, 1_000_000], "evaluation/coverage": [0.2, 0.4],
            "skills/moved_fraction": [0.1, 0.9], "skills/outside_fraction": [0.0, 0.5],
        },
        "coverage": {"num_skills": 1, "num_steps": 50, "stages": stages},
    }  # fmt: skip


RUNS = [recorded("lsd", 1, 0.1, 0.3, 0.5), recorded("lsd", 0, 0.0, 0.1, 0.3), recorded("ours", 0, 0.2, 0.4, 0.8)]


def test_the_table_of_skills_by_hand():
    assert skills.coverage_table(RUNS).splitlines()[2:] == [
        "| random policy |  |  |  |  | 10 % |",
        "| ours | 1 | 1 M | 25.0 % | 45.0 % | 85.0 % |",
        "| LSD | 2 | 1 M | 10.0 % (5.0, 15.0) | 25.0 % (15.0, 35.0) | 45.0 % (35.0, 55.0) |",
    ]


def test_pictures_of_skills_show_what_was_recorded(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(figures, "save", lambda figure, path: shown.append(figure))
    figures.draw_skills(RUNS, tmp_path)
    figures.draw_skill_curves(RUNS, tmp_path)
    places, (covered, moved, *_) = (figure.axes for figure in shown)
    titles = [axes.get_title() for axes in places if axes.get_visible()]
    assert len(titles) == 1 + 3 + 3  # the random policy, and three stages of the first seed of each method
    assert {
        "random policy\n10% of the table's cells",
        "ours, end: 1 M env steps\n85% of the table's cells, 8.5 x random",
        "LSD, middle: 0.5 M env steps\n15% of the table's cells, 1.5 x random",
    } <= set(titles)
    for axes, values in ((covered, [0.2, 0.4]), (moved, [0.1, 0.9])):
        assert len(axes.lines) == len(RUNS)
        for line in axes.lines:
            np.testing.assert_allclose(line.get_ydata(), values)


def control(name, seed, mixed, wall):
    row = {"policy": "bob", "success_last": mixed}
    trials = {task: {"evaluation": {"success_last": wall}} for task in ("wall", "box", "push")}
    return {
        "control": name,
        "config": {"seed": seed},
        "bob_env_steps": 6_000_000 + 40_000 * seed,
        "series": {"iteration": [100, 1_200 + 200 * seed]},
        "env_steps": 10_000_000,
        "evaluations": [row | {"goals": goals} for goals in ("mixed", "air", "table", "larger")]
        + [{"policy": "idle", "goals": "mixed", "success_last": 0.0}],
        "downstream": trials,
    }


def test_the_table_of_controls_by_hand():
    runs = [control("uniform", 1, 0.5, 0.1), control("uniform", 0, 0.7, 0.2), control("ours", 0, 1.0, 0.9)]
    head, _, ours, uniform = skills.controls_table(runs).splitlines()
    steps = "Bob's env steps | all env steps | updates"
    assert head == f"| goals proposed by | seeds | {steps} | mixed | air | table | Wall | Box | Push |"
    rates = " | ".join([*["100.0 %"] * 3, *["90.0 %"] * 3])
    assert ours == f"| Alice, and her earlier goals | 1 | 6 M | 10 M | 1,200 | {rates} |"
    three = " | ".join(["60.0 % (70.0, 50.0)"] * 3), " | ".join(["15.0 % (20.0, 10.0)"] * 3)
    assert uniform == f"| uniform in the workspace | 2 | 6.02 M | 10 M | 1,300 | {three[0]} | {three[1]} |"


def alike(name, seed, source, mixed, lifted, **more):
    """A recorded run with an evaluation and metrics in the middle of each of ten million env steps."""
    config = parse_config({"seed": seed, "name": name, "generator": {"goal_source": source}}, where="a test")
    series = {
        "env_steps": [1_000_000 * million + 500_000 for million in range(11)],
        "evaluation/mixed_success_last": mixed,
        "evaluation/table_success_last": [0.5] * 11,
        "alice/lifted_fraction": lifted,
    }
    return {"name": name, "config": config.model_dump(mode="json"), "series": series, **more}


def test_runs_of_one_recipe_at_equal_env_steps_by_hand():
    rising = [0.0, 0.1, 0.2, *[0.9] * 7, 0.0]  # what comes after 10 M does not count
    dip = [0.0, 0.1, 0.2, 0.9, 0.9, 0.7, 0.9, 0.9, 0.9, 0.8, 1.0]
    runs = [
        alike("cube-6", 0, "alice", rising, [0.3] * 11),
        alike("other", 0, "table", rising, [0.3] * 11),
        alike("ours-0", 2, "alice", dip, [*[0.3] * 9, 0.01, 0.3], control="ours"),
        alike("uniform-alice-0", 0, "uniform", rising, [0.3] * 11, control="uniform-alice"),
    ]
    assert skills.alike_table(runs).splitlines()[-3:] == [
        "| Alice, and her earlier goals | cube-6 | 0 | 90 % | 50 % | 90 % | 30 % |",
        "| Alice, and her earlier goals | control ours-0 | 2 | 80 % | 50 % | 70 % | 1 % |",
        "| Alice, and uniform in the workspace | control uniform-alice-0 | 0 | 90 % | 50 % | 90 % | 30 % |",
    ]
    assert skills.alike_table(runs[:1]) == ""
