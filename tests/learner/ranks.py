"""Processes of their own that learn together over the loopback interface, and what they are asked to do."""

from __future__ import annotations

import multiprocessing
import traceback
from multiprocessing.connection import Connection

import numpy as np
import torch

from service.actors.rollout import Rollout
from service.config import Config
from service.learner.group import ALONE, Group, TorchGroup, find_store, open_store
from service.learner.learner import Learner
from service.learner.shares import share_out

HOST = "127.0.0.1"
TIMEOUT_S = 60.0
"""Of a machine that has other work; no test waits for it."""


class Ranks:
    """Some processes that form a group, and do what they are told until they are closed."""

    def __init__(self, size):
        context = multiprocessing.get_context("spawn")
        pairs = [context.Pipe() for _ in range(size)]
        self._ends = [ours for ours, _ in pairs]
        self.processes = [context.Process(target=_serve, args=(theirs,), daemon=True) for _, theirs in pairs]
        for process in self.processes:
            process.start()
        self.meet()

    def meet(self, timeout_s=TIMEOUT_S):
        """Form a new group, in which the ranks wait so long for each other."""
        self._store = open_store(HOST, TIMEOUT_S)
        for rank, end in enumerate(self._ends):
            end.send((_join_group, (rank, len(self._ends), self._store.port, timeout_s)))
        assert self.answers() == [None] * len(self._ends)

    def run(self, work, *arguments):
        """``work(group, *arguments)`` on all at once; what each returned, or the error it raised."""
        self.send(work, *arguments)
        return self.answers()

    def send(self, work, *arguments):
        """The same without waiting."""
        for end in self._ends:
            end.send((work, arguments))

    def answers(self, *ranks):
        """What these ranks, or all, have to say."""
        return [self._ends[rank].recv() for rank in ranks or range(len(self._ends))]

    def close(self):
        for process in self.processes:
            process.kill()
            process.join()


def _serve(end: Connection) -> None:
    torch.set_num_threads(1)
    group: Group = ALONE
    while True:
        work, arguments = end.recv()
        try:
            if work is _join_group:
                group = _join_group(*arguments)
                end.send(None)
            else:
                end.send(work(group, *arguments))
        except Exception as error:
            traceback.print_exc()
            end.send(error)


def _join_group(rank, size, port, timeout_s):
    store = find_store(HOST, port, TIMEOUT_S)
    return TorchGroup(store, rank, size, host=HOST, device=torch.device("cpu"), timeout_s=timeout_s)


def add_up(group, numbers):
    """Sums over all ranks of (rank + 1) x each of the numbers, as tensors of several shapes."""
    tensors = [torch.full((2, index + 1), (group.rank + 1) * float(number)) for index, number in enumerate(numbers)]
    group.sum(*tensors)
    return [tensor.numpy() for tensor in tensors]


def gather_and_copy(group):
    """What every rank tells the others, and what rank 0 has."""
    tensors = [torch.full((3,), float(group.rank)), torch.tensor(10.0 + group.rank)]
    group.copy_first(tensors)
    numbers = group.gather(np.arange(10 * group.rank, 12 * group.rank))
    return [each.tolist() for each in numbers], [each.tolist() for each in tensors]


def learn(group: Group, config: Config, updates: list[list[Rollout]], state=None, cut=None):
    """A learner's metrics and state after updates, each from its share of some rollouts.

    ``cut`` of the first rank: the others share the rest.
    """
    learner = Learner(config, group)
    if state is not None:
        learner.load_state(state)
    metrics = []
    for rollouts in updates:
        in_order = sorted(rollouts, key=lambda rollout: rollout.id)
        own = share_out(in_order, group.rank, group.size) if cut is None else _cut(in_order, cut, group)
        for rollout in own:
            assert learner.ingest(rollout)
        metrics.append(learner.update())
    return metrics, learner.state()


def learn_alone(config, updates, state=None):
    """The same in this process."""
    return learn(ALONE, config, updates, state)


def advance_random_numbers(group, config, updates):
    """Rank 1 draws once more than the others before the second update."""
    learner = Learner(config, group)
    for rollouts in updates:
        if group.rank == 1:
            learner._rng.random(learner.version)
        for rollout in share_out(rollouts, group.rank, group.size):
            learner.ingest(rollout)
        learner.update()


def _cut(rollouts, cut, group):
    return rollouts[:cut] if group.rank == 0 else rollouts[cut:] if group.rank == 1 else []
