"""Ray's jobs, for real: a head, a job that is stopped and submitted again, its status over REST, primitives."""

import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path

import pytest
from ray.job_submission import JobSubmissionClient

from service.registry.publishing import publish
from service.registry.registry import Registry
from service.runs.study import Study
from service.status.server import StatusServer
from service.store.checkpoints import CheckpointStore
from service.store.disk_reader import DiskReader
from service.store.run_directory import RunDirectory
from tests.runs.runs import ROOT, TINY_TASK, newest, play, read_lines, tiny_config, write_yaml

RAY = Path(sys.executable).with_name("ray")
PATIENCE_S = 480.0
"""On a busy machine a dashboard answers late, or with an error: it is asked again for so long."""


def free_ports(num):
    """Free ports, above those of Ray's workers and below those that the kernel gives to any connection.

    Ray binds some of them only after seconds.
    """
    ports = []
    for port in random.SystemRandom().sample(range(20_000, 32_768), 1_000):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            ports.append(port)
        if len(ports) == num:
            return ports
    raise AssertionError("no free ports")


def wait_for(what, because=lambda: ""):
    """The first true answer of ``what``; an error of it is no answer. ``because`` says why there is none."""
    deadline, error = time.monotonic() + PATIENCE_S, None
    while time.monotonic() < deadline:
        try:
            if answer := what():
                return answer
        except (OSError, HTTPException, RuntimeError) as caught:  # what Ray's client raises when it gets no answer
            error = caught
        time.sleep(0.25)
    raise AssertionError(f"not within {PATIENCE_S} s; last error: {error!r}; {because()}")


@pytest.fixture(scope="module")
def head():
    """The addresses of the jobs' server and of a fresh head itself, with three logical cores."""
    scratch = Path(tempfile.mkdtemp(prefix="ray", dir="/tmp"))  # short: the paths of its sockets have 107 bytes
    gcs, dashboard, client, agent = free_ports(4)
    ports = [f"--port={gcs}", f"--dashboard-port={dashboard}", f"--ray-client-server-port={client}"]
    ports.append(f"--dashboard-agent-listen-port={agent}")
    without = ["--no-monitor", "--include-log-monitor=false"]  # processes that no test needs
    command = [RAY, "start", "--head", "--block", "--num-cpus=3", f"--temp-dir={scratch}", *without, *ports]
    # Else Ray kills a job that still saves; it wants whole seconds.
    settings = {"RAY_JOB_STOP_WAIT_TIME_S": f"{PATIENCE_S:.0f}"}
    with (scratch / "head.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | settings)
        try:
            address = f"http://127.0.0.1:{dashboard}"
            wait_for(lambda: answers(f"{address}/api/gcs_healthz"))
            yield address, f"127.0.0.1:{gcs}"
        finally:
            process.send_signal(signal.SIGTERM)  # ends what it started, and nothing else
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
            shutil.rmtree(scratch, ignore_errors=True)


def answers(url):
    with urllib.request.urlopen(url, timeout=60) as response:
        return response.read()


def listening_at(port):
    """The id of the process that listens at a port of this machine; None where none does."""
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    sockets = {f"socket:[{row[9]}]" for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"}
    for descriptor in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):  # it is closed meanwhile
            if os.readlink(descriptor) in sockets:
                return int(descriptor.parts[2])
    return None


def test_a_study_of_tasks_is_killed_with_its_driver_and_stopped_and_goes_on(head, tmp_path):
    """Two seeds, as tasks of Ray that fetch their primitives over HTTP."""
    _, address = head
    run, _ = play(tmp_path / "run", tiny_config(total_env_steps=120))
    registry, path = Registry(tmp_path / "registry"), tmp_path / "night"
    publish(registry, run.config, run.method.parameters(), {})

    def steps_saved():
        """The iterations of the newest checkpoints of the first two runs."""
        stores = [CheckpointStore(path / f"seed-{seed}" / "checkpoints", keep=1) for seed in (0, 1)]
        return [max(store.steps(), default=0) for store in stores]

    def start(*arguments):
        environment = os.environ | {"MUJOCO_GL": "off"}  # no films
        return subprocess.Popen(
            arguments, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def statuses():
        files = [path / f"seed-{seed}" / "status.json" for seed in (0, 1)]
        return [json.loads(file.read_text()) for file in files if file.exists()]

    def wait_until_each_goes_on(process, epoch):
        def goes_on():
            known = statuses()
            running = [each for each in known if each["state"] == "running" and each["epoch"] == epoch]
            return len(running) == 2 and all(each["iteration"] >= 2 for each in running)

        wait_for(lambda: process.poll() is not None or (goes_on() and min(steps_saved()) >= 2))
        assert process.poll() is None, process.stdout.read()

    with StatusServer(DiskReader(tmp_path), registry, port=0) as server:
        place = ["--runtime", "ray", "--address", address, "--status", "off", "--registry", server.url]
        command = [sys.executable, "-m", "service", "train", "--run-dir", str(path), *place]
        begin = [*command, *TINY_TASK, "push", "--seeds", "0,1", "--primitives", "tiny@latest", "--parallel", "2"]
        with start(*begin, "--set", "run.total_env_steps=1_000_000") as driver:
            try:
                wait_until_each_goes_on(driver, 1)
            finally:
                driver.kill()
        # Ray ends the tasks of that driver; their processes notice it, and save
        wait_for(lambda: [each["state"] for each in statuses()] == ["interrupted", "interrupted"])
        assert [each["iteration"] for each in statuses()] == steps_saved()
        with start(*command, "--resume", "--parallel", "2") as driver:
            wait_until_each_goes_on(driver, 2)
            driver.send_signal(signal.SIGTERM)
            said = driver.communicate(timeout=PATIENCE_S)[0]
        assert driver.returncode == 128 + signal.SIGTERM, said
        left = statuses()
        assert [status["state"] for status in left] == ["interrupted", "interrupted"], said
        assert [status["iteration"] for status in left] == steps_saved()  # nothing is lost
        listed = json.loads(answers(f"{server.url}/v1/runs"))["runs"]
        assert {status["study"] for status in listed} == {None, "night"}
        steps = max(status["num_env_steps"] for status in left) + 200
        last = subprocess.run(
            [*command, "--resume", "--set", f"run.total_env_steps={steps}"],
            cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        assert last.returncode == 0, last.stderr
    found = Study(path).read()
    assert {(run.state, run.env_steps) for run in found.runs.values()} == {("finished", steps)}
    for name, each in found.runs.items():
        rows = read_lines(path / name / "metrics.jsonl")
        assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
        config = RunDirectory(path / name).read_config()
        assert (config.primitives, config.task) == ("tiny@1", "push")
        assert each.result == RunDirectory(path / name).read_result()["evaluation"]
    assert len((path / "results.csv").read_text().splitlines()) == 3


def test_a_job_is_stopped_and_continued_and_publishes(head, tmp_path):
    jobs, _ = head
    work, home = tmp_path / "work", tmp_path / "home"
    work.mkdir()
    write_yaml(work / "tiny.yaml")
    (port,) = free_ports(1)
    variables = {"TANDEM_RUNS": str(home / "runs"), "TANDEM_REGISTRY": str(home / "registry")}
    variables["MUJOCO_GL"] = "off"  # no films

    client = wait_for(lambda: JobSubmissionClient(jobs))

    def submit(job, total_env_steps):
        words = f"{sys.executable} -m service pretrain --runtime ray --run-id night --config tiny.yaml --num-actors 1"
        words += f" --status 127.0.0.1:{port} --set run.total_env_steps={total_env_steps}"
        environment = {"env_vars": variables, "working_dir": str(work)}

        def sent():
            try:
                return client.submit_job(entrypoint=words, submission_id=job, runtime_env=environment)
            except RuntimeError as error:
                return "already exists" in str(error)  # an earlier try was carried out

        wait_for(sent)

    def end_of(job):
        state = client.get_job_status(job)
        return state.value if state.is_terminal() else None

    def read_status():
        return json.loads(answers(f"http://127.0.0.1:{port}/v1/runs/night"))

    submit("first", 10**9)
    status = wait_for(lambda: (found := read_status())["iteration"] >= 3 and found)
    assert (status["state"], status["runtime"]) == ("running", "ray")
    assert {actor["name"] for actor in status["actors"]} == {"rollout-0", "learner", "generator"}
    assert status["policy_lag"] <= 2

    serving = listening_at(port)
    os.kill(serving, signal.SIGKILL)  # the status service alone: Ray starts it again where it was
    assert wait_for(lambda: read_status()["iteration"] > status["iteration"])
    assert listening_at(port) not in (None, serving)

    wait_for(lambda: client.stop_job("first"))
    assert wait_for(lambda: end_of("first")) == "STOPPED"
    saved = newest(home / "runs" / "night").step
    told = json.loads((home / "runs" / "night" / "status.json").read_text())
    assert saved == told["iteration"]  # nothing of the last interval is lost
    assert told["state"] == "interrupted"

    submit("second", newest(home / "runs" / "night").meta["env_steps"] + 200)
    assert wait_for(lambda: end_of("second")) == "SUCCEEDED", wait_for(lambda: client.get_job_logs("second"))
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
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 1, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "error" in line]
    assert address in line
    assert "use the same image or environment everywhere" in line
    assert "2.0.0" in line
    assert not (tmp_path / "runs" / "night").exists()
