"""SIGKILL at the worst moments and at random ones: on another machine the run goes on as if nothing had happened."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from service.base import files, tensors
from service.base.jsonl import JsonlWriter
from service.runs.resuming import resumed_config
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory
from tests.runs.runs import PROCESSES, ROOT, assert_same_run, newest, play, tiny_config

STEP = 4
"""The checkpoint that is killed, of those after every second iteration."""


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def killed(moment, path, *, resume=False):
    """Let another process play until it dies of the moment."""
    process = PROCESSES.Process(target=_play_until, args=(moment, path, resume))
    process.start()
    process.join(600)
    assert process.exitcode == -signal.SIGKILL


def _play_until(moment, path, resume):
    with pytest.MonkeyPatch.context() as patch:
        moment(patch)
        play(path, resume=resume)


def elsewhere(path, to):
    """Another machine finds the run directory in another place; nothing is left in the old one."""
    shutil.copytree(path, to)
    shutil.rmtree(path)
    return to


def in_half_a_temporary_file(patch):
    write = files._write_flushed

    def half(path, data):
        if _is_checkpoint(path, STEP):
            path.write_bytes(data[: len(data) // 2])
            die()
        write(path, data)

    patch.setattr(files, "_write_flushed", half)


def before_old_ones_are_deleted(patch):
    prune = CheckpointStore._prune

    def killed_first(self, step):
        if self.directory.name == "checkpoints" and step == STEP:
            die()
        prune(self, step)

    patch.setattr(CheckpointStore, "_prune", killed_first)


def in_half_a_line(patch):
    write = files._write_whole

    def half(file, piece):
        if piece.startswith(b'{"iteration": 5, "env_steps"') and b'"goals"' not in piece:
            file.write(piece[: len(piece) // 2])
            die()
        write(file, piece)

    patch.setattr(files, "_write_whole", half)


def _is_checkpoint(temporary, step):
    """Whether this file is to become the checkpoint of ``step``: the one two iterations earlier is there."""
    directory = temporary.parent
    return directory.name == "checkpoints" and CheckpointStore(directory, keep=1).steps()[-1:] == [step - 2]


MOMENTS = {
    in_half_a_temporary_file: 2,
    before_old_ones_are_deleted: 4,
    in_half_a_line: 4,
}
"""And the iteration from which the run goes on then."""


@pytest.mark.parametrize(("moment", "saved"), MOMENTS.items(), ids=lambda each: getattr(each, "__name__", None))
def test_a_run_that_is_killed_and_goes_on_elsewhere(uninterrupted, tmp_path, moment, saved):
    killed(moment, tmp_path / "run")
    assert newest(tmp_path / "run").step == saved
    path = elsewhere(tmp_path / "run", tmp_path / "other" / "place")
    _, result = play(path, resume=True)
    assert result.reason == "finished"
    assert_same_run(path, uninterrupted)
    digests = [tensors.digest_of("", newest(each).arrays) for each in (path, uninterrupted)]
    assert digests[0] == digests[1]
    assert list(path.rglob(".tmp-*")) == []


def while_records_are_cut(patch):
    """One file is cut and the other is not."""
    cut_after = JsonlWriter.cut_after

    def cut_one(self, iteration):
        if self.path.name == "goals.jsonl":
            die()
        return cut_after(self, iteration)

    patch.setattr(JsonlWriter, "cut_after", cut_one)


def test_a_resume_that_is_killed_while_it_cuts_the_records(uninterrupted, tmp_path):
    path = tmp_path / "run"
    play(path, kill_after=3)
    killed(while_records_are_cut, path, resume=True)
    play(path, resume=True)
    assert_same_run(path, uninterrupted)


def test_what_killed_writers_left_anywhere_in_the_directory_goes(tmp_path):
    play(tmp_path, kill_after=3)
    left = [tmp_path / name for name in (".tmp-1-ab", "checkpoints/.tmp-1-ab", "snapshots/.tmp-1-ab")]
    for file in left:
        file.write_bytes(b"half a file")
    play(tmp_path, resume=True)
    assert [file for file in left if file.exists()] == []


def test_records_are_on_the_disk_before_the_checkpoint_that_knows_of_them(tmp_path, monkeypatch):
    """A power cut would otherwise leave a checkpoint of iterations whose records are lost."""
    synced, fsync = [], os.fsync

    def watched(descriptor):
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}").removeprefix(f"{tmp_path}/").partition("/")[0])
        fsync(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", watched)
        play(tmp_path, kill_after=3)
    last = max(place for place, name in enumerate(synced) if name == "checkpoints")
    assert {"metrics.jsonl", "goals.jsonl", "tensorboard"} <= set(synced[last - 5 : last])


def test_real_processes_killed_at_random_moments(tmp_path):
    """The first while it runs, the second anywhere: in its imports, while it loads, or later."""
    path = tmp_path / "run"
    process = PROCESSES.Process(target=play, args=(path, tiny_config(total_env_steps=10**9)))
    process.start()
    delays_s = random.uniform(0.0, 0.5), random.uniform(1.0, 4.0)
    print(f"killed after {delays_s} s")
    try:
        deadline_s = time.monotonic() + 600.0
        while len(list(path.glob("checkpoints/checkpoint-*"))) < 2:
            assert process.is_alive()
            assert time.monotonic() < deadline_s, "no checkpoints after 600 s"
            time.sleep(0.01)
        time.sleep(delays_s[0])
    finally:
        process.kill()
        process.join()
    path = elsewhere(path, tmp_path / "second")
    command = [sys.executable, "-m", "service", "pretrain", "--resume", "--run-dir", str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        time.sleep(delays_s[1])
        process.kill()
        process.communicate()
    assert process.returncode == -signal.SIGKILL
    path = elsewhere(path, tmp_path / "third")
    saved = newest(path)
    total = saved.meta["env_steps"] + 300
    play(path, resumed_config(RunDirectory(path), [f"run.total_env_steps={total}"]), resume=True)
    play(tmp_path / "whole", tiny_config(total_env_steps=total))
    print(f"resumed from iteration {saved.step}")
    assert newest(path).step > saved.step
    assert_same_run(path, tmp_path / "whole")
