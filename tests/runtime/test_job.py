"""``ray job submit``, for real: a head, a job that is stopped and submitted again, its status over REST, primitives."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import pytest
from ray.job_submission import JobSubmissionClient

from service.registry.registry import Registry
from tests.runtime.runs import newest, read_lines, write_yaml

RAY = Path(sys.executable).with_name("ray")


def free_ports(num):
    """Ports nobody has, above those that Ray gives to its workers."""
    probes, ports = [], []
    while len(ports) < num:
        probe = socket.socket()
        probes.append(probe)
        probe.bind(("127.0.0.1", 0))
        if (port := probe.getsockname()[1]) > 20_000:
            ports.append(port)
    for probe in probes:
        probe.close()
    return ports


def wait_for(what, seconds=120.0):
    """The first true answer of ``what``."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if answer := what():
            return answer
        time.sleep(0.25)
    raise AssertionError(f"not within {seconds} s")


@pytest.fixture(scope="module")
def head():
    """The addresses of the jobs' server and of a fresh head itself, with three logical cores."""
    scratch = Path(tempfile.mkdtemp(prefix="ray", dir="/tmp"))  # short: the paths of its sockets have 107 bytes
    gcs, dashboard, client, agent = free_ports(4)
    ports = [f"--port={gcs}", f"--dashboard-port={dashboard}", f"--ray-client-server-port={client}"]
    ports.append(f"--dashboard-agent-listen-port={agent}")
    command = [RAY, "start", "--head", "--block", "--num-cpus=3", f"--temp-dir={scratch}", *ports]
    with (scratch / "head.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            address = f"http://127.0.0.1:{dashboard}"
            wait_for(lambda: answers(f"{address}/api/gcs_healthz"))
            yield address, f"127.0.0.1:{gcs}"
        finally:
            process.send_signal(signal.SIGTERM)  # ends what it started, and nothing else
            try:
                process.wait(40)
            except subprocess.TimeoutExpired:
                process.kill()
            shutil.rmtree(scratch, ignore_errors=True)


def answers(url):
    try:
        with urllib.request.urlopen(url, timeout=2) as response:
            return response.read()
    except OSError:
        return None


def test_a_job_is_stopped_and_continued_and_publishes(head, tmp_path):
    jobs, _ = head
    work, home = tmp_path / "work", tmp_path / "home"
    work.mkdir()
    write_yaml(work / "tiny.yaml")
    (port,) = free_ports(1)
    variables = {"TANDEM_RUNS": str(home / "runs"), "TANDEM_REGISTRY": str(home / "registry")}

    def submit(total_env_steps):
        command = [
            *(RAY, "job", "submit", "--address", jobs, "--no-wait", "--working-dir", work),
            *("--runtime-env-json", json.dumps({"env_vars": variables}), "--"),
            *(sys.executable, "-m", "service", "pretrain", "--runtime", "ray", "--run-id", "night"),
            *("--config", "tiny.yaml", "--num-actors", "1", "--status", f"127.0.0.1:{port}"),
            *("--set", f"run.total_env_steps={total_env_steps}"),
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return next(word.strip("'") for word in done.stdout.split() if word.strip("'").startswith("raysubmit_"))

    client = JobSubmissionClient(jobs)

    def end_of(job):
        state = client.get_job_status(job)
        return state.value if state.is_terminal() else None

    def read_status():
        text = answers(f"http://127.0.0.1:{port}/v1/runs/night")
        return json.loads(text) if text else None

    first = submit(10**9)
    status = wait_for(lambda: (found := read_status()) and found["iteration"] >= 5 and found)
    assert (status["state"], status["runtime"]) == ("running", "ray")
    assert {actor["name"] for actor in status["actors"]} == {"rollout-0", "learner", "generator"}
    assert status["policy_lag"] <= 2

    stopped = time.monotonic()
    subprocess.run([RAY, "job", "stop", "--address", jobs, first], capture_output=True, timeout=60, check=True)
    assert wait_for(lambda: end_of(first)) == "STOPPED"
    assert time.monotonic() - stopped < 30
    saved = newest(home / "runs" / "night").step
    told = json.loads((home / "runs" / "night" / "status.json").read_text())
    assert saved == told["iteration"]  # nothing of the last interval is lost
    assert told["state"] == "interrupted"

    second = submit(newest(home / "runs" / "night").meta["env_steps"] + 1500)
    assert wait_for(lambda: end_of(second)) == "SUCCEEDED", client.get_job_logs(second)
    rows = read_lines(home / "runs" / "night" / "metrics.jsonl")
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    assert len(rows) > saved
    registry = Registry(home / "registry")
    assert [version.number for version in registry.versions("tiny")] == [1]
    assert registry.manifest("tiny@1").metrics["env_steps"] == rows[-1]["env_steps"]
    assert not (work / "runs").exists()
    assert os.environ["RAY_AUTH_TOKEN"] not in json.dumps(told)


def test_a_cluster_of_another_version_of_ray(head, tmp_path):
    """This process is the one with another version: a second one of Ray is not here."""
    _, address = head
    program = "import ray; ray.__version__ = '2.0.0'; from service.cli.main import main; main()"
    command = [sys.executable, "-c", program, "pretrain", "--runtime", "ray", "--address", address, "--run-id", "night"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "error" in line]
    assert address in line
    assert "use the same image or environment everywhere" in line
    assert "2.0.0" in line
    assert not (tmp_path / "runs").exists()
