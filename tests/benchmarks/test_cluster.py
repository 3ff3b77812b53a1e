"""The benchmarks of runs on a cluster, and the tools: arithmetic by hand, and parts on tiny settings."""

import json
import os
import subprocess
import threading
from dataclasses import asdict
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from benchmarks import cluster_throughput, measuring, processes, scaling, scaling_probe, training_process
from benchmarks.report import __main__ as report
from benchmarks.report import cluster as cluster_blocks
from benchmarks.report import scaling as scaling_blocks
from benchmarks.scaling_model import (
    ACTORS,
    ROLLOUTS_IN,
    Batch,
    Cost,
    Model,
    Ranks,
    fastest,
    limit,
    line,
    predict,
    ring,
    with_ranks,
)
from benchmarks.training_process import Measured, Records, Training, copy_run, measure_training, summarise_rows
from service.config import load_config
from service.errors import TandemError
from service.io.run_directory import RunDirectory
from service.store.models import ActorStatus, RunStatus
from tools import fault_injection, rest_load
from tools.fault_injection import Fault, Recovery
from tools.rollout_audit import Stretch, audit_rollouts, ledger_of, stretches_of

WHERE = {"cpu": "Xeon", "num_cpus": 2, "git_commit": "abcdef0123", "time": "2026-11-21T12:00:00+00:00"}


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
    before = processes.cpu_s(os.getpid())
    while processes.cpu_s(os.getpid()) < before + 0.05:
        pass
    with subprocess.Popen(["sleep", "60"]) as child:
        found = processes.descendants(os.getpid())
        seconds = processes.cpu_s_by_role(os.getpid())
        child.kill()
    assert (found[os.getpid()], found[child.pid]) == ("driver", "other")
    assert seconds["driver"] >= before + 0.05
    assert not processes.is_running(child.pid)
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
    ledger = ledger_of([[0, 0, 4], [0, 1, 2], [1, 0, 4]])  # 5 + 3 + 5 rollouts
    end = seen(4, num_rollouts_counted=13)[1]
    fine = audit_rollouts(rows, ledger, end, stretches)
    assert fine["complete"]
    assert tuple(fine[f"num_{key}"] for key in ("handed_by_the_dead", "counted_of_the_dead", "left_at_the_end")) == (
        5,
        5,
        1,
    )
    lost = audit_rollouts(rows, ledger_of([[0, 0, 3], [0, 1, 2], [1, 0, 5]]), end, stretches)
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


def test_faults_are_spread_and_end_early_enough():
    planned = fault_injection.plan_faults(600.0, 30.0)
    at = {name: [at for at, target in planned if target == name] for name in fault_injection.Target.__args__}
    assert at["actor"] == [30.0 * num for num in range(1, 20)]
    assert (at["learner"], at["generator"], at["status"]) == ([135.0, 375.0], [255.0], [315.0])
    assert planned == sorted(planned)


def test_recoveries_by_hand():
    fault = Fault(100.0, "actor", "rollout-0", incarnation=0)
    told = [
        seen(99, actor("rollout-0", 0, 5)),
        seen(101, actor("rollout-0", 0, 5)),
        seen(103, actor("rollout-0", 1, 5, heartbeat=102.5, state="starting", pid=None)),
        seen(105, actor("rollout-0", 1, 5, heartbeat=104.0)),
        seen(109, actor("rollout-0", 1, 6, heartbeat=108.0)),
    ]
    assert fault_injection.recovery(fault, told) == Recovery(4.0, 8.0)
    assert fault_injection.recovery(fault, told[:2]) == Recovery(None, None)
    answers = [(9.0, True), (10.1, True), (10.5, False), (11.0, False), (11.6, True)]
    assert fault_injection.answering_again(10.0, answers).up_s == pytest.approx(1.6)


# --- throughput -------------------------------------------------------------------------------------------------------


def measured(**changed):
    given = {
        "num_steps": 1000, "wall_s": 10.0, "cpu_s": 15.0, "num_iterations": 4, "num_rollouts": 8, "num_actors": 2,
        "num_worlds": 10, "play_s": 2.0, "hand_over_s": 0.25, "learn_s": 1.5,
        "mean_policy_lag": 1.0, "max_policy_lag": 2.0, "role_cpu_s": {},
    }  # fmt: skip
    return Measured(**(given | changed))


def test_what_is_idle_and_what_is_overlapped_by_hand():
    ray = measured()
    assert ray.learner_idle_share == pytest.approx(0.4)  # 6 of 10 s
    assert ray.actor_idle_share == pytest.approx(0.2)  # 16 of 20 s
    assert ray.slot_wait_s == pytest.approx(2.0)  # 20 - 8 (2 + 0.25)
    broadcast = {"put_s": 0.1, "delivered_s": 0.5, "idle_call_s": 0.05}
    found = cluster_throughput.summarise([ray], [measured(play_s=0.0, wall_s=8.0)], broadcast)
    assert found["ratio"]["median"] == pytest.approx(0.8)
    # every actor would wait 8 times for 1.5 + 0.5 s and waits 2 of these 16; an iteration takes 2.5 s
    assert found["broadcast"]["overlapped_share"] == pytest.approx(1 - 2 / 16)
    assert found["broadcast"]["share_of_iteration"] == pytest.approx(0.6 / 2.5)
    assert found["ray"]["slot_wait_share"] == pytest.approx(0.1)
    json.loads(measuring.to_text(found))


def test_costs_of_some_iterations_by_hand():
    rows = [
        {"env_steps": 10.0 * index, "learner/policy_lag": float(index), "actor/num_rollouts": float(num),
         "time/learn_s": 0.5, "time/play_s": float(index)}
        for index, num in enumerate((2, 2, 2, 1, 3))
    ]  # fmt: skip
    found = summarise_rows(rows, 3, 5.0, {"driver": 1.5, "actor": 2.0}, num_actors=2, num_worlds=7)
    assert (found.num_steps, found.num_iterations, found.num_rollouts) == (20, 2, 4)
    assert (found.wall_s, found.cpu_s, found.num_worlds) == (5.0, 3.5, 7)
    assert (found.mean_policy_lag, found.max_policy_lag, found.learn_s) == (3.5, 4.0, 0.5)
    assert found.play_s == pytest.approx((3.0 + 3 * 4.0) / 4)  # weighted by rounds


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


def test_it_is_measured_from_when_all_actors_are_up(tiny):
    def row(index, num_alive):
        return {"env_steps": 10.0 * index, "learner/policy_lag": 1.0, "actor/num_alive": num_alive}

    portions = [[row(0, 0)], [row(1, 1), row(2, 2)], [row(3, 2), row(4, 1)]]  # one that dies later is measured, too
    run = Scripted(tiny, portions)
    found = measure_training(run, 2, num_actors=2, num_warmup=1)
    assert run.stopped
    assert (found.num_steps, found.num_iterations, found.num_actors, found.num_worlds) == (20, 2, 2, 4)


def test_a_run_is_measured_and_ended(tiny, tmp_path):
    copy = copy_run(tiny, tmp_path)
    before = len(tiny.metrics_file.read_text().splitlines())
    arguments = training_process.overrides(training_process.ENDLESS)
    with Training(tmp_path, arguments, runtime="local") as training:
        found = measure_training(training, 3, num_warmup=2)
        assert training.ended is not None
    steps = [json.loads(line)["env_steps"] for line in copy.metrics_file.read_text().splitlines()]
    assert len(steps) >= 5
    assert found.num_steps in {b - a for i, a in enumerate(steps) for b in steps[i + 3 :]}
    assert found.role_cpu_s.keys() >= {"driver"}
    assert before >= 3


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


# --- many requests ----------------------------------------------------------------------------------------------------


def test_a_percentile_is_a_value_that_was_measured():
    found = rest_load.percentiles([float(value) for value in range(200, 0, -1)])
    assert found == {"num": 200, "p50_ms": 100.0, "p90_ms": 180.0, "p99_ms": 198.0, "max_ms": 200.0}
    assert rest_load.percentiles([3.0])["p99_ms"] == 3.0


def test_requests_keep_their_schedule():
    class Answer(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self):
            status = 404 if self.path.endswith("/goals") else 200
            self.send_response(status)
            self.send_header("Content-Length", "2")
            self.end_headers()
            self.wfile.write(b"{}")

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    load = rest_load.Load(f"127.0.0.1:{server.server_port}", "cube", rest_load.Settings(rate=200.0, seconds=0.2))
    load.run()
    server.shutdown()
    server.server_close()
    assert {route: len(took) for route, took in load.took.items()} == {
        route: 4 * rest_load.MIX.count(route) for route in rest_load.ROUTES
    }
    assert load.num_failed == 4  # the goals
    assert load.seconds >= 39 / 200
    found = load.result()
    assert (found["num_failed"], found["answered"]["all"]["num"]) == (4, 40)
    assert found["requests_per_s"] == pytest.approx(40 / load.seconds)


# --- scaling ----------------------------------------------------------------------------------------------------------

MODEL = Model(
    actor=Cost(rollout_s=1.0, world_s=0.1),
    parts={"learner": Cost(update_s=0.5, rollout_s=0.25, world_s=0.025), "driver": Cost(rollout_s=0.01, pair_s=0.001)},
    env_steps=40.0,
    ranks=Ranks(num_messages=5.0, hop_s=0.01, gradient_s=0.04),
)


def test_a_cost_by_hand():
    assert Cost(1.0, 0.5, 0.25, 0.125).seconds(4, 2) == 1.0 + 4 * (0.5 + 2 * 0.25) + 16 * 0.125


def test_predictions_by_hand():
    # 10 worlds: an actor takes 2 s, the learner 0.5 + 0.5 N, the driver 0.01 N + 0.001 N^2
    two, four = predict(MODEL, 2, 10), predict(MODEL, 4, 10)
    assert (two.update_s, two.bottleneck, two.env_steps_per_s) == (2.0, ACTORS, 400.0)
    assert two.busy("learner") == 0.75
    assert (four.update_s, four.bottleneck, four.env_steps_per_s) == (2.5, "learner", 640.0)
    assert four.busy(ACTORS) == 0.8
    many = predict(MODEL, 1000, 10)
    assert (many.bottleneck, many.update_s) == ("driver", pytest.approx(1010.0))


def test_limits_by_hand():
    assert limit(MODEL, "learner", 10) == 3  # 0.5 + 0.5 N <= 2
    assert limit(MODEL, "driver", 10) == 40  # 0.4 + 1.6 = 2
    assert limit(Model(MODEL.actor, {"idle": Cost(1e-12)}, 1.0), "idle", 10) is None
    assert limit(Model(MODEL.actor, {"slow": Cost(3.0)}, 1.0), "slow", 10) == 0


def test_ranks_by_hand():
    # between two ranks 2 hops of 0.01 + 0.04 / 2 each, between four 6 of 0.01 + 0.04 / 4
    assert [MODEL.ranks.seconds(num) for num in (1, 2, 4)] == pytest.approx([0.0, 5 * 0.06, 5 * 0.12])
    assert ring(0.02, 0.06) == pytest.approx((0.01, 0.04))
    assert ring(0.5, 0.06) == pytest.approx((0.03, 0.0))  # a noisy measurement makes nothing negative
    # 10 worlds, 6 actors: 2 s of an actor, the learner 0.5 + 3.0 / R + messages
    two = predict(MODEL, 6, 10, 2)
    assert two.seconds["learner"] == pytest.approx(0.5 + 1.5 + 0.3)
    enough = with_ranks(MODEL, 6, 10, 99)
    assert (enough.num_ranks, enough.bottleneck) == (3, ACTORS)  # 0.5 + 1.0 + 5 x 4 (0.01 + 0.04 / 3) = 1.97
    assert with_ranks(MODEL, 2, 10, 99).num_ranks == 1
    assert with_ranks(MODEL, 6, 10, 2).num_ranks == 2  # a minibatch has rows for no more
    network = Model(MODEL.actor, {"learner": Cost(), ROLLOUTS_IN: Cost(rollout_s=1.0)}, 1.0, ranks_per_node=2)
    assert [predict(network, 6, 10, num).seconds[ROLLOUTS_IN] for num in (1, 2, 3, 5)] == [6.0, 6.0, 3.0, 2.0]
    # 40 actors: more and more ranks spend more on messages than they save, and none keeps up
    most = with_ranks(MODEL, 40, 10, 99)
    assert most.bottleneck == "learner"
    assert most.update_s == min(predict(MODEL, 40, 10, num).update_s for num in range(1, 41))


def test_the_fastest_way_to_a_skill_by_hand():
    model = Model(Cost(world_s=0.1), {"learner": Cost(world_s=0.05)}, 40.0, Ranks())
    # three cores: two actors of 10 worlds and a rank take 1 s an update; one actor and two ranks take 2 s
    way = fastest(model, [Batch(20, 100.0, 9)], 3)
    assert (way.run.num_actors, way.run.num_ranks, way.seconds) == (2, 1, pytest.approx(100.0))
    # updates twice as large take twice as long: they have to save half of all updates
    assert fastest(model, [Batch(20, 100.0, 9), Batch(40, 60.0, 9)], 3).batch.num_worlds == 20
    assert fastest(model, [Batch(20, 100.0, 9), Batch(40, 40.0, 9)], 3).batch.num_worlds == 40


def test_the_fastest_way_may_leave_cores_over():
    """A world for each actor takes 0.1 s, 20 on ten ranks too; more ranks would only send more messages."""
    model = Model(Cost(world_s=0.1), {"learner": Cost(world_s=0.05)}, 40.0, Ranks(1.0, hop_s=0.0001))
    way = fastest(model, [Batch(20, 100.0, 99)], 256)
    assert (way.run.num_actors, way.run.num_ranks) == (20, 11)  # 1 / 11 s and 20 hops of 0.1 ms
    assert fastest(model, [Batch(20, 100.0, 4)], 256).run.num_ranks == 4  # a minibatch has rows for no more


def test_a_line_does_not_fall():
    assert line((1, 3.0), (8, 10.0)) == pytest.approx((2.0, 1.0))
    assert line((1, 3.0), (8, 2.0)) == (3.0, 0.0)
    assert line((2, 1.0), (4, 9.0)) == (0.0, 4.0)


WAKES = {"num_actors": [10, 60, 110], "wait_s": [0.1, 9.0, 0.3]}  # the first and the last count
SIZES = {
    "rollout": 20e6, "num_worlds": 20, "weights": 12e6, "snapshot": 4e6, "opponents": 1e6, "learner_state": 1e6,
    "generator_state": 1e6,
}  # fmt: skip


ALONE = scaling.Alone(
    rounds={"num_worlds": [10, 20], "cpu_s": [3.0, 5.0]},
    goals={"num_worlds": [10, 20], "cpu_s": [0.01, 0.03]},
    updates={"num_worlds": [10, 20], "cpu_s": [0.7, 1.3]},
    messages={"small_message_s": 0.02, "message_s": 0.06, "message_s_of_four": 0.5, "num_messages": 5},
    wakes=WAKES,
    sizes=SIZES,
)


def model_of_scaling():
    few = measured(num_rollouts=4, role_cpu_s={"learner": 4 * 0.3, "driver": 4 * 0.2, "gcs": 0.0, "actor": 4 * 0.5})
    many = measured(num_rollouts=32, role_cpu_s={"learner": 4 * 1.0, "driver": 4 * 0.9, "gcs": 2.8, "actor": 32 * 0.6})
    spent = {"learner": 4 * 2.4, "generator": 4 * 0.25}
    one = measured(num_rollouts=4, num_worlds=20, num_steps=3200, role_cpu_s=spent)
    assumed = scaling.Assumed(network_mb_per_s=100.0, actors_per_node=16)
    return scaling.costs([few, many], one, ALONE, assumed)


def test_the_models_constants_by_hand():
    model = model_of_scaling()
    # tiny games: 1 rollout an iteration costs 0.3 s, 8 cost 1.0: 0.2 + 0.1 N, and 0.1 for gradient steps of no samples.
    # The trained run: 2.4 - 0.3 - 0.1 over 20 worlds
    assert model.parts[scaling.LEARNER] == Cost(pytest.approx(0.3), pytest.approx(0.1), pytest.approx(0.1))
    # tiny games have no goals to speak of: 0.25 of the trained run, but for 20 worlds of 0.002
    assert model.parts[scaling.GENERATOR] == Cost(pytest.approx(0.21), 0.0, pytest.approx(0.002))
    driver = model.parts[scaling.DRIVER]
    assert (driver.update_s, driver.rollout_s, driver.pair_s) == pytest.approx((0.1, 0.1, 0.002))
    assert model.parts[scaling.GCS] == Cost(0.0, pytest.approx(0.1))
    assert model.parts[scaling.ROLLOUTS_IN].world_s == pytest.approx(0.01)
    assert model.parts[scaling.WEIGHTS_OUT].rollout_s == pytest.approx(0.01)
    assert model.actor == Cost(rollout_s=pytest.approx(1.5), world_s=pytest.approx(0.2))  # 1.0 of a round, 0.5 of Ray
    assert model.env_steps == 40.0
    assert model.ranks == Ranks(5, pytest.approx(0.01), pytest.approx(0.04))


def test_what_is_on_paper_goes_onto_the_page():
    paper = scaling.on_paper(model_of_scaling(), num_worlds=10, total_worlds=20, rows_per_world=320)
    assert [row["num_actors"] for row in paper["worlds_each"]] == [1, 2, 4, 16, 256, 4096]
    assert [row["num_worlds"] for row in paper["worlds_shared"]] == [20, 10, 5, 2, 1, 1]
    # an actor takes 3.5 s, the learner 0.3 + 1.1 N, with four actors 2.5 s on two ranks and with messages of 0.3 s
    assert paper["limits"][scaling.LEARNER] == 2
    assert [row["num_ranks"] for row in paper["worlds_each"]][:3] == [1, 1, 2]
    assert next(iter(paper["limits"])) == scaling.LEARNER
    result = {"machine": WHERE, "model": paper, "alone": asdict(ALONE), "assumed": asdict(scaling.Assumed())}
    assert "**The first bottleneck is the learner**: it keeps up with 2 actors" in scaling_blocks.limits_block(result)
    assert "| 4 | 2 | 10 | 457 | 4.0 | 3.5 s |" in scaling_blocks.model_block(result)
    assert scaling.on_paper(model_of_scaling(), 10, 20, rows_per_world=1)["worlds_each"][2]["num_ranks"] == 1
    there = [
        {"seed": seed, "reached": True, "at": {"iteration": num, "env_steps": 1e4 * num}}
        for seed, num in enumerate((300, 500, 400))
    ]
    settings = {"recipe": load_config(None).model_dump(mode="json")}
    studies = {
        "few": {
            "settings": settings | {"num_worlds": 10},
            "runs": [there[0] | {"at": {"iteration": 1, "env_steps": 1e6}}],
        },
        "large": {"settings": settings | {"num_worlds": 40}, "runs": [{"seed": 1, "reached": False}]},
        "recipe": {"settings": settings | {"num_worlds": 20}, "runs": [*there, {"seed": 3, "reached": False}]},
    }
    batches = scaling_blocks.batches_block(studies).splitlines()
    assert batches[2:] == [
        "| 10 | `few.json` | 1 of 1 | 1 M | 1 | 300 |",
        "| 20 | `recipe.json` | 3 of 4 | 4.5 M | 450 | 450 |",
        "| 40 | `large.json` | 0 of 1 |  |  | 500 |",
    ]
    assert "| 16 | 20 |" in scaling_blocks.skill_block(result, studies)  # one seed of a few worlds shows nothing


def test_a_run_on_nodes_goes_onto_the_page():
    strikes = [
        {"how": "kill", "name": "learner-1", "back_s": 19.6},
        {"how": "stop", "name": "learner-0", "back_s": 38.2},
    ]
    result = {
        "machine": WHERE, "settings": {"nodes": 8, "actors": 32, "ranks": 4}, "num_iterations": 27, "strikes": strikes,
        "num_rollouts_handed_over": 864, "num_rollouts_counted": 863,
    }  # fmt: skip
    block = scaling_blocks.nodes_block(result)
    assert "32 tiny actors and a learner of 4 ranks on 8 nodes beside a head, 27 updates" in block
    assert "| learner-0 | stopped, so that it hangs | 38 s |" in block
    assert "handed over: 864; that the learner counted: 863; lost or counted twice: 1." in block


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return scaling.make_tiny(tmp_path_factory.mktemp("tiny"))


def test_sizes_are_those_of_what_travels(tiny, tmp_path):
    copy = copy_run(tiny, tmp_path)
    few, many = scaling_probe.goals(copy, [1, 4])["cpu_s"]
    assert 0 < few < 0.1
    assert 0 < many < 0.1
    found = scaling_probe.sizes(copy)
    assert found["num_worlds"] == scaling.NUM_TINY_ACTORS
    assert found["rollout"] > 8 * 4 * 14  # at least an observation of each world
    assert found["weights"] > 1000
    assert scaling_probe.num_bytes(np.zeros(1000)) in range(8000, 8400)


def test_a_run_without_a_checkpoint_is_not_copied(tiny, tmp_path):
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "config.yaml").write_bytes(tiny.config_file.read_bytes())
    with pytest.raises(TandemError, match="no checkpoint"):
        copy_run(RunDirectory(tmp_path / "none"), tmp_path)


# --- the pages --------------------------------------------------------------------------------------------------------


def soaked(flat=True):
    steady = {"middle": 5, "end": 5}
    series = {"iteration": [1, 2], "own_mb": [50.0, 50.0], "num_files": [5.0, 5.0]}
    each = {
        "role": "learner", "middle_mb": 50.0, "end_mb": 50.1, "growth_mb": 0.1, "per_day_mb": 1.0,
        "per_day_low_mb": -1.0, "per_day_high_mb": 3.0, "flat": flat, "descriptors_flat": True, "history_mb": 0.0,
        "num_files": steady, "num_threads": steady, "series": series,
    }  # fmt: skip
    return {
        "benchmark": "soak", "machine": WHERE, "num_rounds": 50_001, "num_iterations": 25_000, "seconds": 600.0,
        "num_replaced": 0, "num_refused": 0, "asked": {"num": 9, "unanswered": 0}, "iterations_a_day": 24_686.0,
        "processes": {"learner": each, "gcs": {**each, "role": "gcs"}},
    }  # fmt: skip


def test_targets_are_judged_by_their_numbers():
    found = {each.what: cluster_blocks.verdict(each.reached) for each in cluster_blocks.targets({"soak": soaked()})}
    assert found == dict.fromkeys(
        ("rounds of tiny games", "memory flat", "file descriptors and threads flat"), "reached"
    )
    grows = {each.what: each for each in cluster_blocks.targets({"soak": soaked(flat=False)})}["memory flat"]
    assert (grows.measured, cluster_blocks.verdict(grows.reached)) == ("all but learner, gcs", "**missed**")
    table = cluster_blocks.targets_table({"cluster_throughput": throughput(0.849)})
    assert "| env steps/s, Ray / local | >= 85 % | 84.9 % (80.0 % to 90.0 %) | **missed** |" in table
    assert "| learner idle | < 10 % | 9 % | reached |" in table
    assert "85.0 % (80.0 % to 90.0 %) | reached |" in cluster_blocks.targets_table(
        {"cluster_throughput": throughput(0.85)}
    )


def throughput(median):
    lag = {"mean": 1.0, "max": 2.0}
    return {
        "ratio": {"median": median, "least": 0.8, "greatest": 0.9, "cpu": 0.9},
        "ray": {"policy_lag": lag, "learner_idle_share": 0.09},
        "broadcast": {"overlapped_share": 0.95},
    }


def test_within_noise_is_what_undisturbed_runs_differ_by():
    near, far = (
        cluster_blocks._curve({"disturbed_from_undisturbed": [0.02, away], "undisturbed_from_each_other": [0.02]})
        for away in (0.03, 0.05)
    )
    assert (near.reached, far.reached) == (True, False)  # 0.025 and 0.035 against 0.03
    alone = cluster_blocks._curve({"disturbed_from_undisturbed": [0.5], "undisturbed_from_each_other": []})
    assert alone.reached is None


def test_a_page_without_markers_and_a_wrong_file_are_left_alone(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("words")
    with pytest.raises(TandemError, match="no markers for chaos"):
        report.replace_blocks(page, {"chaos": "text"})
    assert page.read_text() == "words"
    (tmp_path / "scaling.json").write_text('{"benchmark": "chaos"}')
    with pytest.raises(TandemError, match=r"not what python -m benchmarks\.scaling writes"):
        report.read_results(tmp_path)


def test_what_is_not_recorded_is_said(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"a {report.begin('box')} old {report.end('box')} b")
    assert report.replace_blocks(page, {"box": ""}) == (
        f"a {report.begin('box')}\n\nNot recorded yet.\n\n{report.end('box')} b"
    )
    assert report.scaling_blocks({}, {}) == {}
