import dataclasses
import json

import numpy as np
import pytest
import torch

from service.actors.evaluation import IdlePolicy, evaluate
from service.downstream import playing
from service.downstream.methods import find_method
from service.downstream.playing import evaluate_on
from service.downstream.worker import Callbacks, RunOptions, make_worlds, run_trial
from service.envs.tasks import TASKS
from service.errors import TandemError
from service.io.checkpoints import CheckpointStore
from service.io.jsonl import read_jsonl
from service.io.lock import is_locked
from service.primitives.digest import parameters_digest
from tests.downstream.trials import small_trial


class Stop:
    """Says so once it has been asked more than ``after`` times."""

    def __init__(self, after):
        self.left = after

    def __call__(self):
        self.left -= 1
        return self.left < 0


def run(trial, champion, path, *, resume=False, **callbacks):
    return run_trial(trial, champion, path, RunOptions(resume, num_threads=1, callbacks=Callbacks(**callbacks)))


def without_times(records):
    return [{key: value for key, value in each.items() if not key.startswith("time/")} for each in records]


@pytest.mark.parametrize("method", ["ours-her", "scratch-mcp"])
def test_a_resumed_training_is_the_uninterrupted_one(champion, tmp_path, method):
    trial = small_trial(method)
    whole = run(trial, champion, tmp_path / "whole")
    assert run(trial, champion, tmp_path / "cut", stop=Stop(2)) is None
    assert len(read_jsonl(tmp_path / "cut" / "metrics.jsonl")) == 2
    assert not (tmp_path / "cut" / "result.json").exists()
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = run(trial, champion, tmp_path / "cut", resume=True)
    records = [without_times(read_jsonl(tmp_path / name / "metrics.jsonl")) for name in ("whole", "cut")]
    assert records[0] == records[1]
    assert resumed["evaluation"] == whole["evaluation"]
    first, second = (CheckpointStore(tmp_path / name / "checkpoints", 1).load_latest() for name in ("whole", "cut"))
    assert first.meta["loop"] == second.meta["loop"]
    assert first.arrays.keys() == second.arrays.keys() > {"learner/alpha/log", "replay/goal", "worlds/worlds"}
    assert all(np.array_equal(array, second.arrays[name]) for name, array in first.arrays.items())


def test_a_training_killed_between_checkpoints_makes_the_rest_again(champion, tmp_path):
    trial = small_trial()
    run(trial, champion, tmp_path, stop=Stop(1))
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 2, "env_steps": 400, "made": "after the checkpoint"}\n{"iterat')
    run(trial, champion, tmp_path, resume=True)
    records = read_jsonl(tmp_path / "metrics.jsonl")
    assert [each["iteration"] for each in records] == [1, 2, 3]
    assert not any("made" in each for each in records)


def test_what_a_training_leaves(champion, tmp_path):
    before = parameters_digest(champion.primitives)
    seen = []
    result = run(small_trial(), champion, tmp_path, on_iteration=seen.append)
    files = {path.name for path in tmp_path.iterdir()} - {".lock"}
    assert files == {
        "cell.json", "metrics.jsonl", "tensorboard", "checkpoints", "result.json", "policy.safetensors", "curves.png"
    }  # fmt: skip
    assert parameters_digest(champion.primitives) == before == result["primitives"]["digest"]
    assert result["primitives"]["name"] == champion.manifest.reference
    assert result == json.loads((tmp_path / "result.json").read_text())
    assert result["env_steps"] == 600
    assert [point["env_steps"] for point in result["curve"]] == [400, 600]
    assert seen[-1]["learner/num_updates"] == 2 * 50 * 2  # two iterations that learn, 50 steps each, two updates a step
    found = result["evaluation"]
    assert found["num_episodes"] == 6
    for key in ("success_last", "success_ever"):
        share = found[key]
        for bound in (found[f"{key}_low"], found[f"{key}_high"]):  # Wilson's: where the share is 1.96 deviations away
            assert (share - bound) ** 2 == pytest.approx(1.96**2 * bound * (1.0 - bound) / 6, abs=1e-12)
        assert found[f"{key}_low"] < found[f"{key}_high"]


def test_a_finished_training_is_not_run_again(champion, tmp_path):
    first = run(small_trial("idle"), champion, tmp_path)
    stamp = (tmp_path / "result.json").stat().st_mtime_ns
    assert run(small_trial("idle"), champion, tmp_path, resume=True) == first
    assert (tmp_path / "result.json").stat().st_mtime_ns == stamp


def test_what_a_killed_process_left_before_its_first_file_is_no_training(champion, tmp_path):
    for name in (".lock", ".tmp-1-cell"):
        (tmp_path / name).touch()
    run(small_trial("idle"), champion, tmp_path)
    assert not list(tmp_path.glob(".tmp-*"))


def test_success_is_within_5_cm_whatever_primitives_were_trained_with(champion, tmp_path):
    game = champion.config.game.model_copy(update={"success_distance_m": 0.001})
    strict = dataclasses.replace(champion, config=champion.config.model_copy(update={"game": game}))
    trial = small_trial("asp-only", "inair", num_episodes=40)
    assert run(trial, strict, tmp_path / "strict")["evaluation"]["success_last"] > 0.8


def test_5_cm_are_counted_and_while_learning_a_centimetre_less_is_paid(champion):
    trial = small_trial("idle", num_episodes=300)
    counts = []
    for distance in (0.05, 0.06):
        task = TASKS["push"]
        world = task.world_from(champion.config.world)
        options = {"num_episodes": 300, "num_steps": 50, "success_distance_m": distance, "seed": 7}
        counts.append(evaluate(IdlePolicy(), world, task.goals, **options).success_last)
    assert evaluate_on(trial.task, champion.config.world, IdlePolicy(), 300, 7, 1).success_last == counts[0] < counts[1]
    worlds = make_worlds(trial, find_method("ours"), champion, 1)
    following = np.zeros((3, 11), np.float32)
    following[:, 5:8] = [[0.0399, 0.0, 0.0], [0.0401, 0.0, 0.0], [0.0, 0.0, -0.0499]]
    np.testing.assert_array_equal(worlds.rewards(following, np.zeros((3, 3), np.float32)), [1.0, 0.0, 0.0])
    worlds.close()


def test_goals_of_the_curve_of_the_end_and_of_learning_are_others(champion, tmp_path, monkeypatch):
    seeds = []
    monkeypatch.setattr(
        playing, "evaluate", lambda *given, **named: seeds.append(named["seed"]) or evaluate(*given, **named)
    )
    run(small_trial(seed=3), champion, tmp_path)
    assert seeds == [1_000_003, 1_000_003, 2_000_003]


def test_a_training_keeps_others_out_until_it_ends(champion, tmp_path):
    def try_another(metrics):
        with pytest.raises(TandemError, match=r"is in use by .*; stop that one first, or name another"):
            run(small_trial(), champion, tmp_path, resume=True)
        refused.append(metrics["iteration"])

    refused = []
    run(small_trial(), champion, tmp_path, on_iteration=try_another)
    assert refused == [1, 2, 3]
    assert not is_locked(tmp_path)


def test_seeds_share_no_episodes(champion):
    streams = []
    for seed in (0, 1):
        trial = small_trial(seed=seed)
        worlds = make_worlds(trial, find_method("ours"), champion, 1)
        streams.append(worlds.inputs()[:, 17:20])
        worlds.close()
    distance = np.linalg.norm(streams[0][:, None] - streams[1][None], axis=2)
    assert distance.min() > 1e-6


def test_methods_without_learning_play_as_they_are(champion, tmp_path):
    """Bob is good in the air; who does nothing is at the goal at times, at the last step as at any."""
    trials = [small_trial(method, "inair", num_episodes=60) for method in ("asp-only", "idle")]
    bob, idle = (run(trial, champion, tmp_path / trial.method)["evaluation"] for trial in trials)
    assert bob["success_last"] > 0.8
    assert idle["success_last"] == idle["success_ever"] < 0.1
    assert json.loads((tmp_path / "idle" / "result.json").read_text())["env_steps"] == 0


class TestBadInput:
    def refused(self, words, trial, trained, path, **options):
        before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
        with pytest.raises(TandemError, match=words) as caught:
            run(trial, trained, path, **options)
        assert "\n" not in str(caught.value)
        assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before

    def test_a_directory_with_a_training(self, champion, tmp_path):
        run(small_trial("idle"), champion, tmp_path)
        self.refused("holds a training already; continue it with --resume", small_trial("idle"), champion, tmp_path)

    def test_a_directory_of_something_else(self, champion, tmp_path):
        (tmp_path / "metrics.jsonl").write_text('{"iteration": 1}\n')
        (tmp_path / "config.yaml").write_text("name: cube\n")
        for resume in (False, True):
            self.refused(
                "something else than a downstream training", small_trial("idle"), champion, tmp_path, resume=resume
            )

    def test_another_training(self, champion, tmp_path):
        run(small_trial("idle"), champion, tmp_path)
        other = small_trial("idle", num_episodes=7)
        self.refused(r"begun with num_episodes 6, not 7", other, champion, tmp_path, resume=True)

    def test_a_task_of_another_version(self, champion, tmp_path):
        """A directory of before tasks had versions is of version 0, which none is any more."""
        for task in ("wall", "box"):
            run(small_trial("idle", task), champion, tmp_path / task)
            (tmp_path / task / "result.json").unlink()
        tree = json.loads((tmp_path / "box" / "cell.json").read_text())
        del tree["cell"]["task_version"]
        (tmp_path / "box" / "cell.json").write_text(json.dumps(tree))
        run(small_trial("idle", "wall"), champion, tmp_path / "wall", resume=True)
        words = r"begun with task_version 0, not 1"
        self.refused(words, small_trial("idle", "box"), champion, tmp_path / "box", resume=True)

    def test_other_primitives(self, champion, tmp_path):
        run(small_trial(), champion, tmp_path, stop=Stop(1))
        manifest = champion.manifest.model_copy(update={"version": 99})
        other = dataclasses.replace(champion, manifest=manifest)
        words = rf"primitives\.name '{champion.manifest.reference}', not .*@99"
        self.refused(words, small_trial(), other, tmp_path, resume=True)

    def test_primitives_of_another_robot(self, champion, tmp_path):
        spaces = {**champion.manifest.spaces, "action": 7}
        other = dataclasses.replace(champion, manifest=champion.manifest.model_copy(update={"spaces": spaces}))
        for method in ("ours", "asp-only", "idle", "scratch-mcp"):
            self.refused("another robot or layout: action 7", small_trial(method), other, tmp_path / "new")

    def test_a_damaged_checkpoint(self, champion, tmp_path):
        run(small_trial(), champion, tmp_path, stop=Stop(1))
        (file,) = (tmp_path / "checkpoints").iterdir()
        file.write_bytes(file.read_bytes()[:1000])
        self.refused("is damaged", small_trial(), champion, tmp_path, resume=True)

    def test_a_checkpoint_of_another_version(self, champion, tmp_path):
        run(small_trial(), champion, tmp_path, stop=Stop(1))
        (file,) = (tmp_path / "checkpoints").iterdir()
        data = file.read_bytes()
        assert data.count(b'\\"format_version\\": 1') == 1
        file.write_bytes(data.replace(b'\\"format_version\\": 1', b'\\"format_version\\": 9'))
        self.refused("format version 9", small_trial(), champion, tmp_path, resume=True)
