"""The log of a run: what is said while it runs, within bounds, and read back whatever else lies in the file."""

import logging
import os

import pytest

from service.store import run_log
from service.store.run_directory import RunDirectory
from service.store.run_log import logging_to, read_log
from tests.runs.runs import no_room_above


def said(directory):
    return [(line.level, line.text) for line in read_log(directory)]


def test_what_a_run_says_is_kept_until_it_ends(tmp_path):
    logger = logging.getLogger("service.cluster.self_play")
    with logging_to(tmp_path) as log:
        log("process 7 begins the run")
        logger.warning("rollout actor %d is gone\n(%s)", 3, "killed")
        logging.getLogger("ray").warning("not ours")
    logger.warning("after the end")
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"at": "2026-11')  # a torn line of a process that was killed
    assert said(tmp_path) == [("info", "process 7 begins the run"), ("warning", "rollout actor 3 is gone (killed)")]


def test_a_run_that_fails_says_why(tmp_path):
    with pytest.raises(ValueError, match="broke"), logging_to(tmp_path):
        raise ValueError("it broke")
    assert said(tmp_path) == [("error", "the run failed: it broke")]


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("precious")])
def test_what_is_no_log_is_neither_waited_for_nor_written(tmp_path, make):
    (tmp_path / "precious").write_text("precious")
    make(tmp_path / "log.jsonl")
    with logging_to(tmp_path) as log:
        log("this line is lost")
    assert (tmp_path / "precious").read_text() == "precious"


def test_a_log_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(run_log, "MAX_FILE_BYTES", 1000)
    with logging_to(tmp_path) as log:
        for number in range(100):
            log(f"line {number}")
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2000
    texts = [text for _, text in said(tmp_path)]
    assert texts[-1] == "line 99"
    assert texts == [f"line {number}" for number in range(100 - len(texts), 100)]


def test_a_full_disk_does_not_hide_why_a_run_failed(tmp_path):
    with pytest.raises(ValueError, match="broke"), no_room_above(20), logging_to(tmp_path):  # its line does not fit
        raise ValueError("it broke")


def test_a_directory_that_is_gone_stops_nothing(tmp_path):
    with logging_to(tmp_path / "gone") as log:
        log("a line")
    assert read_log(tmp_path / "gone") == []


def test_older_recordings_are_kept_up_to_twenty(tmp_path):
    directory, path = RunDirectory(tmp_path), tmp_path / "rounds.mp4"
    directory.keep_recording(path)  # there is none yet
    assert not path.exists()
    for number in range(23):
        path.write_bytes(bytes([number]))
        os.utime(path, (1_000_000_000 + number, 1_000_000_000 + number))
        directory.keep_recording(path)
    kept = sorted((tmp_path / "recordings").iterdir())
    assert [each.read_bytes()[0] for each in kept] == list(range(3, 23))
    assert kept[-1].name == "rounds-20010909T014702.mp4"
    assert not path.exists()
