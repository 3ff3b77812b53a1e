"""Status files: how often they are written, a full disk, an older tandem's runs, a file cut under its reader."""

import errno
import json
import os
import re
import shutil
import tracemalloc
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest

from service.base.errors import StoreError, StoreUnavailableError
from service.base.jsonl import JsonlWriter
from service.base.lock import DirectoryLock
from service.store import disk_reader, tail
from service.store.disk_reader import DiskReader, run_id_of
from service.store.models import Pulse
from service.store.run_directory import RunDirectory
from service.store.run_writer import RunWriter
from service.store.tail import RecordFile
from tests.clock import Clock
from tests.runs.runs import assert_one_line, no_room_above
from tests.store.stores import a_grid, a_record, a_silent_status, a_status


def read_json(directory, name="status.json"):
    return json.loads((directory / name).read_text())


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def told(tmp_path):
    """Tell the status of the run ``cube`` in a directory of runs, and give a reader of that."""

    def tell(status):
        (tmp_path / "cube").mkdir(exist_ok=True)
        RunWriter(RunDirectory(tmp_path / "cube")).status(status)
        return DiskReader(tmp_path)

    return tell


# --- writing ---------------------------------------------------------------------------------------------------------


def test_status_is_written_once_a_second_and_at_changes_of_state_or_condition(tmp_path, clock):
    writer = RunWriter(RunDirectory(tmp_path), clock=clock)
    seen, told = [], [(0.0, 1, "running"), (0.9, 2, "running"), (1.0, 3, "running"), (1.1, 4, "failed")]
    for now_s, iteration, state in told:
        clock.now_s = now_s
        writer.status(a_status(iteration=iteration, state=state))
        seen.append(read_json(tmp_path)["iteration"])
    writer.status(a_status(iteration=4, state="failed").suffering("disk", "no room"))
    assert (seen, read_json(tmp_path)["condition"]) == ([1, 1, 3, 4], "disk")
    writer.status(a_status(iteration=5, state="failed"))
    writer.close()
    assert read_json(tmp_path)["iteration"] == 5


def test_the_grid_is_written_with_the_next_status_and_at_the_end(tmp_path, clock):
    writer = RunWriter(RunDirectory(tmp_path), clock=clock)
    writer.goals(a_grid(1))
    writer.status(a_status())
    assert read_json(tmp_path, "goals.json")["iteration"] == 1
    writer.goals(a_grid(2))
    writer.status(a_status())  # within the same second
    assert read_json(tmp_path, "goals.json")["iteration"] == 1
    writer.close()
    assert read_json(tmp_path, "goals.json")["iteration"] == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["goals.json", "status.json"]


def test_a_full_disk_is_a_warning_and_passes(tmp_path, clock, caplog):
    writer = RunWriter(RunDirectory(tmp_path), clock=clock)
    writer.status(a_status(iteration=1))
    with no_room_above(10):
        for _ in range(3):
            clock.now_s += 1.0
            writer.status(a_status(iteration=2))
        (trouble,) = writer.troubles()
        assert trouble.condition == "disk"
        assert_one_line(trouble.text, "cannot write", "status.json", "File too large")
    assert len([message for message in caplog.messages if "status.json" in message]) == 1
    assert read_json(tmp_path)["iteration"] == 1
    writer.close()
    assert read_json(tmp_path)["iteration"] == 2
    assert writer.troubles() == []
    assert list(tmp_path.glob(".tmp-*")) == []


# --- reading ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def ended(tmp_path):
    """The directory of a run that has ended, of four iterations."""
    directory = tmp_path / "runs" / "old-one"
    directory.mkdir(parents=True)
    RunWriter(RunDirectory(directory)).status(a_status("old-one", state="finished", iteration=4))
    (directory / "config.yaml").write_text("name: panda-cube\n")
    (directory / "run.json").write_text('{"run": "00000000000000000000000000000000"}')
    records = JsonlWriter(directory / "metrics.jsonl")
    for number in range(1, 5):
        records.append(a_record(number))
    return directory


def test_a_run_without_a_status_has_only_begun(ended):
    (ended / "status.json").unlink()
    run = DiskReader(ended.parent).run("old-one")
    assert run.state == "interrupted"
    assert_one_line(run.last_error, ended, "has no status.json")


def test_a_status_of_an_earlier_process_says_so(ended):
    (ended / "epochs").mkdir()
    (ended / "epochs" / "00000001").touch()
    assert "earlier process" in DiskReader(ended.parent).run("old-one").warnings[0]


WITHOUT_A_ZONE = a_status().model_dump_json().replace("Z", "").encode()  # which no clock compares with


@pytest.mark.parametrize("content", [b"", b'{"run_id": "x"}', b"\xff\xfe", WITHOUT_A_ZONE])
def test_a_damaged_status_is_damage_of_its_run(ended, content):
    (ended / "status.json").write_bytes(content)
    (run,) = DiskReader(ended.parent).runs()
    assert_one_line(run.last_error, ended, "cannot be read: status.json")
    assert [each["iteration"] for each in DiskReader(ended.parent).metrics("old-one", after_iteration=2)] == [3, 4]


def test_a_copied_directory_is_another_run_and_what_is_no_run_is_none(ended):
    root = ended.parent
    shutil.copytree(ended, root / "b")
    (root / "registry" / "blobs").mkdir(parents=True)
    (root / "note.txt").touch()
    for name in (".hidden", "lost+found"):
        (root / name).mkdir()
        (root / name / "config.yaml").touch()
    assert {run.run_id for run in DiskReader(root).runs()} == {"old-one", "b"}


def test_the_runs_of_a_study_are_listed_with_the_others_under_its_name(tmp_path):
    study = tmp_path / "night-1"
    for path in (tmp_path / "cube", study / "seed-0", study / "seed-12"):
        path.mkdir(parents=True)
        RunWriter(RunDirectory(path)).status(a_status(run_id_of(path), state="finished", iteration=len(path.name)))
    assert {run.run_id for run in DiskReader(tmp_path).runs()} == {"cube"}
    (study / "study.json").touch()
    (study / "seed-99").mkdir()  # not begun
    runs = {run.run_id: (run.iteration, run.study) for run in DiskReader(tmp_path).runs()}
    assert runs == {"cube": (4, None), "night-1-seed-0": (6, "night-1"), "night-1-seed-12": (7, "night-1")}
    assert {run.run_id for run in DiskReader(study).runs()} == {"night-1-seed-0", "night-1-seed-12"}
    assert DiskReader(tmp_path).run("night-1-seed-12").run_id == "night-1-seed-12"


@pytest.mark.parametrize(("error", "shown"), [(errno.ESTALE, "running"), (errno.EACCES, "interrupted")])
def test_a_status_that_cannot_be_read_for_a_moment(told, tmp_path, clock, monkeypatch, error, shown):
    told(a_status(num_env_steps=700))
    reader = DiskReader(tmp_path, clock=clock)
    before = reader.run("cube")

    def fail(*_):
        raise OSError(error, os.strerror(error))

    with monkeypatch.context() as patched:
        patched.setattr(disk_reader, "read_regular", fail)
        found = reader.run("cube")
        clock.now_s += 61.0
        assert reader.run("cube").state == "interrupted"  # that is no moment
    clock.now_s -= 61.0
    assert found.state == shown
    if shown == "running":
        assert (found.num_env_steps, len(found.warnings)) == (700, 1)
        assert "status.json cannot be read right now" in found.warnings[0]
    assert reader.run("cube") == before


def test_a_list_that_takes_long_is_made_once_for_many(told, tmp_path, clock, monkeypatch):
    told(a_status(iteration=1))
    reader, took_s, made = DiskReader(tmp_path, clock=clock), [0.3], []
    clock.now_s = 0.0

    def slow(*_, status=reader._status):
        made.append(clock.now_s)
        clock.now_s += took_s[0]
        return status(*_)

    monkeypatch.setattr(reader, "_status", slow)
    for asked_s, takes_s in ((0.0, 0.3), (0.4, 0.3), (2.7, 0.3), (2.9, 60.0), (67.0, 0.01), (68.0, 0.01), (68.1, 0.01)):
        clock.now_s, took_s[0] = max(asked_s, clock.now_s), takes_s
        assert [run.iteration for run in reader.runs()] == [1]
    assert made == [0.0, 2.9, 68.0, 68.1]


def test_whether_it_is_ready_walks_no_run(tmp_path, monkeypatch):
    """An orchestrator asks every few seconds, also where there are thousands of runs on a network's disk."""
    for name in ("a", "b"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    reader = DiskReader(tmp_path / "runs")
    monkeypatch.setattr(disk_reader, "run_directories", lambda root: pytest.fail("it walks the runs"))
    reader.ready()
    (tmp_path / "runs").rename(tmp_path / "elsewhere")
    with pytest.raises(StoreUnavailableError) as error:
        reader.ready()
    assert_one_line(error.value, f"cannot read the runs in {tmp_path / 'runs'}", "No such file")


@pytest.mark.parametrize("size", [100, 17_000, 44_000])
def test_the_newest_records_however_long_they_are(tmp_path, monkeypatch, size):
    path, read = tmp_path / "metrics.jsonl", []
    with path.open("w") as file:
        for number in range(1, 41):
            file.write(json.dumps(a_record(number, **{"x" * size: 1.0})) + "\n")
    monkeypatch.setattr(tail, "parse_record", lambda line, parse=tail.parse_record: read.append(line) or parse(line))
    assert [each["iteration"] for each in RecordFile(path).after(39)] == [40]
    assert RecordFile(path).newest()["iteration"] == 40
    assert size == 100 or len(read) <= 30  # and not all forty, twice


def test_run_ids_of_directories(tmp_path):
    assert run_id_of(tmp_path / "cube-1") == a_status("cube-1").run_id == "cube-1"
    names = ("..odd_", ".odd_", "my run", "\u00e9", "\u65e5\u672c", "\u4e2d\u56fd")
    strange = {name: run_id_of(tmp_path / name) for name in names}
    assert [run_id.rpartition("-")[0] for run_id in strange.values()] == ["odd_", "odd_", "my-run", *["run"] * 3]
    assert len({a_status(run_id).run_id for run_id in strange.values()}) == len(strange)  # none has another's
    study = tmp_path / ("x" * 200)
    study.mkdir()
    (study / "study.json").touch()
    assert run_id_of(study / "seed-10") != run_id_of(study / "seed-11")
    assert a_status(run_id_of(study / "seed-10"))


def test_a_run_that_vanished_while_its_disk_was_full_has_vanished_and_is_not_asked_to_stop(tmp_path, told):
    reader = told(a_silent_status().suffering("disk", "no room"))
    seen = reader.run("cube")
    assert (seen.state, seen.condition) == ("interrupted", "well")
    assert "vanished" in seen.last_error
    reader.request_stop("cube")
    assert not (tmp_path / "cube" / "stop").exists()


# --- a silent run whose process lives ---------------------------------------------------------------------------------


@pytest.fixture
def lock(tmp_path):
    """Held by a process that runs the run ``cube``."""
    lock = DirectoryLock(tmp_path / "cube")
    yield lock
    lock.release()


def test_a_process_that_says_nothing_is_named(told, lock):
    seen = told(a_silent_status()).run("cube")
    assert (seen.state, seen.condition) == ("running", "stuck")
    assert_one_line(seen.warnings[-1], f"its process {os.getpid()} on ", "not been heard of for 61 s", "--resume")


def test_a_full_disk_is_seen_long_before_the_run_is_silent(told, lock, monkeypatch):
    heartbeat = datetime.now(UTC) - timedelta(seconds=disk_reader.QUIET_S + 2)
    reader = told(a_status(heartbeat=heartbeat))
    assert reader.run("cube").condition == "well"
    monkeypatch.setattr(disk_reader.shutil, "disk_usage", lambda path: SimpleNamespace(free=4096))
    seen = reader.run("cube")
    assert (seen.state, seen.condition) == ("running", "disk")
    assert_one_line(seen.warnings[-1], "the disk of", "is full", "4,096 bytes")


@pytest.mark.parametrize("locked", [True, False])
def test_a_heartbeat_from_the_future_is_no_sign_of_life(told, lock, clock, monkeypatch, locked):
    reader = told(a_status(heartbeat=datetime.now(UTC) + timedelta(hours=1)))
    if not locked:
        lock.release()
    monkeypatch.setattr(reader, "_pulse", Pulse(clock))
    seen = reader.run("cube")
    assert (seen.state, seen.condition) == ("running", "clock")
    assert re.search(r"its heartbeat is 3[56]\d\d s in the future", seen.warnings[-1])
    clock.now_s += 61.0
    seen = reader.run("cube")
    assert (seen.state, seen.condition) == (("running", "stuck") if locked else ("interrupted", "well"))


@pytest.mark.parametrize(
    ("heartbeat", "state", "condition", "said"),
    [
        ("0001-01-01T00:00:00+14:00", "interrupted", "well", "cannot be read: date value out of range"),
        ("9999-12-31T23:59:59-14:00", "running", "clock", "s in the future"),
    ],
)
def test_a_heartbeat_of_no_time_there_is(tmp_path, told, heartbeat, state, condition, said):
    reader = told(a_silent_status())
    tree = read_json(tmp_path / "cube") | {"heartbeat": heartbeat}
    (tmp_path / "cube" / "status.json").write_text(json.dumps(tree))
    status = reader.run("cube")
    assert (status.state, status.condition) == (state, condition)
    assert said in f"{status.last_error} {status.warnings}"


# --- directories with something else in them --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["status.json", "goals.json", "metrics.jsonl", ".lock"])
def test_a_fifo_is_not_waited_for(ended, name):
    (ended / name).unlink(missing_ok=True)
    os.mkfifo(ended / name)
    reader = DiskReader(ended.parent)
    (status,) = reader.runs()
    assert status.run_id == "old-one"
    for read in (reader.metrics, reader.goals, reader.request_stop):
        with suppress(StoreError):
            read("old-one")


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


def test_a_run_that_cannot_be_read_is_not_asked_to_stop_and_a_root_is_no_damaged_run(told, tmp_path, monkeypatch):
    reader = told(a_status())
    assert reader.run("cube").state == "running"

    def refuse(*_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(disk_reader, "read_regular", refuse)
    assert reader.run("cube").state == "interrupted"
    with pytest.raises(StoreUnavailableError, match="Permission denied"):
        reader.request_stop("cube")
    monkeypatch.setattr(disk_reader.os, "scandir", refuse)
    with pytest.raises(StoreUnavailableError, match="cannot read the runs"):
        reader.run("cube")


def test_whatever_is_wrong_with_a_run_it_hides_no_other(ended, monkeypatch):
    """An error that was not thought of, say."""
    shutil.copytree(ended, ended.parent / "other")
    newest = disk_reader.newest_epoch
    monkeypatch.setattr(disk_reader, "newest_epoch", lambda path: 1 / 0 if path.name == "other" else newest(path))
    runs = {run.run_id: run for run in DiskReader(ended.parent).runs()}
    assert runs["old-one"].last_error is None
    assert_one_line(runs["other"].last_error, "other", "division by zero")


# --- records that grow -----------------------------------------------------------------------------------------------


@pytest.fixture
def growing(tmp_path):
    path = tmp_path / "metrics.jsonl"
    return path, JsonlWriter(path), RecordFile(path)


def test_only_what_is_new_is_read(growing):
    path, writer, records = growing
    path.write_text("".join(json.dumps(a_record(number)) + "\n" for number in range(1, 2000)))
    assert len(records.columns(None).iteration) == 1999
    writer.append(a_record(2000))
    assert [each["iteration"] for each in records.after(100)] == list(range(101, 2001))
    assert [each["iteration"] for each in records.after(100, most=3)] == [101, 102, 103]
    assert [each["iteration"] for each in records.after(1998, most=1)] == [1999]
    before = bytes_read()
    assert records.after(1999) == [a_record(2000)]
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
        for part in (line[:10], line[10:]):  # then it is not known yet whether more digits come
            file.write(part)
            file.flush()
            assert records.after(0) == [a_record(1)]
            assert len(records.columns(None).iteration) == 1
        file.write(b"\n")
    assert records.after(0) == [a_record(1), a_record(2)]
    assert len(records.columns(None).iteration) == 2


def test_a_file_that_a_resume_has_cut(growing):
    _, writer, records = growing
    for number in range(1, 8):
        writer.append(a_record(number, past=0))
    assert len(records.after(0)) == len(records.columns(None).iteration) == 7
    writer.cut_after(3)
    for number in range(4, 12):  # longer than before when it is looked at next
        writer.append(a_record(number, past=1))
    found, columns = records.after(0), records.columns(None)
    assert [each["iteration"] for each in found] == columns.iteration.tolist() == list(range(1, 12))
    assert [each["past"] for each in found] == columns.metrics["past"].tolist() == [0] * 3 + [1] * 8


def test_a_file_that_is_not_there_and_then_is(growing):
    path, writer, records = growing
    assert (records.after(0), len(records.columns(None).iteration)) == ([], 0)
    writer.append(a_record(1))
    assert records.after(0) == [a_record(1)]
    path.unlink()
    assert records.after(0) == []


@pytest.mark.parametrize("number", ["1e999", "NaN", "9" * 400])
def test_a_number_of_a_record_that_is_not_finite_is_none(growing, number):
    path, _, records = growing
    path.write_text(f'{{"iteration": 1, "env_steps": {number}}}\n{{"iteration": {"9" * 400}}}\n{{"iteration": 2}}\n')
    assert records.after(0) == [{"iteration": 1, "env_steps": None}, {"iteration": 2}]


def test_what_json_has_no_number_for(growing):
    path, _, records = growing
    path.write_text('{"iteration": 1, "a": NaN, "b": -Infinity, "c": "text", "d": [1], "e": null, "f": true, "g": 2}\n')
    assert records.after(0) == [{"iteration": 1, "a": None, "b": None, "e": None, "g": 2}]


def test_a_line_without_end_is_not_read_whole(growing):
    path, _, records = growing
    path.write_bytes(b'{"iteration": 1}\n')
    with path.open("ab") as file:
        file.truncate(1 << 40)  # without a block on the disk
    assert records.after(0) == [{"iteration": 1}]


def test_a_long_history_takes_little_memory(growing):
    path, _, records = growing
    with path.open("w") as file:
        file.writelines(json.dumps(a_record(number, pad=[0] * 500)) + "\n" for number in range(1, 601))
    tracemalloc.start()
    try:
        assert records.after(599)[0]["iteration"] == 600
        assert tracemalloc.get_traced_memory()[1] < path.stat().st_size / 4
    finally:
        tracemalloc.stop()
