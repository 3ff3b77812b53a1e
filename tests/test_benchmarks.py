"""The benchmarks on tiny settings: they run, count right and repeat the same physics. Nothing here asserts a time."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks import (
    compare_commits,
    env_throughput,
    measuring,
    record_run,
    run_files,
    time_to_skill,
)
from benchmarks.measuring import Sample
from benchmarks.report.figures import quantiles
from service.actors.coverage import RandomPolicy, composition_paths, visited_share
from service.base.errors import TandemError
from service.base.jsonl import JsonlWriter
from service.config import WorldConfig, dump_config, load_config
from service.envs.gym.registration import TABLETOP_ID
from service.learner.learner import Learner
from service.policies.numpy_policy import numpy_bob
from service.registry.bundled import BUNDLED
from service.registry.loading import load
from service.registry.registry import Registry
from service.runs.train import open_run
from service.store.run_directory import RunDirectory
from service.store.run_history import RunHistory
from tests.runs.runs import tiny_config

ROOT = Path(__file__).parents[1]

# --- measuring --------------------------------------------------------------------------------------------------------


def test_ratios_are_taken_pair_by_pair():
    ours = [Sample(100, 1.0, 2.0), Sample(100, 2.0, 2.0), Sample(900, 1.0, 4.0)]
    theirs = [Sample(50, 1.0, 1.0), Sample(10, 1.0, 1.0), Sample(100, 1.0, 1.0)]
    # wall: 100/50, 50/10, 900/100; CPU: 50/50, 50/10, 225/100
    assert measuring.ratio(ours, theirs) == {"median": 5.0, "least": 2.0, "greatest": 9.0, "cpu": 2.25}
    rates = measuring.rates(ours)
    assert (rates["env_steps_per_s"], rates["env_steps_per_cpu_s"], rates["num_steps"]) == (100.0, 50.0, 1100)


def test_measuring_plays_at_least_once_and_counts_every_step():
    assert measuring.measure(lambda: 7, 0.0).num_steps == 7
    sample = measuring.measure(lambda: 7, 0.002)
    assert sample.num_steps > 7
    assert sample.num_steps % 7 == 0
    assert sample.wall_s >= 0.002


def test_json_has_plain_lists_on_one_line_and_reads_back():
    value = {"a": [1, 2.5, None], "b": [{"c": []}, [1, [2, 3]]], "d": "x"}
    text = measuring.to_text(value)
    assert json.loads(text) == value
    assert ' "a": [ 1, 2.5, null ]' in text
    with pytest.raises(ValueError, match="JSON"):
        measuring.to_text({"a": float("nan")})


@dataclass(frozen=True)
class Some:
    """Settings of every kind."""

    many: tuple[str, ...]
    one: int = 3
    two_words: bool = False
    repeated: tuple[str, ...] = ()


def test_settings_come_from_the_command_line(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["some", "a", "b"])
    assert measuring.read_settings(None, Some) == (Some(("a", "b")), None)
    file = tmp_path / "out.json"
    words = ["--one", "4", "--two-words", "--repeated", "x", "--repeated", "y", "--json", str(file)]
    monkeypatch.setattr(sys, "argv", ["some", "a", *words])
    assert measuring.read_settings(None, Some) == (Some(("a",), 4, True, ("x", "y")), file)


def test_a_benchmark_writes_what_it_measured_and_may_fail(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "argv", ["some", "a", "--json", str(tmp_path / "out.json")])

    def measured(settings):
        return {"found": settings.one}

    assert measuring.run_benchmark("some", None, Some, measured, str, lambda result: result["found"] == 3) == 1
    written = json.loads((tmp_path / "out.json").read_text())
    assert (written["benchmark"], written["found"], written["settings"]["many"]) == ("some", 3, ["a"])
    assert "'found': 3" in capsys.readouterr().out


# --- env throughput ---------------------------------------------------------------------------------------------------


def test_env_throughput_measures_all_rows_in_turn():
    rows = {
        env_throughput.BATCH: env_throughput.BatchContender(WorldConfig(), 3, num_steps=2),
        env_throughput.PANDA_GYM_IDS[0]: env_throughput.GymnasiumContender(TABLETOP_ID, num_steps=2),
    }
    assert [row.episode() for row in rows.values()] == [6, 2]
    result = env_throughput.measure_rows(rows, env_throughput.Settings(num_pairs=2, seconds=0.0))
    assert [row["num_steps"] for row in result["rows"].values()] == [12, 4]
    assert list(result["ratios"]) == ["tandem / PandaPickAndPlace-v3"]
    assert all(value > 0.0 for value in result["ratios"]["tandem / PandaPickAndPlace-v3"].values())
    assert measuring.rates_table(result["rows"]).count("\n") == 3
    json.loads(measuring.to_text(result))


@pytest.mark.parametrize("config", [WorldConfig(), WorldConfig(objects=("cube", "cube"))], ids=["one", "two"])
def test_only_grasping_arms_lift_the_object(config):
    heights = []
    for grasping in (False, True):
        batch = env_throughput.BatchContender(config, 12, grasping=grasping)
        batch.episode()
        heights.append(batch._worlds.object_position[:, 2].max())
    assert heights[0] < 0.04  # at rest the centre of the cube is 0.025 m high
    assert heights[1] > 0.06


def test_without_panda_gym_one_line_says_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "panda_gym", None)
    monkeypatch.setattr(sys, "argv", ["env_throughput.py", "--num-worlds", "1"])
    given = (env_throughput.Settings, env_throughput.benchmark, env_throughput.report)
    assert measuring.run_benchmark("env_throughput", None, *given) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "make bench" in error


def test_panda_gym_plays_where_it_is_installed():
    pytest.importorskip("panda_gym", reason="needs panda-gym: pip install -e '.[bench]'")
    contender = env_throughput.panda_gym(env_throughput.PANDA_GYM_IDS[0])
    assert 1 <= contender.episode() <= env_throughput.EPISODE_STEPS  # it ends with success, by a goal that is near


# --- time to skill ----------------------------------------------------------------------------------------------------


def test_the_first_of_three_in_a_row():
    rates = [0.5, 0.9, 0.95, 0.8, 0.9, 0.91, 0.92, 0.99]
    assert time_to_skill.first_in_a_row(rates) == 4
    assert time_to_skill.first_in_a_row(rates[:6]) is None
    assert time_to_skill.first_in_a_row([]) is None


def test_a_seed_ends_when_it_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(time_to_skill, "SHARE", 0.0)
    (tmp_path / "tiny.yaml").write_text(dump_config(tiny_config(evaluation_interval=1)))
    run = time_to_skill.run_seed(tmp_path / "tiny.yaml", [], 3, 1_000_000)
    assert (run["seed"], run["reached"], run["at"]) == (3, True, run["curve"][0])
    assert len(run["curve"]) >= 3
    assert run["curve"][0]["wall_s"] <= run["curve"][2]["wall_s"]


def test_a_seed_that_was_there_is_not_run_again(tmp_path, monkeypatch, capsys):
    file = tmp_path / "out.json"
    asked = []

    def run_seed(recipe, settings, seed, budget):
        asked.append((seed, budget))
        at = {"wall_s": 60.0, "cpu_s": 60.0, "env_steps": 1e6, "iteration": 9}
        there = seed != 4
        curve = [at, at | {"wall_s": 90.0}, at | {"wall_s": 120.0}]
        return {"seed": seed, "reached": there, "max_env_steps": budget, "at": at if there else None, "curve": curve}

    def command(*words):
        monkeypatch.setattr(sys, "argv", ["time_to_skill", "--json", str(file), *words])
        return time_to_skill.main()

    monkeypatch.setattr(time_to_skill, "run_seed", run_seed)
    assert command("--seeds", "3-4", "--max-env-steps", "100") == 0
    assert command("--seeds", "2-4", "--max-env-steps", "200") == 0
    assert asked == [(3, 100), (4, 100), (2, 200), (4, 200)]  # seed 4 was not there within fewer
    assert [run["seed"] for run in json.loads(file.read_text())["runs"]] == [2, 3, 4]
    printed = capsys.readouterr().out
    assert "| 3 | 1.0 | 2.0 | 1.00 M | 9 | 1.0 |" in printed
    assert "Median: 1.0 minutes" in printed
    assert command("--set", "game.bob_steps=3") == 2
    assert "something else as set, recipe; name another file" in capsys.readouterr().err


# --- recorded runs ----------------------------------------------------------------------------------------------------


def _run_directory(path, num_iterations=700):
    (path / "run").mkdir(parents=True)
    directory = RunDirectory(path / "run")
    directory.config_file.write_text(dump_config(load_config()))
    RunHistory.new().write(directory.path)
    metrics, goals = JsonlWriter(directory.metrics_file), JsonlWriter(directory.goals_file)
    for index in range(1, num_iterations + 1):
        share = index / num_iterations
        record = {
            "iteration": index,
            "env_steps": 10_000 * index,
            "time/wall_s": 1.5 * index,
            "alice/valid_fraction": share,
            "alice/lifted_fraction": share / 10,
            "alice/goal_distance_m": 0.08 + 0.06 * share,
            "alice/goal_height_p90_m": 0.03 + 0.1 * share,
            "bob/success_rate": 0.5,
            "learner/bob_std": 0.3,
        }
        if index % 20 == 0:
            record |= {f"evaluation/{kind}_success_last": share for kind in ("table", "air", "mixed")}
        metrics.append(record)
        goal = [0.0, 0.0, 0.025, 0.1, share / 10, 0.025, index % 2]
        goals.append({"iteration": index, "env_steps": 10_000 * index, "goals": [goal] * (index % 4)})
    return directory


def _record(path, name="cube-0", **more):
    record = record_run.record_run(_run_directory(path), name) | {"evaluations": [], "coverage": None} | more
    measuring.write_json(path / f"{name}.json", record)
    return path / f"{name}.json"


def test_a_run_is_thinned_by_hand_computed_means():
    records = [{"iteration": i, "env_steps": 10 * i, "a": float(i)} for i in range(1, 8)]
    records[0]["b"], records[6]["b"] = 3.0, float("nan")
    series = run_files.thin(records, max_points=3)  # blocks of 3, 2 and 2
    assert series == {"env_steps": [30, 50, 70], "iteration": [3, 5, 7], "a": [2.0, 4.5, 6.5], "b": [3.0, None, None]}
    assert run_files.unthin(series)[:2] == [
        {"env_steps": 30, "iteration": 3, "a": 2.0, "b": 3.0},
        {"env_steps": 50, "iteration": 5, "a": 4.5},
    ]


def test_bins_by_hand():
    steps_and_values = ((1, 1.0), (4, 3.0), (9, 5.0), (10, None))
    records = [{"env_steps": steps, "time/wall_s": 11 - steps, "a": value} for steps, value in steps_and_values]
    np.testing.assert_array_equal(run_files.binned(records, "a", 5), [1.0, np.nan, 3.0, np.nan, 5.0])
    over_time = run_files.binned(records, "a", 2, over="time/wall_s")  # 10, 7, 2 and 1 of 10 seconds
    np.testing.assert_array_equal(over_time, [5.0, 2.0])


def test_env_steps_until_a_level_by_hand():
    records = [{"env_steps": 10 * i, "a": a} for i, a in enumerate((0.2, 1.0, 0.6, None, 0.8, 0.7), start=1)]
    for record in records:
        if record["a"] is None:  # not evaluated there
            del record["a"]
    assert run_files.steps_until(records, "a", 0.8, num_in_a_row=1) == 20
    # (0.2 + 1.0 + 0.6) / 3 = 0.6, (1.0 + 0.6 + 0.8) / 3 = 0.8
    assert run_files.steps_until(records, "a", 0.6) == 30
    assert run_files.steps_until(records, "a", 0.79) == 50
    assert run_files.steps_until(records, "a", 0.9) is None
    assert run_files.steps_until(records[:2], "a", 0.1) is None


def test_a_recorded_run_is_small_and_whole(tmp_path):
    path = _record(tmp_path)
    record = json.loads(path.read_text())
    assert path.stat().st_size < 400_000
    assert {len(values) for values in record["series"].values()} == {run_files.MAX_POINTS}
    assert record["series"]["iteration"][-1] == 700
    assert sum(value is not None for value in record["series"]["evaluation/table_success_last"]) == 35
    assert len(record["goals"]) == record_run.GOAL_RECORDS
    assert {len(each["goals"]) for each in record["goals"]} == {record_run.GOALS_EACH}
    assert record["goals"][-1]["env_steps"] == 7_000_000
    assert record["curriculum"]["env_steps"] == 7_000_000
    assert np.sum(record["curriculum"]["height"]["goals"]) == 175 * (0 + 1 + 2 + 3)
    assert load_config().model_dump(mode="json") == record["config"]


def test_goals_are_counted_by_hand():
    rest = 0.025
    records = [
        {"env_steps": 30, "goals": [[0, 0, rest, 0.06, 0, rest - 1e-4, 1], [0, 0, rest, 0.06, 0, rest, 0]]},
        {"env_steps": 60, "goals": []},
        # 7.6 cm up; as high and far as can be; and one that is not finite
        {"env_steps": 300, "goals": [[0, 0, rest, 0, 0, rest + 0.076, 1], [0, 0, rest, 9, 0, 9, 0], [None] * 7]},
    ]
    counts = record_run.count_goals(records, rest)
    height, distance = counts["height"], counts["distance"]
    assert np.shape(height["goals"]) == (record_run.NUM_SLICES, record_run.NUM_BINS["height"])
    assert np.shape(distance["solved"]) == (record_run.NUM_SLICES, record_run.NUM_BINS["distance"])
    assert {place: height["goals"][place[0]][place[1]] for place in zip(*np.nonzero(height["goals"]), strict=True)} == {
        (3, 0): 2,
        (29, 3): 1,
        (29, 12): 1,
    }
    assert list(zip(*np.nonzero(height["solved"]), strict=True)) == [(3, 0), (29, 3)]
    # 6 cm is in the third bin of 2.5 cm, 7.6 cm in the fourth
    assert list(zip(*np.nonzero(distance["goals"]), strict=True)) == [(3, 2), (29, 3), (29, 15)]
    assert counts["env_steps"] == 300


def test_quantiles_by_hand():
    counts = np.array([[0, 4, 4, 0], [2, 0, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_allclose(quantiles(counts, 0.5), [0.05, 0.0125, np.nan])
    np.testing.assert_allclose(quantiles(counts, 0.25), [0.0375, 0.00625, np.nan])


# --- what is measured of a run ----------------------------------------------------------------------------------------


def test_stages_are_the_nearest_snapshots():
    assert record_run.pick_stages([0, 12, 31, 44, 60]) == {"beginning": 0, "middle": 31, "end": 60}
    assert record_run.pick_stages({60: "b", 4: "a"}) == {"middle": 4, "end": 60}
    assert record_run.pick_stages([60]) == {"end": 60}


def test_coverage_is_measured_at_each_stage_beside_a_random_policy():
    config = load_config()
    untrained, other = (Learner(config.model_copy(update={"seed": seed})).weights().bob for seed in (0, 1))
    _, champion = Registry(BUNDLED).load("panda-cube@champion")
    bobs = {0: untrained, 500: champion, 900: other}
    found = record_run.measure_coverage(bobs, config, num_sets=2, num_steps=12)
    assert {name: stage.get("env_steps") for name, stage in found["stages"].items()} == {
        "random policy": None, "beginning": 0, "middle": 500, "end": 900,
    }  # fmt: skip
    policies = [RandomPolicy(), *map(numpy_bob, bobs.values())]
    for policy, stage in zip(policies, found["stages"].values(), strict=True):
        paths = [
            composition_paths(policy, config.world, num_skills=32, num_steps=12, seed=seed, num_threads=1)
            for seed in (0, 1)
        ]
        assert stage["shares"] == [round(visited_share(each, config.world.workspace), 4) for each in paths]
        assert run_files.mean_share(stage) == np.mean(stage["shares"])
        np.testing.assert_allclose(run_files.paths_m(stage), paths[0][:, ::4], atol=0.0005)
    assert len({tuple(stage["shares"]) for stage in found["stages"].values()}) == 4  # no policy stands for another
    json.loads(measuring.to_text(found))


def test_a_monolithic_bob_has_no_coverage():
    config = load_config(None, ["policy.monolithic_bob={hidden_sizes: [8]}"])
    assert record_run.measure_coverage({5: Learner(config).weights().bob}, config, num_sets=1, num_steps=1) is None


def test_a_run_is_measured_from_its_snapshots_and_its_checkpoint(tmp_path, monkeypatch):
    config = tiny_config(total_env_steps=600)
    run = open_run(config, RunDirectory(tmp_path))
    run.run(lambda metrics: run.request_stop() if metrics["iteration"] == 3 else None)
    run.directory.close()
    seen = np.random.default_rng(0).normal(size=(8, 14)).astype(np.float32)

    def acts(bob):
        return bob.act_deterministic(seen).tolist()

    monkeypatch.setattr(record_run, "measure_tasks", lambda bob, config: [acts(bob)])
    monkeypatch.setattr(
        record_run, "measure_coverage", lambda bobs, _: {at: acts(numpy_bob(bob)) for at, bob in bobs.items()}
    )
    measured = record_run.measure_run(RunDirectory(tmp_path))
    newest = acts(load(str(tmp_path)).policy)
    first = acts(numpy_bob(Learner(config).weights().bob))
    assert measured["evaluations"] == [newest]
    assert (measured["coverage"][0], measured["coverage"][run.num_env_steps]) == (first, newest)
    assert set(measured["coverage"]) == set(record_run.read_stages(RunDirectory(tmp_path)))
    assert newest != first


# --- two commits ------------------------------------------------------------------------------------------------------


def _git(path, *arguments):
    identity = ("-c", "user.name=Nobody", "-c", "user.email=nobody@example.org")
    subprocess.run(["git", "-C", str(path), *identity, *arguments], check=True, capture_output=True)


def test_a_commit_is_checked_out_for_as_long_as_it_is_needed(tmp_path):
    _git(tmp_path, "init", "--quiet")
    for text in ("old", "new"):
        (tmp_path / "file").write_text(text)
        _git(tmp_path, "add", "file")
        _git(tmp_path, "commit", "--quiet", "-m", text)
    old = compare_commits.full_name("HEAD~1", tmp_path)
    assert len(old) == 40
    with compare_commits.worktree(old, tmp_path) as tree:
        assert (tree / "file").read_text() == "old"
        assert (tmp_path / "file").read_text() == "new"
    assert not tree.exists()
    assert not (tmp_path / ".git" / "worktrees").exists()
    for use in (compare_commits.full_name, lambda name, path: compare_commits.worktree(name, path).__enter__()):
        with pytest.raises(TandemError, match="name a commit"):
            use("no-such-commit", tmp_path)


def test_two_commits_are_trained_and_then_measured_in_turn(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(compare_commits, "train", lambda tree, home, num, file: calls.append(("train", tree, num)))

    def measure(tree, run, home, num):
        calls.append(("measure", tree, num))
        return Sample(len(calls), 1.0, 1.0)

    monkeypatch.setattr(compare_commits, "measure_commit", measure)
    settings = compare_commits.Settings("", "", trained_steps=300, num_pairs=2, num_iterations=7)
    one, other = ROOT / "one", ROOT / "other"
    samples = compare_commits.compare({"a": one, "b": other}, tmp_path, settings)
    measured = [("measure", one, 7), ("measure", other, 7)]
    assert calls == [("train", one, 300), ("train", other, 300), *measured, *measured]
    assert {name: [each.num_steps for each in row] for name, row in samples.items()} == {"a": [3, 5], "b": [4, 6]}


def test_a_commit_is_not_compared_with_itself():
    with pytest.raises(TandemError, match="the same commit"):
        compare_commits.benchmark(compare_commits.Settings("HEAD", "HEAD"))
