"""Status files: how often they are written, a full disk, an older tandem's runs, a file cut under its reader."""

import json
import os
import re
import shutil
import signal
import subprocess
import tracemalloc
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest

from service.base.errors import StoreError
from service.base.jsonl import JsonlWriter
from service.base.lock import DirectoryLock
from service.store import disk_reader
from service.store.disk_reader import DiskReader, run_id_of
from service.store.models import Pulse
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter
from service.store.tail import RecordFile
from tests.clock import Clock
from tests.runs.runs import assert_one_line, no_room_above
from tests.store.stores import a_grid, a_record, a_silent_status, a_status, wait_until


def read_status(directory):
    return json.loads((directory / "status.json").read_text())


# --- writing ---------------------------------------------------------------------------------------------------------


def test_status_is_written_once_a_second_and_at_changes_of_state_or_condition(tmp_path):
    clock = Clock()
    writer = RunWriter(RunDirectory(tmp_path), clock=clock)
    seen, told = [], [(0.0, 1, "running"), (0.9, 2, "running"), (1.0, 3, "running"), (1.1, 4, "failed")]
    for now_s, iteration, state in told:
        clock.now_s = now_s
        writer.status(a_status(iteration=iteration, state=state))
        seen.append(read_status(tmp_path)["iteration"])
    writer.status(a_status(iteration=4, state="failed").suffering("disk", "no room"))
    assert (seen, read_status(tmp_path)["condition"]) == ([1, 1, 3, 4], "disk")
    writer.status(a_status(iteration=5, state="failed"))
    writer.close()
    assert read_status(tmp_path)["iteration"] == 5


def test_the_grid_is_written_every_five_seconds_and_at_the_end(tmp_path):
    clock, seen = Clock(), []
    writer = RunWriter(RunDirectory(tmp_path), clock=clock)
    for number in range(1, 8):
        writer.goals(a_grid(number))
        seen.append(json.loads((tmp_path / "goals.json").read_text())["iteration"])
        clock.now_s += 1.0
    assert seen == [1, 1, 1, 1, 1, 6, 6]
    writer.close()
    assert json.loads((tmp_path / "goals.json").read_text())["iteration"] == 7
    assert sorted(path.name for path in tmp_path.iterdir()) == ["goals.json"]


def test_a_full_disk_is_a_warning_and_passes(tmp_path, caplog):
    clock = Clock()
    writer = RunWriter(RunDirectory(tmp_path), clock=clock)
    writer.status(a_status(iteration=1))
    with no_room_above(10):
        for _ in range(3):
            clock.now_s += 1.0
            writer.status(a_status(iteration=2))
        (trouble,) = writer.troubles()
        assert trouble.condition == "disk"
        assert_one_line(trouble.text, "status.json cannot be written", "File too large")
    assert len([message for message in caplog.messages if "status.json" in message]) == 1
    assert read_status(tmp_path)["iteration"] == 1
    writer.close()
    assert read_status(tmp_path)["iteration"] == 2
    assert writer.troubles() == []
    assert list(tmp_path.glob(".tmp-*")) == []


# --- reading ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def ended(tmp_path):
    """The directory of a run that has ended."""
    directory = tmp_path / "old one"
    directory.mkdir()
    RunWriter(RunDirectory(directory)).status(a_status("old-one", state="finished", iteration=4))
    (directory / "config.yaml").write_text("name: panda-cube\n")
    (directory / "run.json").write_text('{"run": "00000000000000000000000000000000"}')
    records = JsonlWriter(directory / "metrics.jsonl")
    for number in range(1, 5):
        records.append(a_record(number))
    return directory


def test_a_directory_of_version_0_1_0_names_the_version_that_reads_it(ended):
    for name in ("status.json", "run.json"):
        (ended / name).unlink()
    run = DiskReader(ended.parent).run("old-one")
    assert run.state == "interrupted"
    assert_one_line(run.last_error, ended, "written by tandem 0.1.0, which this version does not read: use tandem 0.2")


def test_a_run_without_a_status_has_only_begun(ended):
    (ended / "status.json").unlink()
    assert_one_line(DiskReader(ended.parent).run("old-one").last_error, ended, "has no status.json")


WITHOUT_A_ZONE = a_status().model_dump_json().replace("Z", "").encode()  # which no clock compares with


@pytest.mark.parametrize("content", [b"", b"{", b'{"run_id": "x"}', b"\xff\xfe", b"[]", WITHOUT_A_ZONE])
def test_a_damaged_status_is_damage_of_its_run(ended, content):
    (ended / "status.json").write_bytes(content)
    (run,) = DiskReader(ended.parent).runs()
    assert_one_line(run.last_error, ended, "cannot be read: status.json")
    assert [each["iteration"] for each in DiskReader(ended.parent).metrics("old-one", after_iteration=2)] == [3, 4]


def test_a_copied_directory_is_another_run(tmp_path):
    (tmp_path / "a").mkdir()
    writer = RunWriter(RunDirectory(tmp_path / "a"))
    writer.status(a_status("a", state="finished"))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert {run.run_id for run in DiskReader(tmp_path).runs()} == {"a", "b"}


def test_what_is_no_run_is_none(tmp_path):
    (tmp_path / "registry" / "blobs").mkdir(parents=True)
    (tmp_path / "note.txt").touch()
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "config.yaml").touch()
    assert DiskReader(tmp_path).runs() == []


def test_the_runs_of_a_study_are_listed_with_the_others_under_its_name(tmp_path):
    study = tmp_path / "night 1"
    for path in (tmp_path / "cube", study / "seed-0", study / "seed-12"):
        path.mkdir(parents=True)
        RunWriter(RunDirectory(path)).status(a_status(run_id_of(path), state="finished", iteration=len(path.name)))
    assert {run.run_id for run in DiskReader(tmp_path).runs()} == {"cube"}
    (study / "study.json").touch()
    (study / "seed-99").mkdir()  # not begun
    iterations = {run.run_id: run.iteration for run in DiskReader(tmp_path).runs()}
    assert iterations == {"cube": 4, "night-1-seed-0": 6, "night-1-seed-12": 7}
    assert {run.run_id for run in DiskReader(study).runs()} == {"night-1-seed-0", "night-1-seed-12"}
    assert DiskReader(tmp_path).run("night-1-seed-12").run_id == "night-1-seed-12"


def test_seeds_of_a_study_with_a_long_name_are_told_apart(tmp_path):
    study = tmp_path / ("x" * 200)
    study.mkdir()
    (study / "study.json").touch()
    assert run_id_of(study / "seed-10") != run_id_of(study / "seed-11")
    assert a_status(run_id_of(study / "seed-10"))


@pytest.mark.parametrize(
    ("name", "run_id"), [("cube-1", "cube-1"), ("my run", "my-run"), ("..odd_", "odd_"), ("\u00e9", "run")]
)
def test_run_ids_of_directories(tmp_path, name, run_id):
    assert run_id_of(tmp_path / name) == run_id
    assert a_status(run_id).run_id == run_id


def test_a_silent_run_that_nobody_locks_has_vanished_and_is_not_asked_to_stop(tmp_path):
    (tmp_path / "cube").mkdir()
    writer = RunWriter(RunDirectory(tmp_path / "cube"))
    writer.status(a_silent_status())
    reader = DiskReader(tmp_path)
    reader.request_stop("cube")
    assert not writer.stop_requested()


# --- a silent run whose process lives ---------------------------------------------------------------------------------


@pytest.fixture
def held(tmp_path):
    """A run directory that a process has, which has said nothing for a minute."""
    lock = DirectoryLock(tmp_path / "cube", "")
    RunWriter(RunDirectory(tmp_path / "cube")).status(a_silent_status())
    yield DiskReader(tmp_path)
    lock.release()


def test_a_frozen_process_is_stuck_and_named(held, monkeypatch):
    seen = held.run("cube")
    assert (seen.state, seen.condition) == ("running", "stuck")
    assert_one_line(seen.warnings[-1], f"its process {os.getpid()} on ", "not been heard of for 61 s", "--resume")
    monkeypatch.setattr(disk_reader, "_is_stopped", lambda pid: pid == os.getpid())
    assert_one_line(held.run("cube").warnings[-1], "frozen by a signal", f"kill -CONT {os.getpid()}")


def test_a_frozen_process_is_seen_long_before_it_is_silent(tmp_path, monkeypatch):
    lock = DirectoryLock(tmp_path / "cube", "")
    heartbeat = datetime.now(UTC) - timedelta(seconds=disk_reader.QUIET_S + 2)
    RunWriter(RunDirectory(tmp_path / "cube")).status(a_status(heartbeat=heartbeat))
    reader = DiskReader(tmp_path)
    assert reader.run("cube").condition == "well"
    monkeypatch.setattr(disk_reader, "_is_stopped", lambda pid: pid == os.getpid())
    assert reader.run("cube").condition == "stuck"
    lock.release()


def test_a_run_that_vanished_while_its_disk_was_full_has_vanished(tmp_path):
    (tmp_path / "cube").mkdir()
    RunWriter(RunDirectory(tmp_path / "cube")).status(a_silent_status().suffering("disk", "no room"))
    seen = DiskReader(tmp_path).run("cube")
    assert (seen.state, seen.condition) == ("interrupted", "well")
    assert "vanished" in seen.last_error


def test_who_is_stopped():
    with subprocess.Popen(["sleep", "60"]) as process:
        assert not disk_reader._is_stopped(process.pid)
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: disk_reader._is_stopped(process.pid))
        process.kill()
    assert not disk_reader._is_stopped(process.pid)


def test_a_full_disk_is_what_it_is(held, monkeypatch):
    monkeypatch.setattr(disk_reader.shutil, "disk_usage", lambda path: SimpleNamespace(free=4096))
    seen = held.run("cube")
    assert (seen.state, seen.condition) == ("running", "disk")
    assert_one_line(seen.warnings[-1], "the disk of", "is full", "4,096 bytes")


@pytest.mark.parametrize("locked", [True, False])
def test_a_heartbeat_from_the_future_is_no_sign_of_life(tmp_path, monkeypatch, locked):
    clock = Clock()
    lock = DirectoryLock(tmp_path / "cube", "")
    RunWriter(RunDirectory(tmp_path / "cube")).status(a_status(heartbeat=datetime.now(UTC) + timedelta(hours=1)))
    if not locked:
        lock.release()
    reader = DiskReader(tmp_path)
    monkeypatch.setattr(reader, "_pulse", Pulse(lambda: clock.now_s))
    seen = reader.run("cube")
    assert (seen.state, seen.condition) == ("running", "clock")
    assert re.search(r"its heartbeat is 3[56]\d\d s in the future", seen.warnings[-1])
    clock.now_s += 61.0
    seen = reader.run("cube")
    assert (seen.state, seen.condition) == (("running", "stuck") if locked else ("interrupted", "well"))
    lock.release()


@pytest.mark.parametrize(
    "name", ["status.json", "goals.json", "metrics.jsonl", "config.yaml", "published.json", ".lock"]
)
def test_nobody_waits_for_a_fifo(ended, name):
    (ended / name).unlink(missing_ok=True)
    if name == "config.yaml":  # so that it is a run
        (ended / "status.json").write_text("no status")
    os.mkfifo(ended / name)
    reader = DiskReader(ended.parent)
    (status,) = reader.runs()
    assert status.run_id == "old-one"
    for read in (reader.metrics, reader.goals, reader.request_stop):
        with suppress(StoreError):
            read("old-one")


@pytest.mark.parametrize(
    ("heartbeat", "state", "condition", "said"),
    [
        ("0001-01-01T00:00:00+14:00", "interrupted", "well", "vanished without a word, last heard of at 1970-01-01"),
        ("9999-12-31T23:59:59-14:00", "running", "clock", "s in the future"),
    ],
)
def test_a_heartbeat_of_no_time_there_is(tmp_path, heartbeat, state, condition, said):
    (tmp_path / "cube").mkdir()
    tree = json.loads(a_silent_status().model_dump_json()) | {"heartbeat": heartbeat}
    (tmp_path / "cube" / "status.json").write_text(json.dumps(tree))
    status = DiskReader(tmp_path).run("cube")
    assert (status.state, status.condition) == (state, condition)
    assert said in f"{status.last_error} {status.warnings}"


@pytest.mark.parametrize("number", ["1e999", "-1e999", "NaN"])
def test_a_number_of_a_record_that_is_not_finite_is_none(growing, number):
    path, _, records = growing
    path.write_text(f'{{"iteration": 1, "env_steps": {number}}}\n{{"iteration": {"9" * 400}}}\n{{"iteration": 2}}\n')
    assert records.after(0) == [{"iteration": 1, "env_steps": None}, {"iteration": 2}]


def test_a_line_without_end_is_not_read_whole(growing):
    path, _, records = growing
    path.write_bytes(b'{"iteration": 1}\n')
    with path.open("ab") as file:
        file.truncate(1 << 40)  # without a block on the disk
    assert records.after(0) == [{"iteration": 1}]


# --- records that grow -----------------------------------------------------------------------------------------------


@pytest.fixture
def growing(tmp_path):
    path = tmp_path / "metrics.jsonl"
    return path, JsonlWriter(path), RecordFile(path)


def test_only_what_is_new_is_read(growing):
    path, writer, records = growing
    for number in range(1, 2000):
        writer.append(a_record(number))
    assert len(records.columns(None).iteration) == 1999
    writer.append(a_record(2000))
    assert [each["iteration"] for each in records.after(100)] == list(range(101, 2001))
    for ask in (lambda: records.after(1999), lambda: [records.last()]):
        before = bytes_read()
        assert ask() == [a_record(2000)]
        assert bytes_read() - before < path.stat().st_size // 2
    before = bytes_read()
    assert len(records.columns(None).iteration) == 2000
    assert bytes_read() - before < path.stat().st_size // 2


def bytes_read():
    """Of files, by this process; /proc's own text is small."""
    with open("/proc/self/io") as file:
        return int(file.readline().removeprefix("rchar:"))


def test_a_torn_line_waits_for_its_end(growing):
    path, writer, records = growing
    writer.append(a_record(1))
    line = json.dumps(a_record(2)).encode()
    with path.open("ab") as file:
        file.write(line[:10])
        file.flush()
        assert records.after(0) == [a_record(1)]
        file.write(line[10:])
        file.flush()
        assert records.after(0) == [a_record(1)]  # nobody knows yet whether more digits come
        file.write(b"\n")
    assert records.after(0) == [a_record(1), a_record(2)]


def test_a_file_that_a_resume_has_cut(growing):
    _, writer, records = growing
    for number in range(1, 8):
        writer.append(a_record(number, past=0))
    assert len(records.after(0)) == 7
    writer.cut_after(4)
    assert len(records.after(0)) == 4
    writer.cut_after(3)
    for number in range(4, 12):  # longer than before when it is looked at next
        writer.append(a_record(number, past=1))
    found = records.after(0)
    assert [each["iteration"] for each in found] == list(range(1, 12))
    assert [each["past"] for each in found] == [0] * 3 + [1] * 8


DEEP = {
    "a line of 1,000 lists": '{"iteration": 1, "x": ' + "[" * 1000 + "]" * 1000 + "}",
    "a line of 100,000 brackets": "[" * 100_000,
}


@pytest.mark.parametrize("line", DEEP)
def test_a_deep_line_is_damage_of_its_run_alone(ended, line):
    """Parsers that call themselves end with a RecursionError, which is no ValueError."""
    with (ended / "metrics.jsonl").open("a") as file:
        file.write(DEEP[line] + "\n" + json.dumps(a_record(5)) + "\n")
    reader = DiskReader(ended.parent)
    assert [record["iteration"] for record in reader.metrics("old-one")][-1] == 5
    assert reader.columns("old-one", None).iteration[-1] == 5
    (run,) = reader.runs()
    assert_one_line(run.warnings[-1], "metrics.jsonl", "no records", "1")
    assert reader.sample("old-one", "env_steps", 5)
    (run,) = reader.runs()
    assert_one_line(run.warnings[-1], "metrics.jsonl", "no records", "1")


def test_a_directory_that_cannot_be_read_is_a_damaged_run_beside_the_others(ended, monkeypatch):
    root = ended.parent
    (root / "loop-1").symlink_to("loop-2")
    (root / "loop-2").symlink_to("loop-1")
    (root / "night" / "seed-0").mkdir(parents=True)
    for name in ("study.json", "seed-0/config.yaml"):
        (root / "night" / name).touch()
    (root / "night" / "loop").symlink_to("loop")
    runs = {run.run_id: run for run in DiskReader(root).runs()}
    assert runs.keys() == {"old-one", "loop-1", "loop-2", "night-seed-0", "night-loop"}
    assert runs["old-one"].last_error is None
    for name in ("loop-1", "loop-2"):
        assert runs[name].state == "interrupted"
        assert_one_line(runs[name].last_error, root / name, "cannot be read", "symbolic links")
        assert DiskReader(root).run(name) == runs[name]

    def no_permission(path, *args, **kwargs):  # which root always has
        if str(path).startswith(str(ended)):
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, *args, **kwargs)

    stat = os.stat
    monkeypatch.setattr(os, "stat", no_permission)
    runs = {run.run_id: run for run in DiskReader(root).runs()}
    assert_one_line(runs["old-one"].last_error, ended, "Permission denied")
    assert "night-seed-0" in runs


def test_whatever_is_wrong_with_a_run_it_hides_no_other(ended, monkeypatch):
    """An error that nobody thought of, say."""
    shutil.copytree(ended, ended.parent / "other")
    newest = disk_reader.newest_epoch
    monkeypatch.setattr(disk_reader, "newest_epoch", lambda path: 1 / 0 if path.name == "other" else newest(path))
    runs = {run.run_id: run for run in DiskReader(ended.parent).runs()}
    assert runs["old-one"].last_error is None
    assert_one_line(runs["other"].last_error, "other", "ZeroDivisionError: division by zero")


def test_a_file_that_is_not_there_and_then_is(growing):
    path, writer, records = growing
    assert (records.after(0), records.last()) == ([], None)
    writer.append(a_record(1))
    assert records.last() == a_record(1)
    path.unlink()
    assert records.after(0) == []


def test_what_json_has_no_number_for(growing):
    path, _, records = growing
    path.write_text('{"iteration": 1, "a": NaN, "b": -Infinity, "c": "text", "d": [1], "e": null, "f": true, "g": 2}\n')
    assert records.after(0) == [{"iteration": 1, "a": None, "b": None, "e": None, "g": 2}]


def test_a_long_history_takes_little_memory(growing):
    path, _, records = growing
    with path.open("w") as file:
        file.writelines(json.dumps(a_record(number, pad=[0] * 500)) + "\n" for number in range(1, 601))
    tracemalloc.start()
    try:
        assert records.last()["iteration"] == 600
        assert tracemalloc.get_traced_memory()[1] < path.stat().st_size / 4
    finally:
        tracemalloc.stop()
