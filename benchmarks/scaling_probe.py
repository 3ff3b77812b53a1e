"""Single costs of a run on Ray, each measured in a process of its own; ``scaling.py`` starts it.

    python -m benchmarks.scaling_probe sizes RUN_DIR       bytes of a rollout, of weights, of states, of records
    python -m benchmarks.scaling_probe wakes NUM ...       what the driver spends on being woken, with so many actors
    python -m benchmarks.scaling_probe nodes RUN_DIR NUM   so many iterations on three nodes of a test cluster

All print one line of JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

# before NumPy is imported: as the command line does
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

from benchmarks.processes import parent
from benchmarks.runner_probe import NEVER, Watch
from benchmarks.trainings import ENDLESS
from service.config import load_config
from service.io.jsonl import read_jsonl
from service.io.run_directory import RunDirectory
from service.runtime.local import LocalRun
from service.runtime.ray_connection import ClusterOptions, connected
from service.store.models import ActorStatus, RunStatus

NUM_NODES, ACTORS_PER_NODE = 2, 1
"""Of the test cluster, beside a head without cores."""
NUM_WAKES = 200


def sizes(directory: RunDirectory) -> dict[str, Any]:
    """Bytes, as Ray's object store and the network take them."""
    from benchmarks.rounds import Rounds

    config = load_config(directory.config_file, [ENDLESS, NEVER, "run.evaluation_interval=0"])
    directory.claim(resume=True)
    with closing(LocalRun(config, directory, resume=True)) as run, closing(Rounds(run)) as rounds:
        rounds.play_and_repeat(0.0)
        rollout = rounds.played[-1].rollout
        found = {
            "rollout": num_bytes(rollout),
            "records": num_bytes(rollout.records),
            "weights": num_bytes(run.learner.weights()),
            "learner_state": num_bytes(run.learner.state()),
            "generator_state": num_bytes(run.generator.state()),
        }
    directory.close()
    newest = read_jsonl(directory.metrics_file)[-1:]
    return {
        **found,
        "metrics_record": len(json.dumps(newest[0])) if newest else 0,
        "num_worlds": config.game.num_worlds,
        "num_env_steps": rollout.num_env_steps,
    }


def num_bytes(value: Any) -> int:
    """Pickled, with arrays out of band as Ray does it."""
    from ray import cloudpickle

    buffers: list[Any] = []
    text = cloudpickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return len(text) + sum(int(buffer.raw().nbytes) for buffer in buffers)


def wakes(numbers: Sequence[int]) -> dict[str, Any]:
    """Median seconds of one turn of the driver's loop with so many actors: Ray's wait, and its own looking around.

    And of a status of so many, from its making to its JSON, which is made at most twice a second.
    """
    return {
        "num_actors": list(numbers),
        "wait_s": [_wait_s(num) for num in numbers],
        "look_s": [_look_s(num) for num in numbers],
        "status_s": [_status(num)[0] for num in numbers],
        "status_bytes": [_status(num)[1] for num in numbers],
    }


def _wait_s(num: int) -> float:
    """One answer among ``num`` that are awaited."""
    import ray

    class Silent:
        def answer(self) -> None:
            """Not within this test."""
            time.sleep(3600.0)

    actor: Any = ray.remote(Silent).options(num_cpus=0).remote()
    waiting = [actor.answer.remote() for _ in range(num - 1)]
    took = []
    for index in range(NUM_WAKES):
        ready = ray.put(index)
        references = [*waiting, ready]
        start = time.perf_counter()
        ray.wait(references, timeout=0.2)
        took.append(time.perf_counter() - start)
    ray.kill(actor)
    return statistics.median(took)


def _look_s(num: int) -> float:
    """What the loop asks about every actor: idle, counted on, hung; with all of them busy but one."""
    from service.runtime.actor_pool import Crew, Member
    from service.runtime.slots import RolloutSlots

    class Seats(Crew):
        def _hire(self, index: int, incarnation: int) -> Member:
            return Member(index, incarnation, None, time.monotonic(), place=Place("", 1))

    crew, slots = Seats(load_config(None), 1, 0), RolloutSlots()
    for member in crew.resize(num)[1:]:
        member.begin(slots.begin(0))
    took = []
    for _ in range(NUM_WAKES):
        start = time.perf_counter()
        _ = [each for each in crew if each.idle and slots.may_begin(crew.num_counted_on)]
        _ = crew.num_counted_on, slots.may_update(1), crew.hung()
        took.append(time.perf_counter() - start)
    return statistics.median(took)


def _status(num: int) -> tuple[float, int]:
    now, took, text = datetime.now(UTC), [], ""
    for _ in range(5):
        start = time.perf_counter()
        actors = tuple(
            ActorStatus(name=f"rollout-{i}", incarnation=0, state="alive", node="node", pid=4_000_000, heartbeat=now,
                        num_rollouts=1000, num_env_steps=4_000_000) for i in range(num)
        )  # fmt: skip
        status = RunStatus(run_id="run", name="run", runtime="ray", state="running", started=now, heartbeat=now,
                           total_env_steps=10**9, actors=actors)  # fmt: skip
        text = status.model_dump_json()
        took.append(time.perf_counter() - start)
    return statistics.median(took), len(text)


def nodes(directory: RunDirectory, num_iterations: int) -> dict[str, Any]:
    """Play on Ray's test cluster, whose nodes are processes of this machine and send each other everything by TCP.

    Returns:
        Env steps a second, on how many nodes the actors were, and bytes on the loopback interface, everything
        that other programs sent included.
    """
    import ray
    from ray.cluster_utils import Cluster

    from service.runtime.cluster import ClusterRun

    config = load_config(directory.config_file, [ENDLESS, NEVER, "run.evaluation_interval=0"])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(NUM_NODES):
            cluster.add_node(num_cpus=ACTORS_PER_NODE)
        directory.claim(resume=True)
        options = ClusterOptions(NUM_NODES * ACTORS_PER_NODE)
        with connected(cluster.address), closing(ClusterRun(config, directory, options, resume=True)) as run:
            watch, sent = Watch(run, num_iterations, num_actors=NUM_NODES * ACTORS_PER_NODE), list[int]()

            def tell(metrics: dict[str, float]) -> None:
                watch.on_iteration(metrics)
                sent.append(_loopback_bytes())

            run.run(tell)
            measured = watch.measured(options.num_actors or 0, config.game.num_worlds // (options.num_actors or 1))
            places = {each.name: parent(each.pid) for each in run.health().actors if each.pid is not None}
            num_alive = sum(node["Alive"] for node in ray.nodes())
        directory.close()
    finally:
        cluster.shutdown()
    raylets = {pid: index for index, pid in enumerate(sorted({each for each in places.values() if each is not None}))}
    return {
        "num_nodes": num_alive,
        "env_steps_per_s": measured.num_steps / measured.wall_s,
        "places": {name: raylets[pid] for name, pid in places.items() if pid is not None},
        "num_nodes_with_actors": len({pid for name, pid in places.items() if name.startswith("rollout-")}),
        "loopback_bytes_per_iteration": (sent[-1] - sent[-1 - num_iterations]) / num_iterations,
        "num_iterations": num_iterations,
        "max_policy_lag": measured.max_policy_lag,
    }


def _loopback_bytes() -> int:
    """Sent over the loopback interface since the machine started."""
    for line in Path("/proc/net/dev").read_text().splitlines():
        name, _, fields = line.partition(":")
        if name.strip() == "lo":
            return int(fields.split()[0])
    return 0


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("sizes", "wakes", "nodes"))
    parser.add_argument("arguments", nargs="+")
    given = parser.parse_args()
    if given.what == "sizes":
        result = sizes(RunDirectory(Path(given.arguments[0])))
    elif given.what == "wakes":
        with connected(None, 1):
            result = wakes([int(each) for each in given.arguments])
    else:
        result = nodes(RunDirectory(Path(given.arguments[0])), int(given.arguments[1]))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
