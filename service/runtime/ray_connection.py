"""Connection of this process to a Ray cluster: one that runs, or a new one on this machine."""

from __future__ import annotations

import logging
import os
import secrets
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from service.config import LearnerConfig
from service.runtime.runner import ClusterError

CONNECT_S = 5.0
START_ATTEMPTS = 3
"""Ray gives up on a node of its own after 30 s, which a busy machine may need."""


@dataclass(frozen=True, slots=True)
class StatusOptions:
    """Address and token of the status service of a run on a cluster."""

    host: str = "127.0.0.1"
    port: int = 8321
    """0: one that is free."""
    token: str | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class ClusterOptions:
    """Resources of a run on a cluster; no part of the experiment, and free to change when it is resumed."""

    num_actors: int | None = None
    """Rollout actors; None: as many as there are cores for, following the cluster as it grows and shrinks."""
    actor_threads: int = 1
    """Cores of each."""
    learner_cpus: float = 0.0
    """Reserved for each rank of the learner; 0: see ``rank_cpus``."""
    status: StatusOptions | None = None
    """None: no status service of its own."""

    def rank_cpus(self, learner: LearnerConfig) -> float:
        """Cores reserved for each rank of a run's learner.

        Without a wish the only one shares the actors' cores, which is right where physics is the bottleneck, and each
        of several takes as many as it has threads.
        """
        return self.learner_cpus or float(learner.num_threads * (learner.num_learners > 1))


def parse_status(text: str, token: str | None) -> StatusOptions | None:
    """Parse ``HOST:PORT`` or ``off``.

    Raises:
        ClusterError: neither.
    """
    if text == "off":
        return None
    host, separator, port = text.rpartition(":")
    if not separator or not host or not port.isdecimal():
        raise ClusterError(f"--status {text!r}: expected HOST:PORT, such as 127.0.0.1:8321, or off")
    return StatusOptions(host.strip("[]"), int(port), token)


@contextmanager
def connected(address: str | None, num_cpus: int | None = None) -> Iterator[None]:
    """Be a driver of a Ray cluster, for as long as the block runs.

    Args:
        address: ``auto`` for the one on this machine or of the Ray job that this process is, or ``HOST:PORT``; None for
            the job's, and outside of a job for a new one on this machine, which ends with the block.
        num_cpus: of a new one; None: all there are.

    Raises:
        ClusterError: nobody there, another version of Ray or Python there, or it does not let us in.
    """
    address = address or ("auto" if os.environ.get("RAY_ADDRESS") else None)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    chosen = {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys()
    if address is None and not chosen and "ray" not in sys.modules:  # Ray reads them when it is imported
        # Else Ray would leave a token in the home directory, and every later cluster there would take it up.
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    if address is None:
        os.environ.setdefault("RAY_worker_niceness", "0")  # not 15 for all: see ``ray_actors.lower_priority``
        # No spare worker for every core: ours have environment variables of their own, so none would fit.
        os.environ.setdefault("RAY_prestart_worker_first_driver", "0")
    import ray

    _check_reachable(address)
    options: dict[str, Any] = {"num_cpus": num_cpus, "include_dashboard": False} if address is None else {}
    for attempt in range(START_ATTEMPTS, 0, -1):
        try:
            ray.init(address or "local", logging_level=logging.WARNING, **options)
            break
        except Exception as error:  # other versions, a refused token, a slow node: Ray has no common class for them
            ray.shutdown()
            if attempt == 1 or address is not None or "timed out during startup" not in str(error):
                raise ClusterError(_explained(address, error)) from None
    try:
        yield
    finally:
        ray.shutdown()


def cluster_size(address: str | None) -> tuple[str, float]:
    """The address at which other processes reach the cluster that this one is connected to, and its cores.

    Args:
        address: that was given to ``connected``.
    """
    import ray

    named = address if address not in (None, "auto") else ray.get_runtime_context().gcs_address
    return str(named), float(ray.cluster_resources().get("CPU", 0.0))


def _check_reachable(address: str | None) -> None:
    """Check that something answers; Ray itself would end the whole process where nothing does."""
    host, separator, port = (address or "").removeprefix("ray://").rpartition(":")
    if not separator:
        return
    if not port.isdecimal():
        raise ClusterError(f"--address {address}: expected auto or HOST:PORT, as ray start prints it")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise ClusterError(_explained(address, error)) from None


def _explained(address: str | None, error: Exception) -> str:
    said = " ".join(str(error).split())
    if "ersion" in said and "mismatch" in said.lower():
        what = "it runs other versions of Ray or Python than this process; use the same image or environment everywhere"
    elif "token" in said.lower() or "authenti" in said.lower():
        what = "it does not let us in: set RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to its token"
    elif address is None:
        what = "Ray does not start here"
    else:
        what = "no Ray cluster answers there: is it up (ray status), and is the address right (ray start prints it)?"
    return f"--address {address or '(none)'}: {what}. It says: {said[:300]}"
