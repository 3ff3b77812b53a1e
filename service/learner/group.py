"""The ranks of a learner: processes that learn together, each from its own rollouts.

Rank r of R. The learner knows only ``Group``. ``ALONE`` is the group of a learner of one process, which sends nothing;
``TorchGroup`` sends through ``torch.distributed``: Gloo between CPUs, NCCL between GPUs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, Protocol

import numpy as np
import torch
import torch.distributed
from torch import Tensor

from service.errors import GroupError
from service.types import IntArray

_dist: Any = torch.distributed
"""Its stubs lack what is used here."""
Store = Any
"""Meeting place of the ranks of a group: a ``torch.distributed.TCPStore``."""


class Group(Protocol):
    """Operations of all ranks together. Every rank makes the same calls in the same order, each waits for all.

    All calls raise ``GroupError`` where another rank does not answer in time.
    """

    rank: int
    """From 0; rank 0 hands out what all ranks have alike."""
    size: int

    def sum(self, *tensors: Tensor) -> None:
        """Replace each tensor by its sum over all ranks, in one message; equal bits on every rank.

        Args:
            tensors: any shapes, of one dtype and device; of equal shapes on every rank.
        """

    def gather(self, numbers: IntArray) -> list[IntArray]:
        """Collect (N,) integers of every rank, by rank; N may differ."""

    def copy_first(self, tensors: Sequence[Tensor]) -> None:
        """Overwrite tensors with those of rank 0, in one message."""


class Alone:
    """The group of the only rank."""

    rank, size = 0, 1

    def sum(self, *tensors: Tensor) -> None:
        """Leave the tensors: each is the sum."""

    def gather(self, numbers: IntArray) -> list[IntArray]:
        """Collect the numbers of the only rank."""
        return [numbers]

    def copy_first(self, tensors: Sequence[Tensor]) -> None:
        """Leave the tensors: they are those of rank 0."""


ALONE = Alone()


class TorchGroup:
    """One rank of several processes.

    Args:
        store: of rank 0, where the ranks find each other; see ``open_store`` and ``find_store``.
        rank, size: of this process, and of the group.
        host: address of this node that the other nodes reach.
        device: of the tensors: Gloo on the CPU, NCCL on a GPU.
        timeout_s: most time that a call waits for the other ranks.

    Raises:
        GroupError: the ranks cannot reach each other.
    """

    def __init__(
        self, store: Store, rank: int, size: int, *, host: str, device: torch.device, timeout_s: float
    ) -> None:
        self.rank, self.size = rank, size
        self._device, self._timeout_s = device, timeout_s
        timeout = timedelta(seconds=timeout_s)
        try:
            if device.type == "cuda":
                options = _dist.ProcessGroupNCCL.Options()
                options._timeout = timeout
                self._ranks = _dist.ProcessGroupNCCL(store, rank, size, options)
            else:
                # By itself Gloo takes the address that the host's name stands for: often one of the loopback interface.
                options = _dist.ProcessGroupGloo._Options()
                options._devices = [_dist.ProcessGroupGloo.create_device(hostname=host)]
                options._timeout = timeout
                self._ranks = _dist.ProcessGroupGloo(store, rank, size, options)
        except RuntimeError as error:
            raise GroupError(
                f"learner rank {rank} of {size} at {host}: no connection to the other ranks within {timeout_s:g} s: "
                f"open all ports between the nodes ({_first_line(error)})"
            ) from None

    def sum(self, *tensors: Tensor) -> None:
        """Replace each tensor by its sum over all ranks."""
        flat = _flat(tensors).to(self._device)
        self._wait(lambda: self._ranks.allreduce([flat]))
        _copy_back(flat, tensors)

    def gather(self, numbers: IntArray) -> list[IntArray]:
        """Collect integers of every rank."""
        sizes = [int(size[0]) for size in self._gather(np.array([len(numbers)]))]
        padded = np.zeros(max(sizes), dtype=np.int64)
        padded[: len(numbers)] = numbers
        return [each[:size] for each, size in zip(self._gather(padded), sizes, strict=True)]

    def copy_first(self, tensors: Sequence[Tensor]) -> None:
        """Overwrite tensors with those of rank 0."""
        flat = _flat(tensors).to(self._device)
        self._wait(lambda: self._ranks.broadcast([flat]))
        _copy_back(flat, tensors)

    def _gather(self, numbers: IntArray) -> list[IntArray]:
        """Collect equally many integers of every rank."""
        own = torch.from_numpy(numbers).to(self._device)
        everyones = [torch.empty_like(own) for _ in range(self.size)]
        if len(numbers):
            self._wait(lambda: self._ranks.allgather([everyones], [own]))
        return [each.cpu().numpy() for each in everyones]

    def _wait(self, begin: Callable[[], Any]) -> None:
        try:
            begin().wait()  # NCCL connects at the first one, so beginning may fail, too
        except RuntimeError as error:
            raise GroupError(
                f"learner rank {self.rank} of {self.size}: another rank is gone, or did not answer within "
                f"{self._timeout_s:g} s ({_first_line(error)})"
            ) from None


def open_store(host: str, timeout_s: float) -> Store:
    """Open the store of rank 0, at a free port of ``host``, its ``port``; an answer may take ``timeout_s``."""
    return _dist.TCPStore(host, 0, None, True, timedelta(seconds=timeout_s), wait_for_workers=False)


def find_store(host: str, port: int, timeout_s: float) -> Store:
    """Find the store that rank 0 opened.

    Raises:
        GroupError: nothing answers there.
    """
    try:
        return _dist.TCPStore(host, port, None, False, timedelta(seconds=timeout_s))
    except RuntimeError as error:
        raise GroupError(
            f"learner rank 0 does not answer at {host}:{port} within {timeout_s:g} s: open all ports between the "
            f"nodes ({_first_line(error)})"
        ) from None


def mean_and_std(values: Tensor, num: int, group: Group) -> tuple[float, float]:
    """Mean and standard deviation of the (N,) values of all ranks, ``num`` together."""
    mean = _total(values, group) / num
    return mean, math.sqrt(_total((values - mean).square(), group) / num)


def _total(values: Tensor, group: Group) -> float:
    total = values.sum()
    group.sum(total)
    return float(total)


def _flat(tensors: Sequence[Tensor]) -> Tensor:
    return torch.cat([tensor.detach().reshape(-1) for tensor in tensors])


def _copy_back(flat: Tensor, tensors: Sequence[Tensor]) -> None:
    parts = flat.split([tensor.numel() for tensor in tensors])
    for tensor, part in zip(tensors, parts, strict=True):
        tensor.detach().copy_(part.view_as(tensor))


def _first_line(error: RuntimeError) -> str:
    lines = str(error).strip().splitlines()
    return (lines[0] if lines else type(error).__name__)[:200]
