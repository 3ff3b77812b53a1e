"""The local runner: what an iteration does, when a run ends, and that a resumed run equals one never stopped."""

import shutil
from contextlib import ExitStack

import numpy as np
import pytest

from benchmarks.record_run import read_stages
from service.base.errors import CheckpointError, TandemError
from service.learner.learner import Learner
from service.methods import workers
from service.policies.numpy_policy import numpy_bob
from service.registry.loading import load
from service.runs.resuming import resumed_config
from service.runs.run import Run, UnsavedError
from service.runs.train import open_run
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory
from tests.runs.runs import (
    FullForAWhile,
    assert_one_line,
    assert_same_run,
    newest,
    no_room_above,
    play,
    read_lines,
    timeless_metrics,
    tiny_config,
)

LONG = {"total_env_steps": 1500}
"""Long enough for replayed goals, which need 64 in the buffer."""

METRICS = {
    "iteration", "env_steps", "world/num_broken", "actor/num_rollouts", "actor/num_alive", "time/wall_s",
    "time/env_steps_per_s", "time/play_s", "time/hand_over_s", "time/learn_s",
    "time/learner_idle_fraction",
    # valid, not moved and out-of-workspace rates, and how the rest ends
    "alice/valid_fraction", "alice/not_moved_fraction", "alice/outside_fraction", "alice/fallen_fraction",
    # goal height histogram, lifted at the end
    "alice/goal_height_table_fraction", "alice/goal_height_low_fraction", "alice/goal_height_middle_fraction",
    "alice/goal_height_high_fraction", "alice/goal_height_m", "alice/goal_height_p90_m", "alice/goal_distance_m",
    "alice/lifted_fraction",
    # finger contact, with one and with both
    "alice/contact_fraction", "alice/both_contact_fraction",
    # Bob by goal type, against a past Alice, on replayed goals
    "bob/success_rate", "bob/success_rate_table", "bob/success_rate_air", "bob/success_rate_past_alice",
    "bob/success_rate_from_reset", "bob/success_rate_replayed", "bob/steps_to_success", "bob/env_steps_fraction",
    # ABC samples and their mean log-ratio
    "learner/num_demonstrations", "learner/demonstration_log_ratio", "learner/demonstration_log_prob",
    "learner/cloning_loss", "learner/num_imitated", "learner/alice_cloning_loss",
    "learner/alice_demonstration_log_ratio", "learner/alice_demonstration_log_prob",
    # entropy and KL of each update
    "learner/alice_entropy", "learner/bob_entropy", "learner/alice_kl", "learner/bob_kl",
    # each primitive's mean weight and share of the precision
    "learner/primitive_weight_0", "learner/primitive_weight_1",
    "learner/primitive_share_0", "learner/primitive_share_1", "learner/bob_std",
    "learner/policy_lag", "learner/max_policy_lag", "learner/version", "learner/non_finite_steps", "learner/rollbacks",
    "learner/num_alice_samples", "learner/num_bob_samples",
    "learner/alice_explained_variance", "learner/bob_explained_variance",
    "learner/alice_learning_rate", "learner/bob_learning_rate", "learner/alice_policy_loss", "learner/bob_policy_loss",
    "learner/alice_value_loss", "learner/bob_value_loss", "learner/alice_clip_fraction", "learner/bob_clip_fraction",
    "learner/alice_grad_norm", "learner/bob_grad_norm", "learner/alice_policy_steps", "learner/bob_policy_steps",
    "generator/num_cells_reached", "generator/num_cells_seen", "generator/new_cells",
    "generator/iterations_without_new_cell",
    "generator/buffer_size", "generator/mean_learnability", "generator/mean_success_rate",
    "evaluation/table_success_last", "evaluation/table_success_ever",
    "evaluation/air_success_last", "evaluation/air_success_ever",
    "evaluation/mixed_success_last", "evaluation/mixed_success_ever",
}  # fmt: skip
"""Names are an API (algorithms.md 6.4, and what else is recorded). Change them here only on purpose."""


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    """A run from start to end."""
    path = tmp_path_factory.mktemp("long")
    _, result = play(path, tiny_config(**LONG))
    assert result.reason == "finished"
    return path


# --- one run ---------------------------------------------------------------------------------------------------------


def test_what_a_run_records(long_run):
    """The comparisons below mean something only if all of this takes part."""
    rows = read_lines(long_run / "metrics.jsonl")
    names = set().union(*rows)
    assert {"bob/success_rate_replayed", "bob/success_rate_past_alice", "learner/demonstration_log_ratio"} <= names
    assert any(row.get("bob/success_rate", 0.0) > 0.0 for row in rows)
    assert sum(len(row["goals"]) for row in read_lines(long_run / "goals.jsonl")) > 20
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    steps = [row["env_steps"] for row in rows]
    assert steps[-1] >= 1500 > steps[-2]
    assert (newest(long_run).step, newest(long_run).meta["env_steps"]) == (len(rows), steps[-1])
    alice = 24 * 4  # she always plays on
    assert all(alice <= after - before <= 2 * alice for before, after in zip([0, *steps], steps, strict=False))
    lags = [row.get("learner/policy_lag") for row in rows]
    assert lags[:2] == [None, 0.0]  # nothing to learn from yet, then both rounds by version 0
    assert set(lags[2:]) == {1.0}
    assert [row.get("learner/version") for row in rows][1:] == list(range(1, len(rows)))


def test_another_seed_is_another_run(uninterrupted, tmp_path):
    play(tmp_path, tiny_config(seed=1, total_env_steps=200))
    assert timeless_metrics(tmp_path)[0] != timeless_metrics(uninterrupted)[0]


def test_every_metric_is_recorded_under_its_name(tmp_path):
    """Objects are held up and let go, so that there are goals in the air: Alice's turn ends while they fall."""

    def lift(run, metrics):
        states = run.method.game.worlds.states.copy()
        states[::2, 12] = 0.25
        run.method.game.worlds.restore(states)

    play(tmp_path, tiny_config(**LONG, evaluation_interval=4), on_iteration=lift)
    assert set().union(*read_lines(tmp_path / "metrics.jsonl")) == METRICS


def test_evaluations_come_at_their_interval_and_change_nothing(uninterrupted, tmp_path):
    play(tmp_path, tiny_config(evaluation_interval=2))
    rows = read_lines(tmp_path / "metrics.jsonl")
    evaluated = [row["iteration"] for row in rows if "evaluation/table_success_last" in row]
    assert evaluated == list(range(2, len(rows) + 1, 2))
    without = [{k: v for k, v in row.items() if not k.startswith("evaluation/")} for row in timeless_metrics(tmp_path)]
    assert without == timeless_metrics(uninterrupted)


def test_the_average_bob_is_evaluated(tmp_path, monkeypatch):
    handed, asked, weights = [], [], Learner.weights

    def watched(self):
        handed.append(weights(self))
        return handed[-1]

    def look(run, metrics):
        assert asked[-1] is handed[-1].bob_ema

    monkeypatch.setattr(Learner, "weights", watched)
    monkeypatch.setattr(workers, "numpy_bob", lambda bob: asked.append(bob) or numpy_bob(bob))
    play(tmp_path, tiny_config(total_env_steps=200, evaluation_interval=1), on_iteration=look)


def test_a_snapshot_joins_the_pool_every_interval(tmp_path):
    seen = {}

    def look(run, metrics):
        seen[run.iteration] = (run.method.learner.weights().bob, list(run.method.generator.opponents.bob))

    play(tmp_path, tiny_config(total_env_steps=900), on_iteration=look)
    assert [len(pool) for _, pool in list(seen.values())[:6]] == [0, 0, 1, 1, 2, 2]
    # Iteration 3 plays with the weights that iteration 2 left, and they join the pool.
    weights, pool = seen[2][0], seen[3][1]
    assert all(np.array_equal(pool[0][name], array) for name, array in weights.items())


def test_the_newest_checkpoints_are_kept(tmp_path):
    _, result = play(tmp_path, tiny_config(keep_checkpoints=2, checkpoint_interval=1))
    files = sorted(file.name for file in (tmp_path / "checkpoints").iterdir())
    last = result.iteration
    assert files == [f"checkpoint-e00000001-{step:08d}.safetensors" for step in (last - 1, last)]
    config = resumed_config(RunDirectory(tmp_path), ["run.keep_checkpoints=1", "run.total_env_steps=900"])
    _, result = play(tmp_path, config, resume=True)
    assert CheckpointStore(tmp_path / "checkpoints", keep=1).steps() == [result.iteration]


def test_bob_is_kept_untrained_and_after_each_tenth(long_run):
    steps = [0, *(row["env_steps"] for row in read_lines(long_run / "metrics.jsonl"))]
    expected = sorted({min(step for step in steps if step >= tenth * 150) for tenth in range(11)})
    stages = read_stages(RunDirectory(long_run))
    assert list(stages) == expected
    assert len(stages) > 4
    untrained, last = Learner(tiny_config(**LONG)).weights().bob, load(str(long_run)).parameters
    for bob, same in ((stages[0], untrained), (stages[steps[-1]], last)):
        assert bob.keys() == same.keys()
        assert all(np.array_equal(bob[name], array) for name, array in same.items())
    assert any(not np.array_equal(last[name], array) for name, array in untrained.items())


def test_a_run_without_snapshots_has_its_last_stage(uninterrupted, tmp_path):
    shutil.copytree(uninterrupted, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "snapshots")
    assert list(read_stages(RunDirectory(tmp_path / "copy"))) == [newest(uninterrupted).meta["env_steps"]]


def test_a_run_that_has_converged_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "service.generator.generator.TaskGenerator.should_stop", lambda self: self._stop._num_iterations == 3
    )
    _, result = play(tmp_path, tiny_config(total_env_steps=10**9))
    assert (result.reason, result.iteration) == ("converged", 3)
    assert newest(tmp_path).step == 3
    _, again = play(tmp_path, tiny_config(total_env_steps=10**9), resume=True)
    assert (again.reason, again.iteration) == ("converged", 3)


# --- exact resume ----------------------------------------------------------------------------------------------------


def test_a_run_killed_between_two_iterations(long_run, tmp_path):
    config = tiny_config(**LONG)
    _, result = play(tmp_path, config, kill_after=8)
    assert result is None
    assert newest(tmp_path).step == 6  # the one due now had not been written
    with (tmp_path / "metrics.jsonl").open("ab") as file:
        file.write(b'{"iteration": 10, "env_st')
    (tmp_path / "checkpoints" / ".tmp-1-ab").write_bytes(b"half a checkpoint")
    run, result = play(tmp_path, config, resume=True)
    assert result.reason == "finished"
    assert_same_run(tmp_path, long_run)
    assert run.wall_s > 0.0
    snapshots = [
        {file.name: file.read_bytes() for file in (path / "snapshots").iterdir()} for path in (tmp_path, long_run)
    ]
    assert snapshots[0] == snapshots[1]
    assert list((tmp_path / "checkpoints").glob(".tmp-*")) == []


def test_a_stop_is_saved_and_resumed(long_run, tmp_path):
    """Here right after players joined the past ones, whom the next round does not meet yet."""
    config = tiny_config(**LONG, checkpoint_interval=100)

    def stop(run, metrics):
        if run.iteration == 5:
            run.request_stop()

    _, result = play(tmp_path, config, on_iteration=stop)
    assert (result.reason, result.iteration) == ("interrupted", 5)
    assert newest(tmp_path).step == 5
    assert int(newest(tmp_path).arrays["opponents/num"]) == 1
    config = resumed_config(RunDirectory(tmp_path), ["run.checkpoint_interval=2"])
    play(tmp_path, config, resume=True)
    assert_same_run(tmp_path, long_run)


def test_a_finished_run_goes_on_with_a_larger_budget(uninterrupted, tmp_path):
    _, result = play(tmp_path, tiny_config(total_env_steps=300))
    assert result.reason == "finished"
    config = resumed_config(RunDirectory(tmp_path), ["run.total_env_steps=600"])
    _, longer = play(tmp_path, config, resume=True)
    assert longer.iteration > result.iteration
    assert_same_run(tmp_path, uninterrupted)


def test_a_finished_run_resumed_as_it_is_stays_as_it_is(uninterrupted, tmp_path):
    shutil.copytree(uninterrupted, tmp_path / "copy")
    _, result = play(tmp_path / "copy", tiny_config(), resume=True)
    assert result.reason == "finished"
    assert_same_run(tmp_path / "copy", uninterrupted)


def test_a_damaged_newest_checkpoint_is_passed_over(uninterrupted, tmp_path, caplog):
    path = tmp_path / "copy"
    shutil.copytree(uninterrupted, path)
    *_, before, last = sorted((path / "checkpoints").iterdir())
    data = bytearray(last.read_bytes())
    data[len(data) // 2] ^= 1
    last.write_bytes(data)
    config, started = tiny_config(), []
    play(path, config, resume=True, on_iteration=lambda run, metrics: started.append(run.iteration))
    assert started[0] == int(before.stem.rpartition("-")[2]) + 1
    assert last.name in caplog.text
    assert_same_run(path, uninterrupted)


# --- what goes wrong -------------------------------------------------------------------------------------------------


def test_resume_where_there_is_no_run(tmp_path):
    with pytest.raises(CheckpointError) as error:
        open_run(tiny_config(), RunDirectory(tmp_path), resume=True)
    assert_one_line(error.value, tmp_path, "no checkpoint", "--resume")
    assert list(tmp_path.iterdir()) == []


def test_a_new_run_does_not_touch_an_old_one(uninterrupted, tmp_path):
    path = tmp_path / "copy"
    shutil.copytree(uninterrupted, path)
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    with pytest.raises(TandemError) as error:
        open_run(tiny_config(seed=5), RunDirectory(path))
    assert_one_line(error.value, path, "--resume", "--run-dir")
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


def test_a_full_disk_leaves_the_earlier_checkpoint(uninterrupted, tmp_path, caplog):
    config = tiny_config()
    with no_room_above(175_000), pytest.raises(UnsavedError) as error:
        play(tmp_path, config)
    last = newest(uninterrupted).step
    assert_one_line(
        error.value, f"checkpoint-e00000001-{last:08d}", "File too large", "intact", f"iteration {last}", "--resume"
    )
    failed = [message for message in caplog.messages if "the run goes on" in message]
    assert_one_line(failed[0], "checkpoint-e00000001-00000004", "File too large")
    assert len(failed) == last // 2 - 1  # it tried again at every interval
    files = sorted(file.name for file in (tmp_path / "checkpoints").iterdir())
    assert files == ["checkpoint-e00000001-00000000.safetensors", "checkpoint-e00000001-00000002.safetensors"]
    assert newest(tmp_path).step == 2
    play(tmp_path, config, resume=True)
    assert_same_run(tmp_path, uninterrupted)


def test_a_disk_that_was_full_for_a_while_costs_nothing(long_run, tmp_path, caplog):
    """Checkpoints are skipped, and records that did not fit come later, in their places."""
    with ExitStack() as stack:

        def fill_and_clear(run, metrics):
            if run.iteration == 3:
                stack.enter_context(no_room_above(1_000))
            if run.iteration == 9:
                assert newest(tmp_path).step == 2
                stack.close()

        _, result = play(tmp_path, tiny_config(**LONG), on_iteration=fill_and_clear)
    assert result.reason == "finished"
    assert_same_run(tmp_path, long_run)
    for name in ("e00000001-00000004", "e00000001-00000008", "metrics.jsonl", "goals.jsonl", "snapshots"):
        assert name in caplog.text
    assert "e00000001-00000010" not in caplog.text


def test_a_checkpoint_that_does_not_fit_is_said_until_one_does(tmp_path):
    told = FullForAWhile("local")
    play(tmp_path / "run", tiny_config(total_env_steps=1000), on_iteration=told)
    told.check()


def test_the_last_checkpoint_is_not_written_twice(tmp_path, monkeypatch):
    """The second writing could fail on a disk that is full by now, although all is saved."""
    with ExitStack() as stack:
        save = Run._save

        def save_and_fill(self):
            save(self)
            if self.iteration == 2:
                stack.enter_context(no_room_above(0))

        monkeypatch.setattr(Run, "_save", save_and_fill)
        _, result = play(tmp_path, tiny_config(total_env_steps=200))
    assert (result.reason, result.iteration) == ("finished", 2)
    assert newest(tmp_path).step == 2


def test_an_error_in_the_learners_thread_reaches_the_caller(tmp_path, monkeypatch):
    def fail(self):
        raise TandemError("the learner cannot go on")

    monkeypatch.setattr("service.learner.learner.Learner.update", fail)
    with pytest.raises(TandemError, match="the learner cannot go on"):
        play(tmp_path)
