"""An update by one, two and four ranks of the learner, by threads of one, and what the ranks' messages take.

    python -m benchmarks.learner_ranks --json docs/results/learner_ranks.json

The rollouts of one update are made up: turns of full length, of ``num_worlds`` worlds, shared out among the ranks. All
ranks are processes of this machine, and numbers of ranks or threads above its cores are left out. The KL stops nobody
here, so every update has the same gradient steps.

*Efficiency* is the wall-clock time of one rank over R times that of R ranks. *Message* is the time of one gradient
step's all-reduce when nobody has anything else to do, *in messages* the share of an update that rank 0 spends in them,
which includes waiting for slower ranks.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.measuring import RECIPE_FILE, parser_of, run_benchmark
from benchmarks.report.markdown import table
from service.actors.rollout import Demonstrations, Rollout, Turns
from service.config import Config, load_config
from service.envs.observations import ACTION, BOB, BOB_VALUE, FULL
from service.errors import TandemError
from service.generator.records import GoalRecords
from service.learner.group import ALONE, Group, TorchGroup, find_store, open_store
from service.learner.learner import Learner
from service.learner.shares import share_out
from service.types import IntArray

HOST = "127.0.0.1"
TIMEOUT_S = 120.0
NUMBERS = 1, 2, 4
NUM_SMALL = 1024
"""Numbers of a message whose size does not matter."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Size and number of the updates."""

    num_worlds: int = 240
    """Of all rollouts together."""
    num_rollouts: int = 16
    minibatch_rows: int = 2048
    """Of both players' minibatches; 0 for the recipe's, in proportion to the worlds."""
    num_updates: int = 5
    """Measured ones; one more comes before them."""
    num_messages: int = 200


@dataclass(frozen=True, slots=True)
class Measured:
    """Seconds of one rank."""

    update_s: list[float]
    cpu_s: list[float]
    """Of all threads, by update."""
    messages_s: list[float]
    """In ``Group.sum``, by update."""
    num_sums: int
    """Calls of it in an update."""
    message_s: float
    """Median of one alone."""
    small_message_s: float
    """The same of ``NUM_SMALL`` numbers."""
    num_parameters: int
    """Bob's, whose gradients travel."""


class TimedGroup:
    """A group that notes how long its sums take."""

    def __init__(self, group: Group) -> None:
        self.rank, self.size = group.rank, group.size
        self._group = group
        self.seconds, self.num = 0.0, 0

    def sum(self, *tensors: Tensor) -> None:
        """Add up, and note the time."""
        start = time.perf_counter()
        self._group.sum(*tensors)
        self.seconds += time.perf_counter() - start
        self.num += 1

    def gather(self, numbers: IntArray) -> list[IntArray]:
        """Collect."""
        return self._group.gather(numbers)

    def copy_first(self, tensors: Sequence[Tensor]) -> None:
        """Copy."""
        self._group.copy_first(tensors)


def make_config(settings: Settings) -> Config:
    """The recipe with these minibatches, and with no KL that would stop a player."""
    recipe = load_config(RECIPE_FILE)
    overrides = []
    for name, player in (("alice", recipe.learner.alice), ("bob", recipe.learner.bob)):
        in_proportion = player.minibatch_size * settings.num_worlds // recipe.game.num_worlds
        overrides.append(f"learner.{name}.minibatch_size={settings.minibatch_rows or in_proportion}")
        overrides.append(f"learner.{name}.target_kl=1e9")
    return load_config(RECIPE_FILE, overrides)


def make_rollouts(config: Config, settings: Settings, sequence: int) -> list[Rollout]:
    """Made-up rollouts of one update, equal in every process."""
    sizes = [len(share_out(range(settings.num_worlds), i, settings.num_rollouts)) for i in range(settings.num_rollouts)]
    return [_make_rollout(config, actor, sequence, num_worlds) for actor, num_worlds in enumerate(sizes) if num_worlds]


def measure(group: Group, settings: Settings, num_threads: int) -> Measured:
    """Let this rank learn from its share."""
    torch.set_num_threads(num_threads)
    config, timed = make_config(settings), TimedGroup(group)
    learner = Learner(config, timed)
    bob = ("bob/policy/", "bob/value/")
    num_parameters = sum(array.size for name, array in Learner(config).state().items() if name.startswith(bob))
    update_s, cpu_s, messages_s = [], [], []
    for sequence in range(settings.num_updates + 1):
        for rollout in share_out(make_rollouts(config, settings, sequence), group.rank, group.size):
            learner.ingest(rollout)
        timed.seconds, timed.num = 0.0, 0
        group.gather(np.zeros(1, dtype=np.int64))  # all begin together
        start, cpu = time.perf_counter(), time.process_time()
        learner.update()
        update_s.append(time.perf_counter() - start)
        cpu_s.append(time.process_time() - cpu)
        messages_s.append(timed.seconds)
    message_s, small_message_s = (_message_s(group, num, settings.num_messages) for num in (num_parameters, NUM_SMALL))
    return Measured(update_s[1:], cpu_s[1:], messages_s[1:], timed.num, message_s, small_message_s, num_parameters)


def measure_ranks(num_ranks: int, settings: Settings, num_threads: int = 1) -> dict[str, Any]:
    """Measure updates by so many ranks, each a process of its own."""
    context = multiprocessing.get_context("spawn")
    store = open_store(HOST, TIMEOUT_S)
    pairs = [context.Pipe() for _ in range(num_ranks)]
    processes = [
        context.Process(target=_serve, args=(theirs, rank, num_ranks, store.port, settings, num_threads), daemon=True)
        for rank, (_, theirs) in enumerate(pairs)
    ]
    for process in processes:
        process.start()
    for _, theirs in pairs:
        theirs.close()
    try:
        ranks: list[Measured] = [ours.recv() for ours, _ in pairs]
    except EOFError:
        raise TandemError(f"one of {num_ranks} ranks failed; its error is above") from None
    finally:
        for process in processes:
            process.kill()
            process.join()
    first = ranks[0]
    return {
        "num_ranks": num_ranks,
        "num_threads": num_threads,
        "update_s": statistics.median(first.update_s),
        "cpu_s": statistics.median(map(sum, zip(*(rank.cpu_s for rank in ranks), strict=True))),
        "messages_s": statistics.median(first.messages_s),
        "num_messages": first.num_sums,
        "message_s": first.message_s,
        "small_message_s": first.small_message_s,
        "num_parameters": first.num_parameters,
        "update_s_each": first.update_s,
    }


def benchmark(settings: Settings) -> dict[str, Any]:
    """Measure ranks, then threads of one rank, as far as there are cores."""
    numbers = [num for num in NUMBERS if num <= (os.cpu_count() or 1)]
    ranks = [measure_ranks(num, settings) for num in numbers]
    for each in ranks:
        each["efficiency"] = ranks[0]["update_s"] / (each["num_ranks"] * each["update_s"])
    threads = [measure_ranks(1, settings, num) for num in numbers if num > 1]
    return {"ranks": ranks, "threads": threads}


def report(result: dict[str, Any]) -> str:
    """The result as a Markdown table."""
    rows = (
        (
            f"{each['num_ranks']} x {each['num_threads']}",
            f"{each['update_s']:.3f}",
            f"{each['cpu_s']:.3f}",
            f"{100 * each['efficiency']:.0f} %" if "efficiency" in each else "",
            f"{1e3 * each['message_s']:.2f}" if each["num_ranks"] > 1 else "",
            f"{100 * each['messages_s'] / each['update_s']:.0f} %" if each["num_ranks"] > 1 else "",
        )
        for each in (*result["ranks"], *result["threads"])
    )
    return table(("ranks x threads", "update, s", "CPU, s", "efficiency", "message, ms", "in messages"), rows)


def _serve(end: Connection, rank: int, size: int, port: int, settings: Settings, num_threads: int) -> None:
    group: Group = ALONE
    if size > 1:
        store, device = find_store(HOST, port, TIMEOUT_S), torch.device("cpu")
        group = TorchGroup(store, rank, size, host=HOST, device=device, timeout_s=TIMEOUT_S)
    end.send(measure(group, settings, num_threads))
    end.recv()  # until all have measured: a rank that ends takes its connections with it


def _message_s(group: Group, size: int, num_messages: int) -> float:
    """Median seconds of an all-reduce of ``size`` numbers."""
    numbers, took = torch.zeros(size), []
    for _ in range(num_messages):
        start = time.perf_counter()
        group.sum(numbers)
        took.append(time.perf_counter() - start)
    return statistics.median(took) if took else 0.0


def _make_rollout(config: Config, actor: int, sequence: int, num_worlds: int) -> Rollout:
    rng, game = np.random.default_rng([actor, sequence]), config.game
    num_demonstrations = num_worlds * game.alice_steps // 3
    return Rollout(
        actor=actor,
        incarnation=0,
        sequence=sequence,
        policy_version=sequence,
        alice=_make_turns(rng, game.alice_steps, num_worlds, FULL.size, FULL.size),
        bob=_make_turns(rng, game.bob_steps, num_worlds, BOB.size, BOB_VALUE.size),
        demonstrations=Demonstrations(
            _normal(rng, 0.1, num_demonstrations, BOB.size), _normal(rng, 0.3, num_demonstrations, ACTION.size)
        ),
        records=GoalRecords(**_NO_RECORDS),
        num_env_steps=0,
        metrics={},
    )


_NO_RECORDS: dict[str, Any] = {name: np.zeros(0) for name in GoalRecords.__dataclass_fields__}
"""The learner never reads them."""


def _make_turns(rng: np.random.Generator, num_steps: int, num_worlds: int, observation: int, value: int) -> Turns:
    shape = num_steps, num_worlds
    return Turns(
        observation=_normal(rng, 0.1, *shape, observation),
        value_observation=_normal(rng, 0.1, *shape, value),
        final_value_observation=_normal(rng, 0.1, num_worlds, value),
        action=_normal(rng, 0.7, *shape, ACTION.size),
        log_prob=_normal(rng, 0.1, *shape) - 4.0,
        reward=_normal(rng, 0.1, *shape),
        active=np.ones(shape, dtype=np.bool_),
        terminated=np.zeros(shape, dtype=np.bool_),
        learn=np.ones(num_worlds, dtype=np.bool_),
    )


def _normal(rng: np.random.Generator, scale: float, *shape: int) -> Any:
    return (scale * rng.standard_normal(shape)).astype(np.float32)


def main() -> int:
    """Measure and print."""
    given = parser_of(__doc__, Settings()).parse_args()
    return run_benchmark("learner_ranks", ("numpy", "torch"), given, Settings, benchmark, report)


if __name__ == "__main__":
    raise SystemExit(main())
