"""Runs to strike at, for ``strikes``: with a Redis, a network that parts, a clock that jumps, several nodes."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from benchmarks.measuring import RECIPE_FILE
from benchmarks.processes import descendants
from benchmarks.training_process import ENDLESS, Training, environment, overrides, scratch
from service.errors import TandemError
from service.io.jsonl import read_jsonl
from service.store.models import RunStatus
from tests.store.redis_server import RedisServer

SETTINGS = {
    **ENDLESS, "game.num_worlds": 48, "run.checkpoint_interval": 10, "run.evaluation_interval": 0, "run.num_threads": 1,
}  # fmt: skip
"""A small game, so that rounds are short beside what is measured."""
ARGUMENTS = ("--config", str(RECIPE_FILE), *overrides(SETTINGS))
CALM = 4
"""Iterations before a strike."""
TICK_S = 0.2
PATIENCE_S = 240.0
_FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
_HEALTH_CHECK = {"initial_delay_ms": "1000", "period_ms": "1000", "timeout_ms": "1000", "failure_threshold": "3"}
_NOTHING: Mapping[str, str] = MappingProxyType({})


@dataclass
class Strike:
    """What was asked of a strike, and what was seen."""

    name: str
    must: str
    measured: str = "not measured"
    reached: bool | None = None
    seconds: float | None = None
    conditions: list[tuple[float, str, str]] = field(default_factory=list)
    """(seconds since the strike, state, condition) at each change, as the status service told."""
    warnings: list[str] = field(default_factory=list)
    tracebacks: int = 0
    lasted_s: float = 0.0
    """Seconds from the strike to the last look."""
    commit: str = ""
    """Of the code that was struck."""
    details: dict[str, Any] = field(default_factory=dict)
    """What else was seen, of strikes at random."""

    def judge(self, measured: str, reached: bool, seconds: float | None = None) -> None:
        """Note the outcome; with a traceback anywhere it is not reached."""
        self.measured, self.reached, self.seconds = measured, reached and not self.tracebacks, seconds


class Watcher:
    """Looks at a run after a strike, again and again."""

    def __init__(self, training: Training, strike: Strike) -> None:
        self._training, self._strike = training, strike
        self.seen: list[RunStatus] = []
        """Every status that was not the one before it."""
        self.struck = time.monotonic()

    def since(self) -> float:
        """Seconds since the strike."""
        return time.monotonic() - self.struck

    def look(self) -> RunStatus | None:
        """The status now; notes what it says that is new."""
        status, strike = self._training.status(), self._strike
        strike.lasted_s = round(self.since(), 1)
        if status is not None:
            if not self.seen or self.seen[-1].heartbeat != status.heartbeat:
                self.seen.append(status)
            if not strike.conditions or strike.conditions[-1][1:] != (status.state, status.condition):
                strike.conditions.append((round(self.since(), 1), status.state, status.condition))
            strike.warnings += [text for text in status.warnings if _kind(text) not in map(_kind, strike.warnings)]
        return status

    def until(self, holds: Callable[[RunStatus], bool], seconds: float = PATIENCE_S) -> float | None:
        """Seconds since the strike until the status is so; None if it was not in time."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if (status := self.look()) is not None and holds(status):
                return self.since()
            time.sleep(TICK_S)
        return None

    def until_well(self, seconds: float = 60.0) -> float | None:
        """Seconds since the strike until the run is well again."""
        return self.until(lambda status: status.condition == "well", seconds)

    def until_iterations(self, num: int, seconds: float = PATIENCE_S) -> float | None:
        """Seconds since the strike until so many more iterations are over."""
        iteration = (self.look() or no_status()).iteration
        return self.until(lambda status: status.iteration >= iteration + num, seconds)


def _kind(text: str) -> str:
    """A warning without its numbers."""
    return "".join(each for each in text if not each.isdigit())


@contextmanager
def run_of(
    strike: Strike,
    *,
    runtime: Literal["local", "ray"] = "ray",
    arguments: Sequence[str] = (),
    variables: Mapping[str, str] = _NOTHING,
    home: Path | None = None,
) -> Iterator[Training]:
    """A training that has made some iterations; counts the tracebacks in its log at the end."""
    arguments = [*ARGUMENTS, *(["--num-actors", "2"] if runtime == "ray" else []), *arguments]
    with ExitStack() as stack:
        home = home or stack.enter_context(scratch())
        training = stack.enter_context(Training(home, arguments, runtime=runtime, variables=variables))
        training.wait_until("iteration", CALM)
        yield training
        training.stop()
        strike.tracebacks += training.log_file.read_text(errors="replace").count("Traceback (most recent call last)")


def workers_of(status: RunStatus | None) -> dict[str, tuple[int | None, int]]:
    """Pid and incarnation of every worker by name."""
    return {} if status is None else {each.name: (each.pid, each.incarnation) for each in status.actors}


def wait_for_all(training: Training) -> dict[str, tuple[int | None, int]]:
    """Wait until every worker has a process."""
    training.wait_for(lambda: (all_ := workers_of(training.status())) and all(pid for pid, _ in all_.values()))
    return workers_of(training.status())


def changed(before: Mapping[str, Any], after: Mapping[str, Any], but: str = "") -> list[str]:
    """Workers that are not the ones from before, without the one that was struck."""
    return [each for each in before if each != but and after.get(each) != before[each]]


def replaced_and_working(watcher: Watcher, name: str, incarnation: int) -> float | None:
    """Seconds since the strike until another worker has the place, and two more iterations are over."""
    if watcher.until(lambda status: _is_next(status, name, incarnation)) is None:
        return None
    return watcher.until_iterations(2)


def _is_next(status: RunStatus, name: str, incarnation: int) -> bool:
    pid, now = workers_of(status)[name]
    return pid is not None and now > incarnation


def rows_of(training: Training) -> list[dict[str, Any]]:
    """Records of a run."""
    return read_jsonl(training.directory.metrics_file)


def versions_are_whole(training: Training) -> bool:
    """Whether the records have every version of the policy, once."""
    versions = [row["learner/version"] for row in rows_of(training)]
    return versions == list(range(1, len(versions) + 1))


def no_status() -> RunStatus:
    """Complain.

    Raises:
        TandemError: always.
    """
    raise TandemError("the run has no status")


def seconds_text(seconds: float | None) -> str:
    """Seconds for people."""
    return "never" if seconds is None else f"{seconds:.1f} s"


# --- Redis ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StruckRedis:
    """A Redis that can be taken away."""

    variables: Mapping[str, str]
    """For a training that reports to it, through what is struck."""
    direct: Mapping[str, str]
    """For one that always reaches it."""
    away: Callable[[], object]
    come_back: Callable[[], object]


@contextmanager
def redis_to_strike(how: str) -> Iterator[StruckRedis]:
    """A Redis to freeze, to kill, to kill and cut its file, or to part from everybody by the network."""
    with ExitStack() as stack:
        place = stack.enter_context(scratch())
        servers = [RedisServer(place / "redis")]
        stack.callback(lambda: servers[-1].close())
        url, pid = servers[0].address.url, servers[0].pid
        port, password = int(url.rpartition(":")[2].partition("/")[0]), url.removeprefix("redis://:").partition("@")[0]

        def come_back() -> None:
            servers[-1].close()
            if how == "cut":
                for file in (place / "redis").rglob("*.aof"):
                    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
            servers.append(RedisServer(place / "redis", port=port, password=password))

        if how == "parted":
            network = stack.enter_context(Network(port))
            through = {"TANDEM_REDIS_URL": url.replace(f":{port}/", f":{network.port}/")}
            yield StruckRedis(through, {"TANDEM_REDIS_URL": url}, network.parted.set, network.parted.clear)
            return
        variables = {"TANDEM_REDIS_URL": url}
        if how == "frozen":
            yield StruckRedis(
                variables, variables, lambda: os.kill(pid, signal.SIGSTOP), lambda: os.kill(pid, signal.SIGCONT)
            )
        else:
            yield StruckRedis(variables, variables, lambda: servers[-1].kill(), come_back)


class Network:
    """A network between anybody and one port of this machine: while it is parted nothing gets through, nor is refused.

    Args:
        target: the port.
    """

    def __init__(self, target: int) -> None:
        self.parted = threading.Event()
        self._target, self._sockets = target, list[socket.socket]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Network:
        return self

    def __exit__(self, *error: object) -> None:
        for each in (self._listener, *self._sockets):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                self._sockets += [near, far]
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=(source, sink), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                while self.parted.is_set():
                    time.sleep(0.02)
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_WR)


# --- a clock, nodes ---------------------------------------------------------------------------------------------------


class Clock:
    """The wall clock of a process, by libfaketime; what counts seconds (``CLOCK_MONOTONIC``) stays right.

    Args:
        directory: for its file.
    """

    def __init__(self, directory: Path) -> None:
        self._file = directory / "clock"
        self.jump(0)
        self.variables = {
            "LD_PRELOAD": str(_FAKETIME), "FAKETIME_TIMESTAMP_FILE": str(self._file), "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1", "DONT_FAKE_MONOTONIC": "1",
        }  # fmt: skip

    @staticmethod
    def is_there() -> bool:
        """Whether libfaketime is installed."""
        return _FAKETIME.exists()

    def jump(self, ahead_s: float) -> None:
        """Let the clock be so many seconds ahead of the real one."""
        new = self._file.with_suffix(".new")
        new.write_text(f"{ahead_s:+.0f}\n")
        new.replace(self._file)


class Nodes:
    """A Ray cluster of processes of this machine: a head without cores, and nodes that hold a whole run each.

    Args:
        home: for Ray's files; its path has to be short.
        num: of the nodes beside the head.
    """

    def __init__(self, home: Path, num: int = 2) -> None:
        # as deploy/ has it: a node that does not answer is given up after six seconds
        os.environ |= {f"RAY_health_check_{name}": value for name, value in _HEALTH_CHECK.items()}
        # one token for all clusters of this process: Ray reads it once
        kept = {name: os.environ[name] for name in ("RAY_AUTH_TOKEN",) if name in os.environ}
        os.environ |= {name: value for name, value in environment(home).items() if name.startswith("RAY_")} | kept
        from ray.cluster_utils import Cluster

        store: dict[str, Any] = {"object_store_memory": 150_000_000}
        head = {"num_cpus": 0, "include_dashboard": False, "temp_dir": str(home / "ray"), **store}
        (home / "ray").mkdir()
        self._cluster = Cluster(initialize_head=True, head_node_args=head)
        self._nodes = [self._cluster.add_node(num_cpus=4, **store) for _ in range(num)]
        self.variables = {name: value for name, value in os.environ.items() if name.startswith("RAY_")}
        self.address = str(self._cluster.address)

    def __enter__(self) -> Nodes:
        return self

    def __exit__(self, *error: object) -> None:
        self._cluster.shutdown()

    def of(self, pid: int) -> list[int]:
        """Pids of the node that a worker is on, the raylet first; it has the workers as children."""
        for node in self._nodes:
            raylet = node.all_processes["raylet"][0].process.pid
            if pid in (below := descendants(raylet)):
                return list(below)
        raise TandemError(f"process {pid} is on no node")


@contextmanager
def run_on_nodes(strike: Strike) -> Iterator[tuple[Nodes, Training]]:
    """A training, as of ``run_of``, on two nodes; its driver and its status service are on the head."""
    with (
        scratch() as place,
        Nodes(place) as nodes,
        run_of(
            strike, arguments=["--address", nodes.address, "--learner-cpus", "1"], variables=nodes.variables
        ) as training,
    ):
        yield nodes, training
