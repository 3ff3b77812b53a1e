"""Metrics as TensorBoard events, each written whole and at once.

TensorBoard's own writers give up for good after the first write that fails, and name their files by the clock alone.
"""

from __future__ import annotations

import io
import os
import re
import socket
import time
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from service.base.files import Appender

_FILE_VERSION = "brain.Event:2"
_FILE_PATTERN = re.compile(r"events\.out\.tfevents\.([0-9]{10,})\..*")


class EventFile(Appender):
    """The events of one process; a directory holds a file for every time the run was started or resumed."""

    def __init__(self, directory: Path, *, after_step: int | None = None) -> None:
        """Begin a file.

        Args:
            directory: where to.
            after_step: the env steps from which a run is resumed; events of later ones, which will be made again, are
                hidden from then on. None for a run that begins.

        Raises:
            StorageError: the disk is full or the file cannot be written.
        """
        host, process = socket.gethostname(), os.getpid()
        super().__init__(directory / f"events.out.tfevents.{_stamp(directory):010d}.{host}.{process}")
        self._append(Event(wall_time=time.time(), file_version=_FILE_VERSION))
        if after_step is not None:
            start = SessionLog(status=SessionLog.START)
            self._append(Event(wall_time=time.time(), step=after_step + 1, session_log=start))

    def add(self, metrics: dict[str, float]) -> None:
        """Append one iteration's metrics, over its env steps.

        Raises:
            StorageError: the disk is full; the event waits, see `append_bytes`.
        """
        values = [
            Summary.Value(tag=name, simple_value=float(value))
            for name, value in metrics.items()
            if name not in ("iteration", "env_steps") and value is not None
        ]
        self._append(Event(wall_time=time.time(), step=int(metrics["env_steps"]), summary=Summary(value=values)))

    def _append(self, event: Event) -> None:
        framed = io.BytesIO()
        RecordWriter(framed).write(event.SerializeToString())
        self.append_bytes(framed.getvalue())


def _stamp(directory: Path) -> int:
    """Seconds for the name of the next file; TensorBoard reads by name, and another machine's clock may be behind."""
    matches = (_FILE_PATTERN.fullmatch(path.name) for path in directory.glob("events.*"))
    return max([int(time.time()), *(int(match[1]) + 1 for match in matches if match)])
