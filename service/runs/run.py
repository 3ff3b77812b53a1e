"""A run: it drives a method until its budget is spent, records what happens, and can be stopped and resumed.

Consumes the iterations of one ``Method``; produces records, checkpoints and snapshots in one directory. It waits for
the method alone, which also says whether an iteration has ended.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Literal, get_args

import numpy as np

from service.base.errors import CheckpointError, ConfigError, DivergedError, TandemError
from service.base.jsonl import plain
from service.base.types import Metrics
from service.base.user_code import CodeError, check_members, naming_unexpected, origin_of
from service.config import Config
from service.methods.method import Iteration, Method, State, Timing
from service.policies.parameters import Parameters, PolicyError
from service.runs.resuming import changed_settings
from service.runs.states import check_comes_back, flatten, put_together
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import Published, Resumption, RunDirectory
from service.store.tail import INDEX

Ending = Literal["finished", "converged"]
OnIteration = Callable[[Metrics], Ending | None]
"""Is told the metrics of an iteration; may say why the run is to end after it."""
OnBeat = Callable[[], None]
NUM_SNAPSHOTS = 10
"""Snapshots of what was learned, evenly over a run's env steps; one of it untrained comes before them."""
MAX_IDLE = 1000
"""Iterations in a row without env steps: a run of them would never end."""
_OWN = ("time/wall_s", "time/env_steps_per_s")
"""Metrics that a run adds."""
BEAT_S = 1.0
"""Time between two heartbeats of a run whose iterations take longer."""
_logger = logging.getLogger(__name__)


class UnsavedError(CheckpointError):
    """A run has ended, and its last checkpoint could not be written."""

    exit_code = 1


_REPLACEABLE = ("remedy", "measure", "start", "step", "evaluate", "parameters", "health", "grid", "state", "load_state",
                "close")  # fmt: skip
"""What a method of a user's may have of its own."""


class Run:
    """A run of a method in a directory.

    Args:
        config: the run.
        directory: where it keeps everything; it is claimed here.
        make: makes the method, once the directory is this process's.
        resume: continue from the newest checkpoint instead of starting anew.
        parent: version that a new run begins from.
        on_beat: called about every second while its method starts.

    Raises:
        TandemError: see ``RunDirectory.claim``; or the method cannot be made.
        CheckpointError: ``resume`` without a usable checkpoint.
    """

    def __init__(
        self,
        config: Config,
        directory: RunDirectory,
        make: Callable[[], Method],
        *,
        resume: bool = False,
        parent: Published | None = None,
        on_beat: OnBeat = lambda: None,
    ) -> None:
        directory.claim(resume=resume)
        self.config, self.directory = config, directory
        self.checkpoints = CheckpointStore(directory.checkpoints, config.run.keep_checkpoints, epoch=directory.epoch)
        self._snapshots = CheckpointStore(directory.snapshots)
        self._saved: int | None = None
        """The iteration of the newest checkpoint; None before the first."""
        self.wall_s = 0.0
        """Seconds spent on iterations, by all processes that ran this run."""
        self._iteration_s = 0.0
        self._last_beat = time.monotonic()
        self._stop_requested, self._closed, self._num_idle = False, False, 0
        self._not_finite = set[str]()
        """Metrics of which it was said that they are NaN or infinite."""
        self._ending: Ending | None = None
        self._on_iteration: OnIteration = lambda metrics: None
        self._on_beat = on_beat
        saved = self._load() if resume else None
        self._origin = origin_of(type(config))
        """Of a method of a user's, its file."""
        with self.naming_errors():
            method = make()
        self._expect(isinstance(method, Method), "build", method, "a Method")
        if saved is None:
            check_members(type(method), Method, _REPLACEABLE)
        self._expect(hasattr(method, "timing"), "build", method, "one whose __init__ calls super().__init__()")
        self.method = method
        self._check_attributes()
        method.on_wait = self._beat
        try:
            if saved is not None:
                resumption, state = saved
                method.iteration, method.num_env_steps = resumption.iteration, resumption.num_env_steps
                with self.naming_errors():
                    method.start(state)
                _logger.info("resumed at iteration %d, %d env steps", self.iteration, self.num_env_steps)
                directory.start(config, resumption)
            else:
                with self.naming_errors():
                    method.start()
                # An untrained run is saved, so that one that is killed before its first interval can be resumed, too.
                self._save()
                self._take_snapshot(before=-1)
                directory.start(config)
                if parent is not None:
                    directory.write_published(parent)
        except BaseException:
            self.close()
            raise

    @property
    def iteration(self) -> int:
        """Finished iterations."""
        return self.method.iteration

    @property
    def num_env_steps(self) -> int:
        """Env steps of all finished iterations."""
        return self.method.num_env_steps

    def request_stop(self) -> None:
        """End soon, with a checkpoint. Safe to call from a signal handler."""
        self._stop_requested = True

    def run(self, on_iteration: OnIteration = lambda metrics: None, on_beat: OnBeat = lambda: None) -> str:
        """Learn and record until the budget is spent, the method has converged, or a stop is requested.

        Args:
            on_iteration: called with the metrics of every iteration; what it returns, if anything, ends the run.
            on_beat: called about every second where iterations take longer.

        Returns:
            Why it has ended: ``finished`` (budget), ``converged`` (nothing more to learn) or ``interrupted``.

        Raises:
            DivergedError: a policy has.
            StateLostError: the method's state is lost; a new ``Run`` can go on from the newest checkpoint.
            UnsavedError: the last checkpoint could not be written; earlier ones that could not are only warned of.
        """
        self._on_iteration, self._on_beat = on_iteration, on_beat
        while (reason := self._stop_reason()) is None:
            self._advance()
        self._save_last()
        return reason

    def close(self) -> None:
        """End what the method has started; a second call does nothing. What a user's raises there is only warned of."""
        if self._closed:
            return
        self._closed = True
        try:
            with self.naming_errors():
                self.method.close()
        except TandemError as error:
            if self._origin is None:
                raise
            _logger.warning("%s; what the run has learned is there", error)

    def _stop_reason(self) -> str | None:
        if self._stop_requested:
            return "interrupted"
        if self._ending is not None:
            return self._ending
        if self.num_env_steps >= self.config.run.total_env_steps:
            return "finished"
        return "converged" if self.method.converged else None

    def _advance(self) -> None:
        method, before, begun = self.method, self.num_env_steps, time.perf_counter()
        played, interval = self.iteration, self.config.run.evaluation_interval
        evaluated: Metrics = {}
        try:
            with self.naming_errors():
                ended = method.step()
            self._check(ended, before, played)
            if ended is not None and interval and self.iteration % interval == 0:
                with method.timing("evaluate"), self.naming_errors():
                    evaluated = self.numbers("evaluate", method.evaluate())
                    self._refuse("evaluate", evaluated.keys() & {*INDEX, *_OWN})
        except (DivergedError, PolicyError) as error:
            raise self._diverged(error, played) from error
        except CodeError as error:
            raise CodeError(
                f"{error}; the run has ended. It keeps the text that it began with: correct the file, and begin "
                "another one (--run-dir)"
            ) from error
        self._iteration_s += time.perf_counter() - begun
        if ended is None:
            self._beat()
            return
        self.wall_s += self._iteration_s
        speed = (self.num_env_steps - before) / self._iteration_s
        self._iteration_s = 0.0
        times = dict(zip(_OWN, (self.wall_s, speed), strict=True))
        with method.timing("record"):
            self._record(ended, ended.metrics | evaluated | times)
        with self._tolerating("without this snapshot"):
            self._take_snapshot(before=before)
        if self.iteration % self.config.run.checkpoint_interval == 0:
            with self._tolerating(f"and saves again after {self.config.run.checkpoint_interval} iterations"):
                self._save()

    def naming_errors(self) -> AbstractContextManager[None]:
        """Say of an unexpected error of a user's method where in its file it comes from."""
        return naming_unexpected(self._origin)

    def _check(self, ended: object, before: int, played: int) -> None:
        """Check what a step gave, before which there were so many env steps and iterations; of a user's all of it."""
        if ended is not None:
            self._num_idle = self._num_idle + 1 if self.num_env_steps <= before else 0
        if self._num_idle >= MAX_IDLE:
            words = f"{MAX_IDLE} iterations made no env steps"
            if self._origin is None:
                raise ConfigError(f"{words}: generator.goal_source gave no goal that Bob can play")
            raise CodeError(f"{self._origin}: {words}; say how many with self.count(NUMBER)")
        if self._origin is None:
            return
        self._check_attributes()
        counted = self.iteration - played
        if counted != (ended is not None):
            given = "None" if ended is None else "an Iteration"
            raise CodeError(
                f"{self._origin}: step counted iterations: {counted}, and gave {given}: call self.count(NUMBER) once "
                "for each Iteration that it returns"
            )
        self._expect(isinstance(self.method.converged, int | np.bool_), "converged", self.method.converged, "a bool")
        if ended is None:
            return
        self._expect(isinstance(ended, Iteration), "step", ended, "an Iteration or None")
        assert isinstance(ended, Iteration)
        metrics = self.numbers("the Iteration of step", ended.metrics)
        if any(
            metrics.get(name) != number
            for name, number in zip(INDEX, (self.iteration, self.num_env_steps), strict=True)
        ):
            raise CodeError(
                f"{self._origin}: the metrics of an Iteration lack its iteration and env_steps: begin them with what "
                "self.count(NUMBER) gives, and leave these two as they are"
            )
        self._expect(isinstance(ended.diverged, Mapping), "the Iteration's diverged", ended.diverged, "none")
        goals = ended.goals
        if goals is None:
            return
        self._expect(isinstance(goals, np.ndarray), "the Iteration's goals", goals, "an array, or None")
        columns = 6 * self.config.world.num_objects + 1
        if goals.ndim != 2 or goals.shape[1] != columns or goals.dtype.kind not in "fiu":
            raise CodeError(
                f"{self._origin}: the goals of an Iteration are {goals.dtype} of shape {goals.shape}; give numbers of "
                f"shape (M, {columns}), or None"
            )

    def _check_attributes(self) -> None:
        """Refuse attributes of a user's method that hide what the run calls."""
        if hidden := [name for name in vars(self.method) if callable(getattr(Method, name, None))]:
            raise CodeError(
                f"{self._origin}: self.{hidden[0]} hides {hidden[0]}() of every Method; give it another name, such as "
                f"self._{hidden[0]}"
            )
        timing = self.method.timing
        self._expect(isinstance(timing, Timing), "self.timing", timing, "it another name, such as _timing")

    def _refuse(self, verb: str, names: Collection[str]) -> None:
        """Refuse metrics of a user's method that the run has itself."""
        if self._origin is not None and names:
            raise CodeError(
                f"{self._origin}: {verb} gave {', '.join(sorted(names))}, which the run says; leave them out"
            )

    def numbers(self, verb: str, found: Metrics) -> Metrics:
        """Metrics that a verb of the method gave; those of a user's are checked."""
        self._expect(isinstance(found, Mapping), verb, found, "metrics, numbers by name")
        for name, value in found.items() if self._origin is not None else ():
            number = plain(value)
            if not (isinstance(name, str) and isinstance(number, int | float | None)):
                raise CodeError(
                    f"{self._origin}: {verb} gave {{{name!r}: {value!r}}}; give numbers by names, which are text"
                )
            if number is None and name not in self._not_finite:
                self._not_finite.add(name)
                _logger.warning("%s: %s gave %s = %s, which is recorded as missing", self._origin, verb, name, value)
        return found

    def parameters(self) -> Parameters:
        """What the method has learned."""
        with self.naming_errors():
            found = self.method.parameters()
        self._expect(isinstance(found, Mapping), "parameters", found, "NumPy's arrays by name")
        for name, array in found.items():
            self._expect(isinstance(array, np.ndarray), f"parameters, {name!r},", array, "one of NumPy's arrays")
        return found

    def _expect(self, fits: bool, verb: str, found: object, wanted: str) -> None:
        """Refuse what a verb of a user's method gave."""
        if self._origin is not None and not fits:
            raise CodeError(f"{self._origin}: {verb} gave a {type(found).__name__}; give {wanted}")

    def _record(self, ended: Iteration, metrics: Metrics) -> None:
        for name, diverged in ended.diverged.items():
            self.directory.dump_diverged(name, diverged)
        self.directory.record(metrics)
        if ended.goals is not None:
            self.directory.record_goals(self.iteration, self.num_env_steps, ended.goals)
        self._ending = self._on_iteration(metrics)
        if self._ending not in (None, *get_args(Ending)):
            raise ConfigError(f"on_iteration gave {self._ending!r}: return None, or {' or '.join(get_args(Ending))}")

    def _beat(self) -> None:
        if time.monotonic() - self._last_beat >= BEAT_S:
            self._last_beat = time.monotonic()
            self._on_beat()

    # --- saving ----------------------------------------------------------------------------------------------------

    def _load(self) -> tuple[Resumption, State]:
        """Read the newest checkpoint, once it is clear that it is of this run.

        Raises:
            CheckpointError: there is no usable one, or it is of another run or configuration.
        """
        checkpoint = self.checkpoints.load_latest()
        meta = checkpoint.meta
        changed = changed_settings(meta["config"], self.config, self.directory.path)
        resumption = Resumption(checkpoint.step, int(meta["env_steps"]), meta["run"], changed)
        self.directory.check_resumable(resumption)
        self._saved = checkpoint.step
        if changed:
            said = ", ".join(f"{key} from {was!r} to {now!r}" for key, (was, now) in changed.items())
            _logger.info("changed since iteration %d: %s", checkpoint.step, said)
        self.wall_s = float(meta["wall_s"])
        return resumption, put_together(checkpoint.arrays, meta["state"])

    def _save(self) -> None:
        """Write a checkpoint: with it alone a new process goes on.

        Raises:
            CheckpointError: a full disk; earlier checkpoints are intact.
        """
        directory = self.directory
        with self.method.timing("checkpoint"):
            with self.naming_errors():
                state = self.method.state()
            self._expect(isinstance(state, Mapping), "state", state, "arrays and plain values by name")
            if self._origin is not None:
                with self._saving("state"):
                    check_comes_back(state)
            arrays, values = flatten(state)
            directory.check_owner()
            directory.sync()
            meta = {
                "env_steps": self.num_env_steps,
                "wall_s": self.wall_s,
                "config": self.config.model_dump(mode="json"),
                "run": directory.history.run,
                "state": values,
            }
            with directory.noting(directory.checkpoints), self._saving("state"):
                self.checkpoints.save(self.iteration, arrays, meta)
        self._saved = self.iteration

    @contextmanager
    def _saving(self, verb: str) -> Iterator[None]:
        """Name the verb of a user's method that gave what cannot be saved."""
        try:
            yield
        except TandemError:
            raise
        except (TypeError, ValueError) as error:
            if self._origin is None:
                raise
            raise CodeError(
                f"{self._origin}: {verb} gave what cannot be saved: {error}; give arrays of numbers, and of a state "
                "also plain values, as JSON has them, and lists and dictionaries of both"
            ) from error

    def _take_snapshot(self, *, before: int) -> None:
        """Keep what was learned for good, if a tenth of the budget is over since so many env steps.

        Checkpoints go, and later it is asked what could be done when. A resumed run takes those it takes again with
        the same bits.
        """
        tenths = [steps * NUM_SNAPSHOTS // self.config.run.total_env_steps for steps in (before, self.num_env_steps)]
        if tenths[0] != tenths[1]:
            with self.method.timing("checkpoint"):
                arrays = {f"{self.config.part}/{name}": array for name, array in self.parameters().items()}
                with self._saving("parameters"):
                    self._snapshots.save(self.iteration, arrays, {"env_steps": self.num_env_steps})

    @contextmanager
    def _tolerating(self, consequence: str) -> Iterator[None]:
        """Warn of a full disk and go on: what was saved before is intact, and what comes may fit."""
        try:
            yield
        except CheckpointError as error:
            _logger.warning("%s; the run goes on, %s", error, consequence)

    def _diverged(self, error: Exception, played: int) -> DivergedError:
        """The error of a policy that has diverged, with when that was, and how to go on from before it."""
        newest = self.checkpoints.newest()
        is_played = newest is not None and self.checkpoints.steps()[-1] == played
        has_it = f"delete {newest.name}, which has this policy; " if newest is not None and is_played else ""
        said = str(error).strip().splitlines()[-1]  # from another process it comes with its traceback
        return DivergedError(f"{self.directory.path}, iteration {played + 1}: {said}: {has_it}{self.method.remedy}")

    def _save_last(self) -> None:
        """Save the last iteration, if it is not, and say what is lost where that fails."""
        try:
            if self._saved != self.iteration:
                self._save()
        except CheckpointError as error:
            saved = next(reversed(self.checkpoints.steps()), None)
            raise UnsavedError(
                f"{error}; the run is at iteration {self.iteration}, saved is iteration {saved}: --resume goes on there"
            ) from error
