"""Single costs of a run on Ray, each measured in a process of its own; other benchmarks start it.

    python -m benchmarks.scaling_probe sizes RUN_DIR           bytes of a rollout, of weights, snapshots, states
    python -m benchmarks.scaling_probe rounds RUN_DIR NUM ...  CPU time of rounds of so many worlds, in one process
    python -m benchmarks.scaling_probe goals RUN_DIR NUM ...   CPU time in which their goals are recorded
    python -m benchmarks.scaling_probe wakes NUM ...           time of the driver for each event, with so many actors
    python -m benchmarks.scaling_probe broadcast RUN_DIR NUM   time until so many actors have new weights

All print one line of JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import statistics
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from benchmarks.rounds import Rounds, round_cpu_s
from service.io.run_directory import RunDirectory
from service.primitives.loading import read_parameters
from service.runtime.local import LocalRun
from service.runtime.ray_connection import connected
from service.runtime.workers import GeneratorWorker, RolloutWorker

NUM_RECORDS = 200
NUM_WAKES = 200
NUM_BROADCASTS = 20


def sizes(directory: RunDirectory) -> dict[str, Any]:
    """Bytes, as Ray's object store and the network take them."""
    with closing(LocalRun(directory.read_config(), directory, resume=True)) as run, closing(Rounds(run)) as rounds:
        rounds.play_and_repeat(0.0)
        rollout = rounds.played[-1].rollout
        found = {
            "rollout": num_bytes(rollout),
            "weights": num_bytes(run.learner.weights()),
            "snapshot": num_bytes(run.generator.snapshot()),
            "opponents": num_bytes(run.generator.opponents.freeze(0)),
            "learner_state": num_bytes(run.learner.state()),
            "generator_state": num_bytes(run.generator.state()),
        }
    directory.close()
    return {**found, "num_worlds": run.config.game.num_worlds}


def rounds(directory: RunDirectory, numbers: Sequence[int]) -> dict[str, Any]:
    """CPU seconds of a round of so many worlds, each number by itself."""
    with closing(LocalRun(directory.read_config(), directory, resume=True)) as run:
        found = [round_cpu_s(run, num) for num in numbers]
    directory.close()
    return {"num_worlds": list(numbers), "cpu_s": found}


def goals(directory: RunDirectory, numbers: Sequence[int]) -> dict[str, Any]:
    """CPU seconds in which the task generator records the goals of a round of so many worlds."""
    with closing(LocalRun(directory.read_config(), directory, resume=True)) as run:
        found = [_goals_cpu_s(run, num) for num in numbers]
    directory.close()
    return {"num_worlds": list(numbers), "cpu_s": found}


def _goals_cpu_s(run: LocalRun, num_worlds: int) -> float:
    config, weights = run.config, run.learner.weights()
    actor = RolloutWorker(config.model_copy(update={"game": config.game.model_copy(update={"num_worlds": num_worlds})}))
    snapshot, opponents = run.generator.snapshot(), run.generator.opponents.freeze(0)
    text = pickle.dumps(actor.play(weights, snapshot, opponents)[1])
    actor.game.close()
    generator = GeneratorWorker(config, run.generator.state())
    start_s = time.process_time()
    for _ in range(NUM_RECORDS):
        generator.record(1, weights, [pickle.loads(text)])
    return (time.process_time() - start_s) / NUM_RECORDS


def num_bytes(value: Any) -> int:
    """Size of a value pickled as Ray does it, with arrays out of band."""
    from ray import cloudpickle

    buffers: list[Any] = []
    text = cloudpickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return len(text) + sum(int(buffer.raw().nbytes) for buffer in buffers)


def wakes(numbers: Sequence[int]) -> dict[str, Any]:
    """Median seconds of one wait of the driver for one answer, among so many actors that are awaited."""
    return {"num_actors": list(numbers), "wait_s": [_wait_s(num) for num in numbers]}


def _wait_s(num: int) -> float:
    import ray

    class Silent:
        def answer(self) -> None:
            """Answer too late for this test."""
            time.sleep(3600.0)

    actor: Any = ray.remote(Silent).options(num_cpus=0).remote()
    waiting, took = [actor.answer.remote() for _ in range(num - 1)], []
    for index in range(NUM_WAKES):
        references = [*waiting, ray.put(index)]
        start = time.perf_counter()
        ray.wait(references, timeout=0.2)
        took.append(time.perf_counter() - start)
    ray.kill(actor)
    return statistics.median(took)


def broadcast(directory: RunDirectory, num_actors: int) -> dict[str, float]:
    """Median seconds to put weights into the object store, and until so many actors have them; an idle call beside it.

    The actors do nothing else, and everything is warm.
    """
    import ray

    class Receiver:
        def take(self, weights: Any) -> None:
            """Do nothing: Ray gets the arguments before it calls."""

    actor = ray.remote(Receiver).options(num_cpus=0)
    receivers: list[Any] = [actor.remote() for _ in range(num_actors)]
    alice, bob = (dict(read_parameters(directory, player)) for player in ("alice", "bob"))
    averaged = {name: array.copy() for name, array in bob.items()}  # a learner gives out both
    took: dict[str, list[float]] = {"put_s": [], "delivered_s": [], "idle_call_s": []}
    for index in range(NUM_BROADCASTS + 1):
        start = time.perf_counter()
        reference = ray.put((alice, bob, averaged))
        put = time.perf_counter()
        ray.get([each.take.remote(reference) for each in receivers])
        delivered = time.perf_counter()
        ray.get([each.take.remote(None) for each in receivers])
        end = time.perf_counter()
        if index:  # the first one starts processes
            took["put_s"].append(put - start)
            took["delivered_s"].append(delivered - put)
            took["idle_call_s"].append(end - delivered)
    return {name: statistics.median(values) for name, values in took.items()}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("sizes", "rounds", "goals", "wakes", "broadcast"))
    parser.add_argument("arguments", nargs="+")
    given = parser.parse_args()
    first, *rest = given.arguments
    if given.what == "sizes":
        result = sizes(RunDirectory(Path(first)))
    elif given.what == "rounds":
        result = rounds(RunDirectory(Path(first)), [int(each) for each in rest])
    elif given.what == "goals":
        result = goals(RunDirectory(Path(first)), [int(each) for each in rest])
    elif given.what == "wakes":
        with connected(None, 1):
            result = wakes([int(each) for each in given.arguments])
    else:
        with connected(None, max(int(*rest), os.cpu_count() or 1)):
            result = broadcast(RunDirectory(Path(first)), int(*rest))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
