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
from functools import partial
from typing import Any

from service.base.errors import ConfigError, TandemError, needs_extra, one_line
from service.base.progress import answer, doing
from service.methods.method import WorkersError
from service.runs.signals import InterruptError, StopSignals

CONNECT_S = 5.0
_CLUSTERS_VARIABLE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""With 0 a Ray has one machine, and every port that it opens is on loopback; on Linux, too, despite the name."""
START_ATTEMPTS = 3
"""Ray gives up on a node of its own after 30 s, which a busy machine may need."""

_NO_ANSWER = (
    "no Ray cluster answers there: is it up (ray status), is the address right (ray start prints it), and is its token "
    "in RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH"
)


@dataclass(frozen=True, slots=True)
class StatusOptions:
    """Address and token of the status service of a run on a cluster."""

    host: str = "127.0.0.1"
    port: int | None = None
    """See ``choose_port``."""
    token: str | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True)
class ClusterOptions:
    """Resources of a run on a cluster; no part of the experiment, and free to change when it is resumed."""

    num_actors: int | None = None
    """Rollout actors; None: as many as there are cores for, following the cluster as it grows and shrinks."""
    actor_threads: int = 1
    """Cores of each."""
    learner_cpus: float = 0.0
    """Reserved for the learner; with 0 it shares the actors' cores, which is right where physics is the bottleneck."""
    status: StatusOptions | None = None
    """None: no status service of its own."""


def parse_status(text: str | None, token: str | None) -> StatusOptions | None:
    """Parse ``HOST:PORT`` or ``off``; None is this machine alone, at the usual port or the next free one.

    Raises:
        ConfigError: neither.
    """
    if text is None:
        return StatusOptions(token=token)
    if text == "off":
        return None
    host, separator, port = text.rpartition(":")
    if not separator or not host or not port.isdecimal() or len(port) > 5 or int(port) > 65535:
        raise ConfigError(f"--status {text!r}: expected HOST:PORT, such as 127.0.0.1:8321, or off")
    return StatusOptions(host.strip("[]"), int(port), token)


def num_gpus(device: str) -> int:
    """GPUs that a learner asks Ray for; an actor that asks for none sees none."""
    import ray

    if device == "auto":
        return int(ray.cluster_resources().get("GPU", 0.0) >= 1.0)
    return int(device == "cuda")


@contextmanager
def connected(address: str | None) -> Iterator[None]:
    """Be a driver of a Ray cluster, for as long as the block runs.

    Args:
        address: ``auto`` for the one on this machine or of the Ray job that this process is, or ``HOST:PORT``; None for
            the job's, and outside of a job for a new one on this machine, which ends with the block.

    Raises:
        WorkersError: nothing there, another version of Ray or Python there, or it does not let us in; or Ray fails
            while the block runs.
        InterruptError: a signal for which no other handler was set.
    """
    address = address or ("auto" if os.environ.get("RAY_ADDRESS") else None)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    chosen = {"RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & os.environ.keys()
    if address is None and not chosen and "ray" not in sys.modules:  # Ray reads them when it is imported
        # Else Ray would leave a token in the home directory, and every later cluster there would take it up.
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    if address is None:
        os.environ.setdefault(_CLUSTERS_VARIABLE, "0")
        os.environ.setdefault("RAY_worker_niceness", "0")  # not 15 for all: see ``ray_actors.NICENESS``
        # Else Ray gives its only node up once it was frozen for ten seconds for the fifth time; ``raylet`` watches it.
        os.environ.setdefault("RAY_health_check_failure_threshold", "1000000")
        # No spare worker for every core: a run begins no sooner with them, and may need fewer.
        os.environ.setdefault("RAY_prestart_worker_first_driver", "0")
    with needs_extra("cluster", "--runtime ray"):
        import ray
    _check_reachable(address)
    options: dict[str, Any] = {"include_dashboard": False} if address is None else {}
    with StopSignals() as signals:
        wait = partial(answer, "stopping once Ray has started; again to end now")  # else some processes of its stay
        try:
            with doing("starting Ray" if address is None else f"connecting to Ray at {address}"), signals.asking(wait):
                _init(address, options)
            if signals.first is not None:
                raise InterruptError(signals.first)
            with explaining_ray_errors():
                yield
        finally:
            ray.shutdown()


def _init(address: str | None, options: dict[str, Any]) -> None:
    import ray

    ray._private.utils.set_sigterm_handler = lambda handler: None  # Ray's own would end the process without a word
    for attempt in range(START_ATTEMPTS, 0, -1):
        try:
            ray.init(address or "local", logging_level=logging.WARNING, **options)
            return
        except Exception as error:  # other versions, a refused token, a slow node: Ray has no common class for them
            ray.shutdown()
            if attempt == 1 or address is not None or "timed out during startup" not in str(error):
                raise WorkersError(_explained(address, error)) from None


@contextmanager
def explaining_ray_errors() -> Iterator[None]:
    """Turn what Ray says of a worker that failed, which has the worker's traceback in it, into one line.

    Raises:
        TandemError: what the worker itself raised for people.
        WorkersError: the worker, or what it made, is gone.
        RuntimeError: anything else that a worker raised; its traceback is in the cause.
    """
    from ray.exceptions import RayError, RayTaskError

    try:
        yield
    except RayTaskError as error:
        if isinstance(error.cause, TandemError):
            raise error.cause from None
        raise RuntimeError(f"a worker failed: {type(error.cause).__name__}: {error.cause}") from error
    except (RayError, OSError) as error:
        if isinstance(error, OSError) and (type(error) is not OSError or error.errno is not None):  # none of Ray's
            raise
        raise WorkersError(
            f"Ray gave up: {last_line(error)}; see ray status, and continue with --resume from what was saved"
        ) from error


def _check_reachable(address: str | None) -> None:
    """Check that something answers; Ray itself would end the whole process where nothing does."""
    host, separator, port = (address or "").removeprefix("ray://").rpartition(":")
    if not separator:
        return
    if not port.isdecimal():
        raise ConfigError(f"--address {address}: expected auto or HOST:PORT, as ray start prints it")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise WorkersError(_explained(address, error)) from None


def last_line(error: BaseException) -> str:
    """An error of Ray's in a line: what it says in the end, after a traceback or a table of ids."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[-1].strip() if lines else ''}"[:200]


def _explained(address: str | None, error: Exception) -> str:
    said = " ".join(str(error).split())
    if "ersion" in said and "mismatch" in said.lower():
        what = "it runs other versions of Ray or Python than this process; use the same image or environment everywhere"
    elif "token" in said.lower() or "authenti" in said.lower():
        what = "it does not let us in: set RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH to its token"
    elif address is None:
        what = "Ray does not start here"
    else:
        what = _NO_ANSWER
    return f"--address {address or '(none)'}: {what}. It says: {one_line(said, 300)}"
