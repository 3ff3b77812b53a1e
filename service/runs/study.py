"""A study: runs side by side in one directory, then the best of them, a table and a picture.

| file | content |
|---|---|
| ``study.json`` | the settings of each run, how far it is, and its results; the best one |
| ``NAME.yaml`` | the configuration of the run NAME |
| ``NAME/`` | its run directory; ``log.txt`` in it has what its processes said |
| ``results.csv``, ``curves.png`` | at the end: a line and a curve for each run |
| ``.lock`` | held by the process that runs the study |

Each run is a process of ``tandem train``, so one that fails takes no other with it. A thread waits for each of them;
the main thread writes ``study.json`` and shows what the runs write into their directories.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

from pydantic import Field, ValidationError

from service.base.errors import ConfigError, StorageError, StoreError, TandemError
from service.base.files import os_errors, read_regular, write_atomic
from service.base.lock import DirectoryLock
from service.base.parsing import ParseError, parse_json
from service.base.progress import answer, track
from service.config import Config, dump_config
from service.config.frozen import FrozenModel
from service.config.self_play import SelfPlayConfig
from service.media.plots import plot_study
from service.runs.grid import Settings
from service.runs.progress import Progress
from service.runs.signals import StopSignals
from service.runs.study_results import SELECTED, as_csv, best_of, published_metrics, select
from service.runs.study_run import END_NOW, GO_ON, POLL_S, STOP, Job, Place, StudyRun, share
from service.runs.train import publish_learned
from service.store.disk_reader import DiskReader, run_id_of
from service.store.models import MAX_BYTES, STUDY_FILE
from service.store.run_directory import RunDirectory

SHOW_S = 1.0
"""Time between two looks into the run directories."""
_logger = logging.getLogger(__name__)


class StudyFile(FrozenModel):
    """Content of ``study.json``."""

    start: str | None = Field(None, description="reference of what the runs begin from")
    runs: dict[str, StudyRun]
    best: str | None = Field(None, description="name of the best run")
    published: str | None = Field(None, description="version of its primitives")
    options: tuple[str, ...] = Field((), description="of the command that goes on, which no other file has")


class Study:
    """A study in its directory. Nothing is written before ``claim``.

    Args:
        path: of the directory.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = path / STUDY_FILE
        self._lock: DirectoryLock | None = None
        self._study = StudyFile(runs={})

    @property
    def exists(self) -> bool:
        """Whether a study has begun here."""
        return self.file.is_file()

    def config_file(self, name: str) -> Path:
        """The file with the configuration of a run."""
        return self.path / f"{name}.yaml"

    def read(self) -> StudyFile:
        """Read ``study.json``.

        Raises:
            TandemError: no study here, or its file cannot be read.
        """
        if not self.exists:
            raise ConfigError(f"no study in {self.path}: {STUDY_FILE} is missing; leave out --resume to begin one")
        with os_errors("read", self.file):
            data = read_regular(self.file, MAX_BYTES, follow=True)
        with suppress(ParseError, ValidationError):
            self._study = StudyFile.model_validate(parse_json(data, self.file))
            return self._study
        raise StorageError(
            f"{self.file} does not name the runs of a study; restore it from a copy, or go on with each run by "
            "--resume --run-dir"
        )

    def claim(self) -> None:
        """Keep every other process from running this study until ``close``.

        Raises:
            RunTakenError: another process runs it.
            StorageError: the directory cannot be written.
        """
        self._lock = DirectoryLock(self.path)

    def close(self) -> None:
        """Let other processes in; a second call does nothing."""
        if self._lock is not None:
            self._lock.release(begun=self.exists)
            self._lock = None

    def check_free(self, names: Iterable[str]) -> None:
        """Check that neither a study nor one of its runs has begun here.

        Raises:
            TandemError: one has.
        """
        if self.exists:
            raise TandemError(
                f"{self.path} holds a study already; continue it with --resume, or name another --run-dir"
            )
        for directory in (RunDirectory(self.path), *(RunDirectory(self.path / name) for name in names)):
            if directory.exists:
                raise TandemError(f"{directory.path} holds a run already; name another --run-dir for this study")

    def begin(self, runs: Mapping[str, Settings], configs: Mapping[str, Config], start: str | None) -> None:
        """Begin a study here, which has been claimed.

        Args:
            runs: settings of each.
            configs: configuration of each.
            start: reference of what they begin from.

        Raises:
            TandemError: a study, or a run, is here already, or the directory cannot be written.
        """
        self.check_free(runs)  # of two that begin at once, the second sees here what the first has made
        self.write_configs(configs)
        # Last: a start that failed can be tried again.
        self._write(StudyFile(start=start, runs={name: StudyRun(settings=each) for name, each in runs.items()}))

    def write_configs(self, configs: Mapping[str, Config]) -> None:
        """Replace the configurations of runs.

        Raises:
            StorageError: they cannot be written.
        """
        for name, config in configs.items():
            write_atomic(self.config_file(name), dump_config(config).encode())

    def train(
        self,
        configs: Mapping[str, Config],
        place: Place,
        parallel: int | None,
        options: Sequence[str],
        signals: StopSignals,
        progress: Progress,
        typed: Sequence[str] = (),
    ) -> None:
        """Run all runs that have not ended, several at once.

        The first signal ends them where they can be resumed; a second one raises, and ends them at once.

        Args:
            configs: configuration of each run.
            place: where they are.
            parallel: how many at once; None: as many as there are cores for.
            options: of ``tandem train`` for every run.
            signals: of this process.
            progress: shows how far they are.
            typed: options of the command that goes on; ``study.json`` keeps them.

        Raises:
            InterruptError: a second signal.
        """
        self.read()  # again: before it was claimed, another process may have gone on with it
        jobs, num_parallel = self._jobs(configs, place, parallel, options)
        if not jobs:
            return
        self._write(self._study.model_copy(update={"options": tuple(typed)}))
        progress.say(f"runs to go: {len(jobs)}, at once: {num_parallel}")
        reader, shown, shown_s = DiskReader(self.path), dict.fromkeys(jobs, 0), float("-inf")
        show = partial(self._show, reader, shown, configs, progress)
        asked = GO_ON

        def stop() -> None:
            nonlocal asked
            asked = STOP
            answer("stopping each run after its iteration; again to end now")

        def run(job: Job) -> StudyRun | None:
            return place.run(job, lambda: asked) if asked == GO_ON else None

        with ThreadPoolExecutor(num_parallel) as threads:
            going = {name: threads.submit(run, job) for name, job in jobs.items()}
            try:
                with signals.asking(stop):
                    while going:
                        time.sleep(POLL_S)
                        for name, thread in list(going.items()):
                            if thread.done():
                                del going[name]
                                show([name])
                                if (found := thread.result()) is not None:
                                    self._note(name, found)
                                    why = f": {found.error}" if found.error else ""
                                    progress.say(f"{name}: {found.state} after {found.env_steps:,} env steps{why}")
                            elif thread.running() and self._study.runs[name].state != "running":
                                self._note(name, self._study.runs[name].now("running"))
                        if time.monotonic() - shown_s >= SHOW_S:
                            shown_s = time.monotonic()
                            show([name for name in going if self._study.runs[name].state == "running"])
            finally:
                asked = END_NOW
                for name in going:
                    if self._study.runs[name].state == "running":
                        self._note(name, self._study.runs[name].now("interrupted"))

    def finish(self, configs: Mapping[str, Config], registry: Path | None, progress: Progress) -> None:
        """Name the best of the runs that make primitives, publish it, and write the table and the picture.

        Args:
            configs: configuration of each run.
            registry: where the best is published; None: nowhere.
            progress: says what is done.

        Raises:
            TandemError: something cannot be written or published.
        """
        runs = self._study.runs
        chosen = [name for name, run in runs.items() if run.has_ended and configs[name].makes == "primitives"]
        missing = [name for name in chosen if SELECTED not in runs[name].result]
        if missing:
            progress.say(f"learning is over; runs to evaluate: {len(missing)}")
        for name in track(missing, "evaluating the runs", len(missing), "runs"):
            try:
                result = runs[name].result | select(self.path / name)
                self._note(name, runs[name].model_copy(update={"result": result}))
            except TandemError as error:  # a damaged checkpoint
                self._note(name, runs[name].now("failed", str(error)))
        runs = self._study.runs
        write_atomic(self.path / "results.csv", as_csv(runs).encode())
        with suppress(TandemError):  # none has metrics yet
            plot_study({name: self.path / name for name in runs}, self.path / "curves.png")
        best = best_of(runs)
        self._write(self._study.model_copy(update={"best": best}))  # known, whatever happens while it is published
        if best is not None and registry is not None and configs[best].publishable:
            metrics = published_metrics(runs[best], configs[best].world.usual_goals)
            version = publish_learned(self.path / best, registry, metrics=metrics)
            self._write(self._study.model_copy(update={"published": str(version)}))

    def _jobs(
        self, configs: Mapping[str, Config], place: Place, parallel: int | None, options: Sequence[str]
    ) -> tuple[dict[str, Job], int]:
        """Those runs that have more to learn, and how many are to go on at once."""
        jobs, start = dict[str, Job](), self._study.start
        going = {name: run for name, run in self._study.runs.items() if run.has_more(configs[name].run.total_env_steps)}
        if not going:
            return jobs, 0
        num_parallel, cores = share([configs[name] for name in going], place, parallel)
        for (name, run), num in zip(going.items(), cores, strict=True):
            config, more = configs[name], ("--from", start) if start is not None else ()
            jobs[name] = Job(
                directory=(self.path / name).absolute(),
                config=dump_config(config),
                total_env_steps=config.run.total_env_steps,
                run=run,
                options=(*options, *more, "--set", f"run.num_threads={num}"),
                num_cores=num,
                device=config.learner.device if isinstance(config, SelfPlayConfig) else "cpu",
            )
        return jobs, num_parallel

    def _note(self, name: str, run: StudyRun) -> None:
        self._study = self._study.model_copy(update={"runs": self._study.runs | {name: run}})
        try:
            self._write(self._study)
        except StorageError as error:  # the runs go on
            _logger.warning("%s", error)

    def _write(self, study: StudyFile) -> None:
        self._study = study
        write_atomic(self.file, study.model_dump_json(indent=1).encode() + b"\n")

    def _show(
        self,
        reader: DiskReader,
        shown: dict[str, int],
        configs: Mapping[str, Config],
        progress: Progress,
        names: Iterable[str],
    ) -> None:
        """Show the records that these runs have written since the last iterations that were shown."""
        for name in names:
            with suppress(StoreError):  # it has not begun, is elsewhere, or the disk is away for a moment
                for record in reader.metrics(run_id_of(self.path / name), after_iteration=shown[name]):
                    shown[name] = int(record["iteration"] or 0)
                    progress.show(record, configs[name].run.total_env_steps, name)
