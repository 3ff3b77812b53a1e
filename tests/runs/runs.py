"""Whole runs in under a second, with everything in them: valid goals, replayed ones, past opponents, demonstrations.

The object is large and right under the gripper and the success distance is small, so chance moves it often enough.
"""

import json
import os
import re
import resource
import subprocess
import sys
import time
from contextlib import ExitStack, closing, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from service.config import parse_config
from service.runs.report import Report
from service.runs.study import Study
from service.runs.train import open_run
from service.store.checkpoints import CheckpointStore
from service.store.disk_reader import DiskReader
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter

ROOT = Path(__file__).parents[2]
TREE = {
    "name": "tiny",
    "world": {
        "object_size_m": 0.07,
        "physics_step_s": 0.004,
        "num_substeps": 10,
        "workspace": {"length_x_m": 0.15, "length_y_m": 0.15},
    },
    "game": {"num_worlds": 24, "num_goals": 2, "alice_steps": 4, "bob_steps": 4, "success_distance_m": 0.004},
    "generator": {
        "past_opponent_fraction": 0.25,
        "opponent_pool_size": 2,
        "opponent_interval": 2,
        "replay_fraction": 0.25,
        "replay_invalid": True,
    },
    "policy": {
        "alice": {"hidden_sizes": [16]},
        "value": {"hidden_sizes": [16]},
        "bob": {
            "num_primitives": 2,
            "trunk_hidden_sizes": [16],
            "primitive_hidden_size": 8,
            "gate_hidden_sizes": [16],
        },
    },
    "learner": {
        "alice": {"minibatch_size": 64},
        "bob": {"minibatch_size": 64, "num_epochs": 2, "mirror": "random"},
        "abc": {"num_iterations": 2},
        "self_imitation": {"weight": 0.2, "num_iterations": 2, "min_reward": 1.0},
    },
    "run": {
        "total_env_steps": 600,
        "checkpoint_interval": 2,
        "evaluation_interval": 0,
        "evaluation_steps": 2,
        "evaluation_episodes": 4,
        "final_episodes": 4,
        "num_threads": 1,
    },
}

PROCESSES = get_context("forkserver")
"""Begins other processes by forking one that has torch, and no threads of Ray's; each would take 2 s to import it."""
PROCESSES.set_forkserver_preload(
    ["service.learner.learner", "service.runs.train", "service.base.tensorboard", "tests.runs.runs", "pytest"]
)
TINY_TASK = [
    *("--set", "sac.num_worlds=4", "--set", "sac.learning_starts=200", "--set", "sac.hidden_sizes=[8]"),
    *("--set", "sac.batch_size=8", "--set", "sac.gradient_steps=1", "--set", "run.final_episodes=4"),
    *("--set", "run.checkpoint_interval=1", "--set", "run.evaluation_interval=0"),
]
"""Options of a task in iterations of 200 env steps, 0.2 s each; without rendering it is over in seconds."""


class Ended(NamedTuple):
    """How a run ended."""

    reason: str
    iteration: int
    num_env_steps: int


def run_on(run, *callbacks):
    """Let a run go on to its end."""
    return Ended(run.run(*callbacks), run.iteration, run.num_env_steps)


class KilledError(Exception):
    """Stands for kill -9 inside this process: nothing after it is done."""


def tiny_config(**run):
    """``TREE`` with other values under ``run``; ``seed`` goes to the top."""
    top = {"seed": run.pop("seed")} if "seed" in run else {}
    return parse_config(TREE | top | {"run": TREE["run"] | run}, where="a test")


def write_yaml(path, tree=TREE):
    path.write_text(yaml.safe_dump(tree))
    return path


def play(path, config=None, *, resume=False, kill_after=None, on_iteration=None):
    """Run to the end, or be killed after so many iterations in all; returns the run and how it ended."""
    directory = RunDirectory(path)
    run = open_run(config or tiny_config(), directory, resume=resume)

    def each(metrics):
        if on_iteration is not None:
            on_iteration(run, metrics)
        if metrics["iteration"] == kill_after:
            raise KilledError

    try:
        return run, run_on(run, each)
    except KilledError:
        return run, None
    finally:
        run.close()
        directory.close()


def begin_study(path, config=None):
    """A study of two seeds that has begun, and none of its runs."""
    configs = {f"seed-{seed}": (config or tiny_config()).model_copy(update={"seed": seed}) for seed in (0, 1)}
    with closing(Study(path)) as study:
        study.claim()
        study.begin({name: {"seed": str(each.seed)} for name, each in configs.items()}, configs, None)
    return study


@contextmanager
def no_room_above(num_bytes):
    """The kernel lets no file of this process grow beyond so many bytes; a write ends there, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def no_permission(path):
    """Nothing under ``path`` can be read or written, as where a mount is gone; root becomes another user for it."""
    before, user = path.stat().st_mode, os.geteuid()
    try:
        path.chmod(0)
        if user == 0:
            os.seteuid(65534)
        yield
    finally:
        os.seteuid(user)
        path.chmod(before)


class FullForAWhile:
    """Tells of a run as ``pretrain`` does, of which no checkpoint fits after iterations 3 to 5, and reads its status.

    To be called at every iteration of a run whose checkpoints are due at even ones.
    """

    def __init__(self, runtime):
        self.runtime, self.report, self.seen = runtime, None, {}
        self._limit = ExitStack()

    def __call__(self, run, metrics):
        path, iteration = run.directory.path, run.iteration
        if self.report is None:
            writer, epoch = RunWriter(run.directory), run.directory.epoch
            self.report = Report(run.config, path.name, self.runtime, writer, epoch=epoch)
            self.report.begin(run)
        self.report.iteration(run, metrics)
        self.seen[iteration] = DiskReader(path.parent).run(path.name)
        if iteration == 3:
            self._limit.enter_context(no_room_above(100_000))
        if iteration == 6:
            self._limit.close()

    def check(self):
        """The run was well, then said for two iterations that it cannot write, and why, and was well again."""
        assert len(self.seen) >= 8
        suffering = [iteration for iteration, status in self.seen.items() if status.condition != "well"]
        assert suffering == [5, 6]
        for iteration in suffering:
            assert self.seen[iteration].condition == "disk"
            (warning,) = self.seen[iteration].warnings
            assert_one_line(warning, "cannot write", "checkpoint-e00000001-00000004", "File too large")
        self.report.end("finished")


def start_endless_run(home):
    """A real ``tandem pretrain`` of ``TREE`` that ends only by a signal; returns the process and its run directory."""
    paths = {"--config": write_yaml(home / "tiny.yaml"), "--run-dir": home / "run", "--registry": home / "registry"}
    arguments = [part for pair in paths.items() for part in map(str, pair)]
    endless = ("--set", "run.total_env_steps=1_000_000_000")
    process = subprocess.Popen(
        [sys.executable, "-m", "service", "pretrain", *arguments, *endless],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    return process, home / "run"


def newest(path):
    """The newest checkpoint of a run directory."""
    return CheckpointStore(path / "checkpoints", keep=1).load_latest()


def read_lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def timeless_metrics(path):
    """metrics.jsonl without what differs from run to run."""
    rows = read_lines(path / "metrics.jsonl")
    return [{name: value for name, value in row.items() if not name.startswith("time/")} for row in rows]


def assert_same_run(one, other):
    """Two run directories agree bit for bit: parameters, optimisers, generators, worlds, metrics, goals, config."""
    left, right = newest(one), newest(other)
    assert left.step == right.step
    assert left.arrays.keys() == right.arrays.keys()
    different = [name for name, array in left.arrays.items() if not np.array_equal(array, right.arrays[name])]
    assert different == []
    own = ("wall_s", "run")
    timeless = [{key: value for key, value in side.meta.items() if key not in own} for side in (left, right)]
    assert timeless[0] == timeless[1]
    assert timeless_metrics(one) == timeless_metrics(other)
    for name in ("goals.jsonl", "config.yaml"):  # not every method has goals
        assert (one / name).exists() == (other / name).exists(), name
        assert not (one / name).exists() or (one / name).read_bytes() == (other / name).read_bytes(), name


def assert_one_line(text, *parts):
    """What a user reads: one line, with all of this in it."""
    text = str(text)
    assert "\n" not in text.rstrip("\n")
    assert [part for part in parts if not re.search(re.escape(str(part)), text)] == [], text


def is_alive(pid):
    """Whether a process still runs after some minutes to end in."""
    for _ in range(3000):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return False
        if state == "Z":
            return False
        time.sleep(0.1)
    return True
