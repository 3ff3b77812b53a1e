"""The benchmarks of runs on a cluster, and the tools: arithmetic by hand, and parts on tiny settings."""

import os
import subprocess
from datetime import UTC, datetime

import pytest

from benchmarks import processes, scaling, training_process
from benchmarks.compare_commits import measure_commit
from benchmarks.measuring import ROOT
from benchmarks.training_process import Measured, Records, measure_training
from service.base.errors import TandemError
from service.store.models import ActorStatus, RunStatus
from service.store.run_directory import RunDirectory
from tests.runs.runs import play, tiny_config
from tools import faults
from tools.rollout_audit import Stretch, audit_rollouts, stretches_of


def moment(at):
    return datetime.fromtimestamp(at, UTC)


def actor(name, incarnation=0, num_rollouts=0, heartbeat=0.0, state="alive", pid=7):
    return ActorStatus(
        name=name, incarnation=incarnation, num_rollouts=num_rollouts, heartbeat=moment(heartbeat), state=state, pid=pid
    )


def seen(at, *actors, iteration=0, **status):
    now = moment(at)
    told = {"run_id": "run", "name": "run", "runtime": "ray", "state": "running", "started": now, "heartbeat": now}
    return at, RunStatus(**told, total_env_steps=9, iteration=iteration, actors=actors, **status)


# --- processes --------------------------------------------------------------------------------------------------------


def test_this_process_and_its_children_have_roles_and_times():
    while sum(os.times()[:2]) < 0.05:
        pass
    with subprocess.Popen(["sleep", "60"]) as child:
        found = processes.descendants(os.getpid())
        seconds = processes.cpu_s_by_role(os.getpid())
        child.kill()
    assert (found[os.getpid()], found[child.pid]) == ("driver", "other")
    assert seconds["driver"] >= 0.05
    assert child.pid not in processes.descendants(os.getpid())
    assert processes.role("ray::RolloutActor.play") == "actor"


# --- the audit --------------------------------------------------------------------------------------------------------


def test_nothing_was_lost_or_counted_twice():
    told = [
        seen(1, actor("rollout-0", 0, 3), actor("rollout-1", 0, 2)),
        seen(2, actor("rollout-0", 1, 5), actor("rollout-1", 0, 4)),  # incarnation 0 had handed over 5
        seen(3, actor("rollout-0", 1, 8), actor("rollout-1", 0, 6)),
    ]
    stretches = stretches_of([status for _, status in told])
    assert stretches == [Stretch(0, 0, 1, 5), Stretch(0, 1, None, 3), Stretch(1, 0, None, 6)]
    rows = [{"iteration": i, "env_steps": 10 * i, "learner/version": i} for i in (1, 2, 3)]
    ledger = {(0, 0): 4, (0, 1): 2, (1, 0): 4}  # 5 + 3 + 5 rollouts
    end = seen(4, num_rollouts_counted=13)[1]
    fine = audit_rollouts(rows, ledger, end, stretches)
    assert fine["complete"]
    assert tuple(fine[f"num_{key}"] for key in ("handed_by_the_dead", "counted_of_the_dead", "left_at_the_end")) == (
        5,
        5,
        1,
    )
    lost = audit_rollouts(rows, {(0, 0): 3, (0, 1): 2, (1, 0): 5}, end, stretches)
    assert (lost["num_counted_of_the_dead"], lost["complete"]) == (4, False)
    late = seen(4, num_rollouts_counted=12, num_rollouts_refused=1)[
        1
    ]  # one that came too late, of the 13 in the ledger
    assert audit_rollouts(rows, ledger, late, stretches, late=True)["complete"]
    assert not audit_rollouts(rows, ledger, late, stretches)["complete"]
    twice = audit_rollouts(rows, ledger, seen(4, num_rollouts_counted=14)[1], stretches)
    assert not twice["complete"]
    torn = audit_rollouts(rows[::2], ledger, end, stretches)
    assert (torn["iterations_contiguous"], torn["versions_contiguous"], torn["complete"]) == (False, False, False)


def test_an_unknown_fault_is_refused_with_those_there_are():
    with pytest.raises(TandemError, match="no fault 'rain'"):
        faults.benchmark(faults.Settings(only="rain"))


def test_a_fault_with_rollouts_lost_is_missed():
    account = {"num_counted": 7, "num_refused": 1, "complete": False}
    row = {"seen": "learning goes on after 3.0 s", "reached": False, "account": account}
    assert faults.report({"faults": {"learner-killed": row}}).endswith(
        "| learner-killed | learning goes on after 3.0 s | 7 counted, 1 came too late, **not complete** | **missed** |"
    )


# --- throughput -------------------------------------------------------------------------------------------------------


class Scripted:
    """A run whose records come in given portions; it has the directory of a real one."""

    pid = os.getpid()

    def __init__(self, directory, portions):
        self.directory, self.records, self._portions, self.stopped = directory, self, list(portions), False

    def new(self):
        return self._portions.pop(0)

    def wait_for(self, what):
        return what()

    def stop(self):
        self.stopped = True


def test_it_is_measured_from_when_all_actors_are_up(tiny, monkeypatch):
    monkeypatch.setattr(training_process, "NUM_WARMUP_ITERATIONS", 1)

    def row(index, num_alive):
        return {"env_steps": 10.0 * index, "actor/num_alive": num_alive}

    portions = [[row(0, 0)], [row(1, 1), row(2, 2)], [row(3, 2), row(4, 1)]]  # one that dies later is measured, too
    run = Scripted(tiny, portions)
    found = measure_training(run, 2, num_actors=2)
    assert run.stopped
    assert (found.sample.num_steps, len(found.rows)) == (20, 3)


def test_a_commit_goes_on_from_a_checkpoint_is_measured_and_ended(tiny, tmp_path):
    """The commit is this checkout."""
    before = tiny.metrics_file.read_bytes()
    sample = measure_commit(ROOT, tiny, tmp_path, 3)
    assert sample.num_steps > 0
    assert sample.cpu_s > 0.0
    assert not (tmp_path / "runs" / "run").exists()  # it was a copy
    assert tiny.metrics_file.read_bytes() == before


def test_records_are_read_as_they_come(tmp_path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"env_steps": 5}\n')
    records = Records(file)
    assert records.new() == []
    with file.open("a") as out:
        out.write('{"env_steps": 10}\n{"env_st')
        out.flush()
        assert records.new() == [{"env_steps": 10}]
        out.write('eps": 30}\n')
    assert records.new() == [{"env_steps": 30}]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A run of tiny games, some iterations old."""
    path = tmp_path_factory.mktemp("tiny") / "run"
    play(path, tiny_config(total_env_steps=1_000_000_000), on_iteration=lambda run, _: run.request_stop())
    return RunDirectory(path)


def test_a_box_by_hand():
    rows = [
        {"env_steps": 250.0 * index, "actor/num_rollouts": float(num), "time/learn_s": learn_s, "time/play_s": play_s}
        for index, (num, learn_s, play_s) in enumerate([(9, 9.0, 9.0), (2, 1.0, 1.0), (1, 2.0, 2.0), (3, 1.0, 4.0)])
    ]
    measured = Measured(rows, 10.0, {"learner": 5.0, "actor": 20.0})
    assert (measured.sample.num_steps, measured.sample.cpu_s) == (750, 25.0)
    found = scaling.box(measured, num_actors=2, num_worlds=10)
    assert (found["env_steps_per_s"], found["iteration_s"]) == (75.0, 10.0 / 3)
    assert found["learner_idle_share"] == pytest.approx(0.6)  # 4 s of updates in 10 s
    assert found["actor_idle_share"] == pytest.approx(0.2)  # 16 s of rounds in 20 s of two actors
    assert found["cores"] == {"actor": 2.0, "learner": 0.5}


def test_more_cores_by_hand():
    def measured(learner):
        one = {"iteration_s": 1.0, "num_worlds": 100, "cores": {"actor": 0.9, "learner": learner}}
        two = {"iteration_s": 0.5, "num_worlds": 50, "cores": {"actor": 2.2, "learner": 0.6}}  # 1.1 s for both rounds
        return {"one_box": {"1": one, "2": two}}

    costs = scaling.Costs.of(measured(0.3)["one_box"])
    assert (costs.round_s, costs.world_s) == (pytest.approx(0.2), pytest.approx(0.007))
    assert costs.num_fed == pytest.approx(3.0)
    assert costs.update_s(1) == pytest.approx(0.9)
    assert costs.update_s(7) == pytest.approx(0.305)  # 15 worlds each
    assert (costs.update_s(8), costs.num_useful) == (0.3, 8)  # 13 worlds take .291 s
    assert scaling.Costs.of(measured(0.1)["one_box"]).num_useful is None  # a round takes .2 s without any world
    skill = {"runs": [{"reached": True, "at": {"iteration": num}} for num in (100, 200, 900)]}
    block = scaling.model_block(measured(0.3), skill)
    assert "keeps up with 3.0 actors of 100 worlds each" in block
    assert "A run gains nothing beyond 9 cores." in block
    assert "gains from every further core. Use" in scaling.words(measured(0.1))
    # 200 updates of .9 s are 3 minutes, of .3 s one; eight runs of 3 minutes are 160 an hour
    assert ["16", "0.30 s", "1.0", "100 %", "160"] in [line.strip("| ").split(" | ") for line in block.splitlines()]
    of_two = measured(0.3)
    of_two["one_box"]["1"]["env_steps_per_s"] = 5_000.0  # 200 updates are a million env steps
    block = scaling.recipe_block(of_two, 30_000_000)
    # 6,000 updates of .9 s are 90 minutes: of the run of two cores, and of each of eight
    assert ["16", "0.30 s", "30.0", "100 %", "5.3"] in [line.strip("| ").split(" | ") for line in block.splitlines()]
    assert "| minutes to 30 M env steps |" in block
    never = {"runs": [{"reached": False}]}
    assert "| inf |" in scaling.model_block(measured(0.3), never)


def test_a_run_is_compared_with_another_by_env_steps_and_by_cpu_time():
    def box(env_steps_per_s, actor, learner):
        return {"env_steps_per_s": env_steps_per_s, "cores": {"actor": actor, "learner": learner}}

    here = {"one_box": {"1": box(600.0, 0.9, 0.12), "2": box(900.0, 1.8, 0.2)}}
    there = {"one_box": {"1": box(800.0, 0.8, 0.2), "2": box(1500.0, 1.6, 0.4)}}
    words = scaling.beside(here, there, "one cube")
    assert words.startswith("That is 0.75 (one actor) and 0.60 (two) of the env steps/s of one cube")
    # an env step: .9 s / 600 beside .8 s / 800, and .12 s / 600 beside .2 s / 800
    assert words.endswith("takes 1.50 times as much CPU time in the actor and 0.80 in the learner.")
