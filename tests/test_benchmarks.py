"""The benchmarks on tiny settings: they run, count right and repeat the same physics. Nothing here asserts a time."""

import json
import sys

import numpy as np
import pytest

from benchmarks import env_throughput, figures, measuring, record_run, rounds, selfplay_throughput
from benchmarks.measuring import Sample
from service.config import WorldConfig, dump_config, load_config
from service.envs.batch import WorldBatch
from service.envs.registration import TABLETOP_ID
from service.errors import TandemError
from service.runtime.local import LocalRun
from service.runtime.records import JsonlWriter
from service.runtime.rundir import RunDirectory

TINY = [
    "game.num_worlds=6",
    "game.alice_steps=4",
    "game.bob_steps=5",
    "game.success_distance_m=0.0005",
    "policy.alice.hidden_sizes=[8]",
    "policy.value.hidden_sizes=[8]",
    "policy.bob.trunk_hidden_sizes=[8]",
    "policy.bob.primitive_hidden_size=8",
    "policy.bob.gate_hidden_sizes=[8]",
    "generator.opponent_interval=1",
    "run.num_threads=1",
    "run.evaluation_interval=0",
    "run.total_env_steps=1000000",
]


@pytest.fixture
def config():
    return load_config(None, TINY)


# --- measuring --------------------------------------------------------------------------------------------------------


def test_ratios_are_taken_pair_by_pair():
    ours = [Sample(100, 1.0, 2.0), Sample(100, 2.0, 2.0), Sample(900, 1.0, 4.0)]
    theirs = [Sample(50, 1.0, 1.0), Sample(10, 1.0, 1.0), Sample(100, 1.0, 1.0)]
    # wall: 100/50, 50/10, 900/100; CPU: 50/50, 50/10, 225/100
    assert measuring.ratio(ours, theirs) == {"median": 5.0, "least": 2.0, "greatest": 9.0, "cpu": 2.25}
    assert measuring.total(ours) == Sample(1100, 4.0, 8.0)
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


def test_the_machine_is_described_in_one_line():
    where = measuring.machine("numpy")
    assert where["versions"]["numpy"] == np.__version__
    assert where["cpu"] in measuring.describe(where)
    assert "\n" not in measuring.describe(where)
    json.dumps(where)


# --- env throughput ---------------------------------------------------------------------------------------------------


def test_env_throughput_measures_all_rows_in_turn():
    rows = {
        env_throughput.BATCH: env_throughput.BatchContender(WorldConfig(), 3, num_steps=2),
        env_throughput.PANDA_GYM_IDS[0]: env_throughput.GymnasiumContender(TABLETOP_ID, num_steps=2),
    }
    assert [row.episode() for row in rows.values()] == [6, 2]
    result = env_throughput.summarise(env_throughput.compare(rows, num_pairs=2, seconds=0.0))
    for row in rows.values():
        row.close()
    assert [row["num_steps"] for row in result["rows"].values()] == [12, 4]
    assert list(result["ratios"]) == ["tandem / PandaPickAndPlace-v3"]
    assert all(value > 0.0 for value in result["ratios"]["tandem / PandaPickAndPlace-v3"].values())
    assert measuring.table(result["rows"]).count("\n") == 3
    json.loads(measuring.to_text(result))


def test_grasping_arms_go_to_the_object_and_then_close():
    action = np.array([[0.2, -1.0, 0.0, 0.3]] * 2, dtype=np.float32)
    env_throughput.reach(action, np.array([[0.025, 0.0, -0.2], [0.0, 0.0, 0.0]]), step=1)
    np.testing.assert_allclose(action, [[0.6, -0.5, -1.0, 1.0], [0.1, -0.5, 0.0, 1.0]])
    env_throughput.reach(action, np.zeros((2, 3)), step=20)
    np.testing.assert_array_equal(action[:, 3], -1.0)


def test_only_grasping_arms_lift_the_object():
    heights = []
    for grasping in (False, True):
        batch = env_throughput.BatchContender(WorldConfig(), 48, grasping=grasping)
        batch.episode()
        heights.append(batch._worlds.object_position[:, 2].max())
        batch.close()
    assert heights[0] < 0.04  # at rest the centre of the cube is 0.025 m high
    assert heights[1] > 0.06


def test_an_episode_ends_with_the_environments_time_limit():
    contender = env_throughput.GymnasiumContender(TABLETOP_ID, num_steps=60, grasping=True)
    assert contender.episode() == env_throughput.EPISODE_STEPS
    contender.close()


def test_without_panda_gym_one_line_says_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "panda_gym", None)
    monkeypatch.setattr(sys, "argv", ["env_throughput.py", "--worlds", "1"])
    assert env_throughput.main() == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "make bench" in error


def test_panda_gym_plays_where_it_is_installed():
    pytest.importorskip("panda_gym")
    contender = env_throughput.panda_gym(env_throughput.PANDA_GYM_IDS[0])
    assert contender.episode() == env_throughput.EPISODE_STEPS
    contender.close()


# --- self-play throughput ---------------------------------------------------------------------------------------------


def test_repeated_physics_ends_in_the_same_bits(config, tmp_path):
    run = LocalRun(config, RunDirectory(tmp_path))
    made = []

    def play(metrics):
        subject = rounds.Rounds(run)
        whole, bare = subject.play_and_repeat(0.0)
        made.extend(subject.played)
        assert whole.num_steps == bare.num_steps == made[-1].rollout.num_env_steps
        assert subject.timing.seconds["policies"] > 0.0
        subject.close()
        if len(made) == 3:  # by then past opponents play
            run.request_stop()

    run.run(play)
    run.directory.close()
    num_bob_steps = 0
    with WorldBatch(config.world, config.game.num_worlds, num_threads=1) as worlds:
        for played in made:
            assert rounds.repeat_physics(worlds, played) == played.rollout.num_env_steps
            bob, records = played.rollout.bob, played.rollout.records
            np.testing.assert_array_equal(worlds.bob_value(records.goal), bob.final_value_observation)
            num_bob_steps += int(bob.active.sum())
            worlds.restore(played.start_state)
            for action in played.rollout.alice.action:
                worlds.step(action)
            np.testing.assert_array_equal(worlds.full(1.0), played.rollout.alice.final_value_observation)
    assert num_bob_steps > 0


def test_selfplay_throughput_measures_all_three(config, tmp_path):
    settings = selfplay_throughput.Settings(num_pairs=2, seconds=0.0, num_iterations=2, num_warmup_iterations=2)
    result = selfplay_throughput.compare(config, tmp_path / "run", settings)
    assert all(len(row["env_steps_per_s_each"]) == 2 for row in result["rows"].values())
    assert result["rows"]["rollout with policies"]["num_steps"] == result["rows"]["bare world"]["num_steps"]
    assert result["policy_lag"] == {"mean": 1.0, "max": 1.0}
    assert result["learner_idle_share"] < 1.0
    assert 0.0 <= result["alice_contact_fraction"] <= 1.0
    loop = result["timing"]["loop"]
    assert 0.0 < loop["play"] < loop["total"]
    assert sum(spent for name, spent in loop.items() if name != "total") <= 1.001 * loop["total"]
    assert {"total", "physics", "policies"} <= set(result["timing"]["rollout"])
    assert "whole loop / bare world" in selfplay_throughput.report(result | {"start_to_first_update_s": 1.0})
    json.loads(measuring.to_text(result))


def test_selfplay_throughput_goes_on_from_a_run_and_leaves_it_alone(config, tmp_path):
    run = LocalRun(config, RunDirectory(tmp_path / "source"))
    run.run(lambda metrics: run.request_stop())
    run.directory.close()
    before = {path: path.read_bytes() for path in (tmp_path / "source").rglob("*") if path.is_file()}
    copied = selfplay_throughput.copy_run(RunDirectory(tmp_path / "source"), tmp_path / "copy")
    assert copied.game == config.game
    assert copied.run.total_env_steps > 10**9
    settings = selfplay_throughput.Settings(num_pairs=1, seconds=0.0, num_iterations=1, num_warmup_iterations=1)
    assert selfplay_throughput.compare(copied, tmp_path / "copy", settings, resume=True)["rows"]
    assert {path: path.read_bytes() for path in (tmp_path / "source").rglob("*") if path.is_file()} == before


def test_only_a_run_with_a_checkpoint_can_be_gone_on_from(config, tmp_path):
    with pytest.raises(TandemError, match="no run in"):
        selfplay_throughput.copy_run(RunDirectory(tmp_path / "none"), tmp_path / "copy")
    (tmp_path / "config.yaml").write_text(dump_config(config))
    with pytest.raises(TandemError, match="no checkpoint in"):
        selfplay_throughput.copy_run(RunDirectory(tmp_path), tmp_path / "copy")


def test_the_first_update_of_the_command_line_is_awaited(config, tmp_path):
    assert selfplay_throughput.first_update_s(config, tmp_path / "start") > 0.0
    recorded = RunDirectory(tmp_path / "start" / "run").metrics_file.read_text()
    assert "learner/version" in recorded


# --- recorded runs and their figures ----------------------------------------------------------------------------------

EVALUATION = {
    "goals": "table", "num_episodes": 300, "num_steps": 60, "success_last": 0.31, "success_last_low": 0.26,
    "success_last_high": 0.364, "success_ever": 0.33, "mean_distance_m": 0.1,
}  # fmt: skip


def _run_directory(path, num_iterations=700):
    (path / "run").mkdir(parents=True)
    directory = RunDirectory(path / "run")
    directory.config_file.write_text(dump_config(load_config()))
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
            "bob/success_rate": 0.5,
        }
        if index % 20 == 0:
            record |= {"evaluation/table_success_last": share, "evaluation/table_success_ever": 1.0}
        metrics.append(record)
        goal = [0.0, 0.0, 0.025, 0.1, share / 10, 0.025, index % 2]
        goals.append({"iteration": index, "env_steps": 10_000 * index, "goals": [goal] * (index % 4)})
    return directory


def _record(path, name="cube-0", rows=()):
    record = record_run.record_run(_run_directory(path), name, rows)
    measuring.write_json(path / f"{name}.json", record)
    return path / f"{name}.json"


def test_a_run_is_thinned_by_hand_computed_means():
    records = [{"iteration": i, "env_steps": 10 * i, "a": float(i)} for i in range(1, 8)]
    records[0]["b"], records[6]["b"] = 3.0, float("nan")
    series = record_run.thin(records, max_points=3)  # blocks of 3, 2 and 2
    assert series == {"env_steps": [30, 50, 70], "iteration": [3, 5, 7], "a": [2.0, 4.5, 6.5], "b": [3.0, None, None]}
    assert record_run.unthin(series)[:2] == [
        {"env_steps": 30, "iteration": 3, "a": 2.0, "b": 3.0},
        {"env_steps": 50, "iteration": 5, "a": 4.5},
    ]


def test_a_recorded_run_is_small_and_whole(tmp_path):
    path = _record(tmp_path)
    record = json.loads(path.read_text())
    assert path.stat().st_size < 400_000
    assert {len(values) for values in record["series"].values()} == {record_run.MAX_POINTS}
    assert record["series"]["iteration"][-1] == 700
    assert sum(value is not None for value in record["series"]["evaluation/table_success_last"]) == 35
    assert len(record["goals"]) == record_run.GOAL_RECORDS
    assert {len(each["goals"]) for each in record["goals"]} == {record_run.GOALS_EACH}
    assert record["goals"][-1]["env_steps"] == 7_000_000
    assert load_config().model_dump(mode="json") == record["config"]


def test_evaluations_are_checked_when_they_are_recorded(tmp_path):
    path = tmp_path / "evaluation.json"
    path.write_text(json.dumps({"runs/cube": EVALUATION, "idle": EVALUATION}))
    assert [row["policy"] for row in record_run.read_evaluation(path)] == ["runs/cube", "idle"]
    for text in ("[1]", "{", json.dumps({"runs/cube": {"goals": "table"}}), json.dumps({"runs/cube": 5})):
        path.write_text(text)
        with pytest.raises(TandemError, match="tandem evaluate --json"):
            record_run.read_evaluation(path)


def test_bins_by_hand():
    records = [{"env_steps": steps, "a": value} for steps, value in ((1, 1.0), (4, 3.0), (9, 5.0), (10, None))]
    np.testing.assert_array_equal(figures.binned(records, "a", 10.0, num_bins=5), [1.0, np.nan, 3.0, np.nan, 5.0])


@pytest.mark.filterwarnings("error")
def test_the_page_and_its_pictures_are_made_again_and_again(tmp_path):
    rows = [{"policy": "runs/cube", **EVALUATION}, {"policy": "idle", **EVALUATION, "success_ever": 0.07}]
    runs = [_record(tmp_path / "0", "cube-0", rows), _record(tmp_path / "1", "cube-1")]
    files = figures.pretraining(runs, tmp_path / "out")
    names = ["pretraining.md", "pretraining.png", "pretraining-goals-cube-0.png", "pretraining-goals-cube-1.png"]
    assert [path.name for path in files] == names
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in files[1:])
    page = files[0].read_text()
    # iterations 1 to 69 (mean share 35 / 700) and, in the last tenth, 629 to 700 (mean share 664.5 / 700)
    assert "| cube-0 | 7.0 M | 18 | 95 % | 9 % | 50 % | 8.3 to 13.7 cm | 33 % | 31 % [26, 36] |  |" in page
    assert "| cube-1 | 7.0 M | 18 | 95 % | 9 % | 50 % | 8.3 to 13.7 cm |  |  |  |" in page
    assert "| idle policy |  |  |  |  |  |  | 7 % |" in page
    files[0].write_text(f"Words before.\n{page}Words after.\n")
    figures.pretraining(runs, tmp_path / "out")
    assert files[0].read_text() == f"Words before.\n{page}Words after.\n"


def test_a_page_without_markers_is_left_alone(tmp_path):
    run = _record(tmp_path)
    (tmp_path / "pretraining.md").write_text("no markers")
    with pytest.raises(TandemError, match="no markers for the table"):
        figures.pretraining([run], tmp_path)
    assert (tmp_path / "pretraining.md").read_text() == "no markers"
    assert not (tmp_path / "pretraining.png").exists()


def test_other_files_are_not_runs(tmp_path):
    for text, words in (
        ("{", "cannot read"),
        ('{"format_version": 9}', "format version 9"),
        ("[]", "format version None"),
    ):
        (tmp_path / "run.json").write_text(text)
        with pytest.raises(TandemError, match=words):
            figures.read_run(tmp_path / "run.json")
