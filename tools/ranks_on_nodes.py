"""A run of many tiny actors and several ranks on Ray nodes that are processes of this machine, with kills.

    python -m tools.ranks_on_nodes --nodes 8 --actors 32 --ranks 4 --json docs/results/ranks_on_nodes.json

Nodes have object stores of their own and send each other everything by TCP. Some iterations after the start, and after
each recovery, the next strike falls: a rank is killed, another, an actor, then a rank is stopped and hangs. In the end
the run's records have to show that no version is missing or was made twice, and that every rollout that was handed over
counts once. It shows that a run of this shape works, not how fast.
"""

from __future__ import annotations

import argparse
import logging
import os
import secrets
import signal
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from benchmarks.measuring import machine, write_json
from service.config import Config, load_config
from service.errors import TandemError
from service.io.jsonl import read_jsonl
from service.io.run_directory import RunDirectory
from service.types import Metrics

if TYPE_CHECKING:
    from service.runtime.cluster import ClusterRun

CALM = 5
"""Iterations between two strikes."""
STRIKES = ("kill", "learner-1"), ("kill", "learner-0"), ("kill", "rollout-0"), ("stop", "learner-1")
STORE: dict[str, Any] = {"object_store_memory": 150_000_000}
SIGNALS = {"kill": signal.SIGKILL, "stop": signal.SIGSTOP}
TINY = (
    "game.alice_steps=4",
    "game.bob_steps=4",
    "game.num_goals=2",
    "policy.alice.hidden_sizes=[16]",
    "policy.value.hidden_sizes=[16]",
    "policy.bob={num_primitives: 2, trunk_hidden_sizes: [16], primitive_hidden_size: 8, gate_hidden_sizes: [16]}",
    "learner.bob.mirror=both",
    "learner.bob_window=2",
    "run.total_env_steps=1000000000",
    "run.evaluation_interval=0",
    "run.checkpoint_interval=10",
)


@dataclass(slots=True)
class Strikes:
    """The strikes so far, and the seconds until the next iteration after each."""

    left: list[tuple[str, str]] = field(default_factory=lambda: list(STRIKES))
    done: list[dict[str, Any]] = field(default_factory=list)
    calm: int = 0
    struck: float = 0.0

    def on_iteration(self, run: ClusterRun, metrics: Metrics) -> None:
        """Note a recovery, and strike when it is time to; after the last one stop the run."""
        if self.struck:
            self.done[-1]["back_s"] = time.monotonic() - self.struck
            self.struck = 0.0
        self.calm += 1
        pids = {actor.name: actor.pid for actor in run.health().actors}
        if self.calm < CALM or None in pids.values():
            return
        self.calm = 0
        if not self.left:
            run.request_stop()
            return
        how, name = self.left.pop(0)
        pid = pids[name]
        assert pid is not None
        os.kill(pid, SIGNALS[how])
        self.struck = time.monotonic()
        self.done.append({"how": how, "name": name, "iteration": int(metrics["iteration"])})


def make_config(num_actors: int, num_ranks: int) -> Config:
    """Two worlds for each actor, and minibatches with the fewest rows that the ranks may have."""
    sizes = [f"learner.{player}.minibatch_size={32 * num_ranks}" for player in ("alice", "bob")]
    return load_config(None, [*TINY, *sizes, f"game.num_worlds={2 * num_actors}", f"learner.num_learners={num_ranks}"])


def play(home: Path, num_nodes: int, num_actors: int, num_ranks: int) -> dict[str, Any]:
    """Play with all strikes, and look at what was recorded.

    Raises:
        TandemError: the run ended before its time.
    """
    import ray
    from ray.cluster_utils import Cluster

    from service.runtime.cluster import ClusterRun
    from service.runtime.ray_connection import ClusterOptions, connected

    directory, strikes = RunDirectory(home / "run"), Strikes()
    (home / "ray").mkdir()
    head = {"num_cpus": 0, "include_dashboard": False, "temp_dir": str(home / "ray")}
    cluster = Cluster(initialize_head=True, head_node_args=head | STORE)
    with ExitStack() as stack:
        stack.callback(cluster.shutdown)
        for _ in range(num_nodes):
            cluster.add_node(num_cpus=-(-(num_actors + num_ranks) // num_nodes), **STORE)
        directory.claim(resume=False)
        stack.callback(directory.close)
        stack.enter_context(connected(cluster.address))
        run = ClusterRun(make_config(num_actors, num_ranks), directory, ClusterOptions(num_actors=num_actors))
        stack.callback(run.close)
        result = run.run(lambda metrics: strikes.on_iteration(run, metrics))
        health, num_alive = run.health(), sum(node["Alive"] for node in ray.nodes())
        num_waiting = len(run._pending) + (len(run._current.batch) if run._current is not None else 0)
    rows = read_jsonl(directory.path / "metrics.jsonl")
    return {
        "num_nodes": num_alive,
        "num_iterations": result.iteration,
        "num_env_steps": result.num_env_steps,
        "strikes": strikes.done,
        "num_groups": 1 + run._learner.incarnation,
        "versions_without_gap": [row["learner/version"] for row in rows] == list(range(1, len(rows) + 1)),
        "num_rollouts_handed_over": sum(actor.num_rollouts for actor in health.actors) - num_waiting,
        "num_rollouts_counted": health.num_rollouts_counted,
        "num_rollouts_refused": health.num_rollouts_refused,
    }


def main() -> int:
    """Parse the command line, play, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=8, help="besides the head; default: %(default)s")
    parser.add_argument("--actors", type=int, default=32, help="default: %(default)s")
    parser.add_argument("--ranks", type=int, default=4, help="default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result")
    given = parser.parse_args()
    if given.ranks < 2:
        parser.error(f"--ranks {given.ranks}: rank 1 is killed, so give at least 2")
    logging.basicConfig(format="%(asctime)s %(message)s")
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0"}
    os.environ |= {"RAY_raylet_start_wait_time_s": "300"}  # many nodes start on few cores
    try:
        with TemporaryDirectory(prefix="tandem-") as home:
            os.environ["RAY_TMPDIR"] = home
            result = play(Path(home), given.nodes, given.actors, given.ranks)
        asked = {"nodes": given.nodes, "actors": given.actors, "ranks": given.ranks}
        result = {"tool": "ranks_on_nodes", "machine": machine("ray", "torch"), "settings": asked} | result
        if given.json is not None:
            write_json(given.json, result)
    except TandemError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print({name: value for name, value in result.items() if name != "machine"})
    lost = result["num_rollouts_handed_over"] != result["num_rollouts_counted"]
    return int(lost or result["num_rollouts_refused"] > 0 or not result["versions_without_gap"])


if __name__ == "__main__":
    raise SystemExit(main())
