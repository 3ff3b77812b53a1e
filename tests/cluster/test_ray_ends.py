"""A ``tandem pretrain --runtime ray`` that is struck from outside: its exit code, its last line, its status."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil

from benchmarks.processes import descendants
from service.base.jsonl import read_jsonl
from service.store.models import read_status
from service.store.run_directory import RunDirectory
from tests.runs.runs import ROOT, assert_one_line, is_alive, write_yaml

PATIENCE_S = 300.0
SOONER = """
from contextlib import contextmanager
from service.cluster import ray_connection
real = ray_connection.connected
@contextmanager
def connected(*arguments):
    with real(*arguments):
        from service.cluster import watch  # not before: Ray takes what it is told when it is imported
        watch.SILENT_S, watch.LOST_S = 1.0, 4.0
        yield
ray_connection.connected = connected
"""
"""Has a frozen raylet noticed sooner."""


@contextmanager
def run_on_ray(home, before=""):
    """A run that ends only by what is done to it; its process has done ``before`` first."""
    paths = {"--config": write_yaml(home / "tiny.yaml"), "--run-dir": home / "run", "--registry": home / "registry"}
    arguments = [part for pair in paths.items() for part in map(str, pair)]
    endless = ("--set", "run.total_env_steps=1_000_000_000", "--set", "run.checkpoint_interval=1_000_000")
    code = f"{before}\nfrom service.cli.main import main; main()"
    command = [sys.executable, "-c", code, "pretrain", "--runtime", "ray", "--status", "off", "--num-actors", "1"]
    with (home / "out").open("w") as out, (home / "err").open("w") as err:
        process = subprocess.Popen([*command, *arguments, *endless], cwd=ROOT, stdout=out, stderr=err)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def wait_until(process, holds):
    """Wait until it is so; the process must not have ended before."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert process.poll() is None
        assert time.monotonic() < deadline_s
        time.sleep(0.2)


def test_a_signal_while_it_starts(tmp_path):
    with run_on_ray(tmp_path) as process:
        wait_until(process, lambda: "learner" in descendants(process.pid).values())
        below = descendants(process.pid)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 128 + signal.SIGTERM
    assert (tmp_path / "out").read_text() == "stopped at once; nothing was saved yet\n"
    assert "Traceback" not in (tmp_path / "err").read_text()
    assert [role for pid, role in below.items() if is_alive(pid)] == []


def assert_on_loopback(pid):
    """A Ray of our own is for this machine alone."""
    root = psutil.Process(pid)
    connections = [each for part in (root, *root.children(recursive=True)) for each in part.net_connections("tcp")]
    addresses = [each.laddr.ip for each in connections if each.status == psutil.CONN_LISTEN]
    assert len(addresses) >= 8  # of its control store, node, agents, workers and the driver
    assert set(addresses) <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


def test_a_raylet_that_is_frozen_for_ever_ends_the_run(tmp_path):
    """No call of the driver needs to come back for that, and nobody is blamed for it, or replaced in vain."""
    directory = RunDirectory(tmp_path / "run")
    with run_on_ray(tmp_path, SOONER) as process:
        wait_until(process, lambda: directory.metrics_file.exists() and len(read_jsonl(directory.metrics_file)) >= 2)
        below = descendants(process.pid)
        assert_on_loopback(process.pid)
        os.kill(next(pid for pid, role in below.items() if role == "raylet"), signal.SIGSTOP)
        assert process.wait(PATIENCE_S) == 1
    said = (tmp_path / "err").read_text().strip().splitlines()[-1]
    assert_one_line(said, "the raylet, has not answered for ", "--resume goes on from iteration 0")
    status = read_status(directory.path)
    assert (status.state, status.last_error) == ("failed", said.replace("error", "WorkersError", 1))
    assert {actor.incarnation for actor in status.actors} == {0}
    ours = ("actor", "learner", "generator", "raylet", "gcs")  # Ray's two agents notice it within a minute
    assert [role for pid, role in below.items() if role in ours and is_alive(pid)] == []
