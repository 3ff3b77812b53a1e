"""A ``tandem pretrain --runtime ray`` in a process of its own, seen as an operator sees it: pids, REST, files."""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from http.client import HTTPException
from pathlib import Path
from tempfile import mkdtemp
from types import TracebackType
from typing import Any, Self, TypeVar

from pydantic import ValidationError

from benchmarks.processes import descendants, is_running
from service.errors import TandemError
from service.io.checkpoints import CheckpointStore
from service.io.jsonl import read_jsonl
from service.io.run_directory import RunDirectory
from service.store.disk import STATUS_FILE
from service.store.models import RunStatus

ROOT = Path(__file__).parents[1]
RUN_ID = "run"
ENDLESS = "run.total_env_steps=1000000000000"
START_S = 240.0
"""Until the first iteration, on a machine that may be busy."""
STOP_S = 60.0
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
_Answer = TypeVar("_Answer")


class Training:
    """A run on a Ray of its own on this machine; ends with the block.

    Args:
        home: directory for its run, its registry and Ray's files; its path has to be short.
        arguments: of ``tandem pretrain``, besides runtime, run id and status.
        redis_url: of a Redis to use; None: no Redis.
        name: the run's id.
    """

    def __init__(
        self, home: Path, arguments: Sequence[str], *, redis_url: str | None = None, name: str = RUN_ID
    ) -> None:
        self.directory = RunDirectory(home / "runs" / name)
        self.log_file = home / f"{name}.log"
        self._url = f"http://127.0.0.1:{(port := _free_port())}"
        command = [sys.executable, "-m", "service", "pretrain", "--runtime", "ray", "--run-id", name]
        command += ["--runs", str(home / "runs"), "--registry", str(home / "registry")]
        with self.log_file.open("ab") as log:
            self._process = subprocess.Popen(
                [*command, "--status", f"127.0.0.1:{port}", *arguments],
                cwd=ROOT,
                env={**environment(home), **({"TANDEM_REDIS_URL": redis_url} if redis_url else {})},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self.name = name

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Of the driver."""
        return self._process.pid

    @property
    def ended(self) -> int | None:
        """The exit code; None while it goes on."""
        return self._process.poll()

    def processes(self) -> dict[int, str]:
        """Roles of its processes by pid."""
        return descendants(self.pid)

    def get(self, path: str, timeout_s: float = 5.0) -> Any:
        """What the status service answers, parsed; None if it does not within ``timeout_s``."""
        body = self.text(path, timeout_s)
        return None if body is None else json.loads(body)

    def text(self, path: str, timeout_s: float = 5.0) -> bytes | None:
        """What the status service answers, as it is; None if it does not within ``timeout_s``."""
        try:
            with _DIRECT.open(self._url + path, timeout=timeout_s) as response:
                return bytes(response.read())
        except (OSError, HTTPException):
            return None

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the status service."""
        host, _, port = self._url.removeprefix("http://").partition(":")
        return host, int(port)

    def status(self) -> RunStatus | None:
        """The run as the status service tells it, else as its directory does; None before it tells anything."""
        if (told := self.get(f"/v1/runs/{self.name}", timeout_s=2.0)) is not None:
            return RunStatus.model_validate(told)
        try:
            return RunStatus.model_validate_json((self.directory.path / STATUS_FILE).read_bytes())
        except (OSError, ValidationError):
            return None

    def records(self) -> list[dict[str, Any]]:
        """Its metrics so far."""
        return read_jsonl(self.directory.metrics_file) if self.directory.metrics_file.exists() else []

    def wait_for(self, what: Callable[[], _Answer | None], seconds: float = START_S) -> _Answer:
        """The first answer of ``what`` that is true.

        Raises:
            TandemError: the run ended, or there was none in time.
        """
        deadline_s = time.monotonic() + seconds
        while self.ended is None and time.monotonic() < deadline_s:
            if answer := what():
                return answer
            time.sleep(0.05)
        why = f"not within {seconds:.0f} s" if self.ended is None else f"it ended with code {self.ended}"
        raise TandemError(f"the run does not do what is waited for: {why}; its last words: {self.last_words()}")

    def wait_for_iterations(self, num: int) -> RunStatus:
        """Wait until so many are finished and the status service says so.

        Raises:
            TandemError: see ``wait_for``.
        """

        def reached() -> RunStatus | None:
            told = self.get(f"/v1/runs/{self.name}")
            return RunStatus.model_validate(told) if told and told["iteration"] >= num else None

        return self.wait_for(reached)

    def wait(self, seconds: float) -> int:
        """The exit code, when it ends by itself.

        Raises:
            TandemError: it does not within ``seconds``.
        """
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            raise TandemError(f"the run has not ended within {seconds:.0f} s; see its log") from None

    def stop(self) -> None:
        """As ``ray job stop`` does: SIGTERM, which saves; what is left after a minute is killed."""
        if self.ended is None:
            before = descendants(self.pid)
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            for pid in before:
                _end(pid)

    def last_words(self) -> str:
        """The end of its log."""
        lines = self.log_file.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "none"


def environment(home: Path) -> dict[str, str]:
    """For processes that use a Ray of their own: its files under ``home``, a token of its own, nothing else set."""
    unset = ("RAY_ADDRESS", "TANDEM_REDIS_URL", "TANDEM_TOKEN", "TANDEM_RUNS", "TANDEM_REGISTRY")
    ray = {"RAY_TMPDIR": str(home), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    kept = {name: value for name, value in os.environ.items() if name not in unset}
    return {**kept, **ray, **threads, "RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(ROOT)}


@contextmanager
def scratch() -> Iterator[Path]:
    """A directory with a short path, as Ray's sockets need, deleted at the end."""
    path = Path(mkdtemp(prefix="td-", dir="/tmp"))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def copy_run(source: RunDirectory, target: RunDirectory) -> None:
    """Copy what another process needs to go on from the newest checkpoint of ``source``.

    Raises:
        TandemError: no run there, or one without a checkpoint.
    """
    source.read_config()
    store = CheckpointStore(source.checkpoints, keep=1)
    if not store.steps():
        raise TandemError(f"no checkpoint in {source.checkpoints}; name a run that has one")
    target.checkpoints.mkdir(parents=True)
    shutil.copy(store.path(store.steps()[-1]), target.checkpoints)
    shutil.copy(source.config_file, target.config_file)


def overrides(settings: Mapping[str, object]) -> list[str]:
    """``--set`` arguments of the command line."""
    return [part for key, value in settings.items() for part in ("--set", f"{key}={value}")]


def _end(pid: int) -> None:
    """What a stopped run left behind, after a moment to end by itself."""
    for _ in range(100):
        if not is_running(pid):
            return
        time.sleep(0.05)
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
