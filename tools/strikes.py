"""Strike at each part of a run in turn: freeze it, kill it twice, take its disk, its Redis or its claim away.

    python -m tools.strikes --json docs/results/strikes.json
    python -m tools.strikes --only learner-frozen,driver-killed

Each strike is a real ``tandem pretrain`` of its own, seen from outside: pids, REST, files. What has to hold is judged
here, and written after each strike, so a program that is ended keeps what it has. Only processes that this program
started are struck. All of them take about half an hour on two cores that nobody else wants; the spinning processes ten
minutes of it (``--spin-s``).
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import training_process
from benchmarks.measuring import RECIPE_FILE, ROOT, machine, write_json
from benchmarks.training_process import ENDLESS, Training, environment, overrides, scratch
from service.errors import TandemError
from service.io.jsonl import read_jsonl
from service.store.models import RunStatus
from tests.store.redis_server import RedisServer

SETTINGS = {
    **ENDLESS, "game.num_worlds": 48, "run.checkpoint_interval": 10, "run.evaluation_interval": 0, "run.num_threads": 1,
}  # fmt: skip
"""A small game, so that rounds are short beside what is measured."""
CALM = 4
"""Iterations before a strike."""
TICK_S = 0.2
PATIENCE_S = 240.0


@dataclass
class Strike:
    """What was asked of a strike, and what was seen."""

    name: str
    must: str
    measured: str = "not measured"
    reached: bool | None = None
    seconds: float | None = None
    conditions: list[tuple[float, str, str]] = field(default_factory=list)
    """(seconds since the strike, state, condition) at each change, as the status service told."""
    warnings: list[str] = field(default_factory=list)
    tracebacks: int = 0

    def judge(self, measured: str, reached: bool, seconds: float | None = None) -> None:
        """Note the outcome; a traceback anywhere is none."""
        self.measured, self.reached, self.seconds = measured, reached and not self.tracebacks, seconds


class Watcher:
    """Looks at a run after a strike, again and again."""

    def __init__(self, training: Training, strike: Strike) -> None:
        self._training, self._strike = training, strike
        self.struck = time.monotonic()

    def since(self) -> float:
        """Seconds since the strike."""
        return time.monotonic() - self.struck

    def look(self) -> RunStatus | None:
        """The status now; notes what it says that is new."""
        status, strike = self._training.status(), self._strike
        if status is not None:
            if not strike.conditions or strike.conditions[-1][1:] != (status.state, status.condition):
                strike.conditions.append((round(self.since(), 1), status.state, status.condition))
            strike.warnings += [text for text in status.warnings if _kind(text) not in map(_kind, strike.warnings)]
        return status

    def until(self, holds: Callable[[RunStatus], bool], seconds: float = PATIENCE_S) -> float | None:
        """Seconds since the strike until the status is so; None if it was not in time."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if (status := self.look()) is not None and holds(status):
                return self.since()
            time.sleep(TICK_S)
        return None


def _kind(text: str) -> str:
    """A warning without its numbers."""
    return "".join(each for each in text if not each.isdigit())


@contextmanager
def run_of(strike: Strike, *, runtime: Any = "ray") -> Iterator[Training]:
    """A training that has made some iterations; counts the tracebacks in its log at the end."""
    arguments = ["--config", str(RECIPE_FILE), *overrides(SETTINGS)]
    arguments += ["--num-actors", "2"] if runtime == "ray" else []
    with scratch() as home, Training(home, arguments, runtime=runtime) as training:
        training.wait_until("iteration", CALM)
        yield training
        training.stop()
        strike.tracebacks = training.log_file.read_text(errors="replace").count("Traceback (most recent call last)")


@contextmanager
def with_redis(url: str) -> Iterator[None]:
    """Let the trainings of a block report to a Redis."""
    real = training_process.environment
    training_process.environment = lambda home, tree=ROOT: real(home, tree) | {"TANDEM_REDIS_URL": url}
    try:
        yield
    finally:
        training_process.environment = real


def actors_of(status: RunStatus | None) -> dict[str, tuple[int | None, int]]:
    """Pid and incarnation of every worker by name."""
    return {} if status is None else {each.name: (each.pid, each.incarnation) for each in status.actors}


def wait_for_all(training: Training) -> dict[str, tuple[int | None, int]]:
    """Wait until every worker has a process."""
    training.wait_for(lambda: (all_ := actors_of(training.status())) and all(pid for pid, _ in all_.values()))
    return actors_of(training.status())


def replaced_and_working(watcher: Watcher, name: str, incarnation: int) -> float | None:
    """Seconds since the strike until another worker has the place, and two more iterations are over."""
    if watcher.until(lambda status: _is_next(status, name, incarnation)) is None:
        return None
    iteration = (watcher.look() or _no_status()).iteration
    return watcher.until(lambda status: status.iteration > iteration + 1)


def _is_next(status: RunStatus, name: str, incarnation: int) -> bool:
    pid, now = actors_of(status)[name]
    return pid is not None and now > incarnation


# --- strikes ----------------------------------------------------------------------------------------------------------


def frozen_worker(strike: Strike, name: str) -> None:
    """Freeze the learner or the task generator for good."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        os.kill(int(before[name][0] or 0), signal.SIGSTOP)
        seconds = replaced_and_working(watcher, name, before[name][1])
        status = watcher.look() or _no_status()
        after = actors_of(status)
    others = [each for each in before if each != name and after.get(each) != before[each]]
    named = name in str(status.last_error) and "no progress" in str(status.last_error)
    said = "others were killed, too: " + ", ".join(others) if others else "nobody else killed"
    measured = f"{_s(seconds)}, {said}, {'named' if named else 'not named'} as the last error"
    strike.judge(measured, seconds is not None and seconds <= 60.0 and not others and named, seconds)


def frozen_actor(strike: Strike) -> None:
    """Freeze one of two rollout actors for good."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        recent = statistics.median(row["time/play_s"] + row["time/hand_over_s"] for row in _rows(training)[-4:])
        iterations: list[tuple[float, int]] = []
        watcher = Watcher(training, strike)
        os.kill(int(before["rollout-0"][0] or 0), signal.SIGSTOP)

        def replaced(status: RunStatus) -> bool:
            if not iterations or iterations[-1][1] != status.iteration:
                iterations.append((watcher.since(), status.iteration))
            return actors_of(status)["rollout-0"][1] > before["rollout-0"][1]

        seconds = watcher.until(replaced)
        after = actors_of(watcher.look())
    gap = max((late - early for (early, _), (late, _) in itertools.pairwise(iterations)), default=1e9)
    others = [each for each in before if each != "rollout-0" and after.get(each) != before[each]]
    bound = 3.0 * recent + 2.0 + 1.0  # the status comes once a second
    measured = f"updates stood still for {gap:.1f} s (a round takes {recent:.1f} s), replaced after {_s(seconds)}"
    strike.judge(measured, gap <= bound and seconds is not None and not others, gap)


def spinning(strike: Strike, seconds: float) -> None:
    """Let eight other processes spin."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        spinners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(8)]
        try:
            watcher.until(lambda status: False, seconds)
            status = watcher.look()
        finally:
            for spinner in spinners:
                spinner.kill()
                spinner.wait()
        after = actors_of(status)
    killed = [each for each in before if after.get(each) != before[each]]
    bad = sorted({condition for _, _, condition in strike.conditions} - {"well"})
    said = f"{', '.join(killed) or 'nobody'} killed, conditions besides well: {', '.join(bad) or 'none'}"
    strike.judge(f"{said}, in {seconds:.0f} s", not killed and not bad)


def frozen_driver(strike: Strike, seconds: float = 67.0) -> None:
    """Freeze the driver, and let it go on."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        os.kill(training.pid, signal.SIGSTOP)
        stuck = watcher.until(lambda status: status.condition == "stuck", seconds + 5.0)
        time.sleep(max(0.0, seconds - watcher.since()))
        iteration = (training.status() or _no_status()).iteration
        os.kill(training.pid, signal.SIGCONT)
        back = watcher.until(lambda status: status.condition == "well" and status.iteration > iteration + 2)
        after = actors_of(watcher.look())
    killed = [each for each in before if after.get(each) != before[each]]
    measured = f"the status says stuck after {_s(stuck)}; nobody killed" if not killed else f"killed: {killed}"
    strike.judge(measured, stuck is not None and back is not None and not killed, stuck)


def killed_twice(strike: Strike) -> None:
    """Kill the learner, and the one that takes its place as soon as it is there."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        os.kill(int(before["learner"][0] or 0), signal.SIGKILL)
        incarnation = before["learner"][1]
        watcher.until(lambda status: (now := actors_of(status)["learner"])[1] > incarnation and now[0] is not None)
        second = actors_of(watcher.look())["learner"]
        os.kill(int(second[0] or 0), signal.SIGKILL)
        watcher.struck = time.monotonic()
        seconds = replaced_and_working(watcher, "learner", second[1])
        rows = _rows(training)
    versions = [row["learner/version"] for row in rows]
    whole = versions == list(range(1, len(versions) + 1))
    measured = (
        f"{_s(seconds)} after the second kill, {'no version missing or made twice' if whole else 'versions lost'}"
    )
    strike.judge(measured, whole and seconds is not None and seconds <= 20.0, seconds)


def killed_driver(strike: Strike) -> None:
    """Kill the driver, and type the command that resumes it."""
    with run_of(strike) as training:
        training.wait_until("iteration", 16)
        iteration = _rows(training)[-1]["iteration"]
        os.kill(training.pid, signal.SIGKILL)
        started = time.monotonic()
        arguments = ["--config", str(RECIPE_FILE), *overrides(SETTINGS), "--num-actors", "2"]
        home = training.directory.path.parents[1]
        with Training(home, arguments) as again:
            again.wait_for(lambda: _is_back(again, iteration))
            seconds = time.monotonic() - started
    strike.judge(f"back at iteration {iteration:.0f} after {seconds:.1f} s", seconds <= 20.0, seconds)


def two_drivers(strike: Strike) -> None:
    """Freeze a driver past its claim in Redis, begin another one of the same run id elsewhere, let the first go on."""
    with ExitStack() as stack:
        place = stack.enter_context(scratch())
        redis = stack.enter_context(RedisServer(place / "redis"))
        stack.enter_context(with_redis(redis.address.url))
        with run_of(strike, runtime="local") as first:
            os.kill(first.pid, signal.SIGSTOP)
            time.sleep(12.0)
            with scratch() as home, Training(home, ["--config", str(RECIPE_FILE), *overrides(SETTINGS)],
                                             runtime="local") as second:  # fmt: skip
                second.wait_until("iteration", 2)
                there = len(_rows(first))
                os.kill(first.pid, signal.SIGCONT)
                watcher = Watcher(first, strike)
                while first.ended is None and watcher.since() < 60.0:
                    time.sleep(0.05)
                seconds, said = watcher.since(), first.last_words()
                grown = len(_rows(first)) - there
                alive = second.ended is None
    measured = f"it stops after {seconds:.1f} s, having recorded {grown} more iterations: {said[:90]}"
    strike.judge(measured, seconds <= 5.0 and alive and "taken over" in said and grown <= 1, seconds)


def full_disk(strike: Strike) -> None:
    """Fill the disk that a run writes to, and make room again."""
    with scratch() as home:
        (home / "runs").mkdir()
        command = ["mount", "-t", "tmpfs", "-o", "size=60m", "tmpfs", str(home / "runs")]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
            strike.measured = "not measured: no disk can be mounted here"
            return
        try:
            arguments = ["--config", str(RECIPE_FILE), *overrides(SETTINGS), "--num-actors", "2"]
            with Training(home, arguments) as training:
                training.wait_until("iteration", CALM)
                filler = home / "runs" / "filler"
                watcher = Watcher(training, strike)
                with filler.open("wb") as file:
                    try:
                        while file.write(bytes(100_000)):
                            file.flush()
                    except OSError:
                        pass
                full = watcher.until(lambda status: status.condition == "disk", 120.0)
                vanished = any("vanished" in str(each) for each in (training.status() or _no_status()).warnings)
                filler.unlink()
                back = watcher.until(lambda status: status.condition == "well", 60.0)
                training.stop()
                log = training.log_file.read_text(errors="replace")
                strike.tracebacks = log.count("Traceback (most recent call last)")
        finally:
            subprocess.run(["umount", "-l", str(home / "runs")], capture_output=True, check=False)
    measured = f"the status says disk after {_s(full)}, and well again {'yes' if back else 'no'}"
    strike.judge(measured, full is not None and back is not None and not vanished, full)


def without_redis(strike: Strike, how: str) -> None:
    """Freeze Redis, kill it, or cut its file; let it come back."""
    with ExitStack() as stack:
        place = stack.enter_context(scratch())
        redis, away, come_back = stack.enter_context(_redis(place, how))
        stack.enter_context(with_redis(redis))
        with run_of(strike) as training:
            watcher = Watcher(training, strike)
            iteration = (training.status() or _no_status()).iteration
            away()
            noticed = watcher.until(lambda status: status.condition == "redis", 60.0)
            learning = watcher.until(lambda status: status.iteration > iteration + 3, 120.0)
            come_back()
            well = watcher.until(lambda status: status.condition == "well", 60.0)
    learned = "goes on learning" if learning else "stands still"
    measured = f"the status says redis after {_s(noticed)}, it {learned}, well again: {'yes' if well else 'no'}"
    strike.judge(measured, None not in (noticed, learning, well), noticed)


def resumed(strike: Strike, damage: Callable[[Path], None]) -> None:
    """Change what a run left behind, and resume it."""
    with scratch() as home:
        arguments = ["--config", str(RECIPE_FILE), *overrides(SETTINGS | {"run.total_env_steps": 20_000})]
        with Training(home, [*arguments, "--no-publish"], runtime="local") as training:
            training.wait_until("iteration", CALM)
        path = training.directory.path
        damage(path)
        command = [sys.executable, "-m", "service", "pretrain", "--resume", "--run-dir", str(path), "--no-publish"]
        done = subprocess.run(command, cwd=ROOT, env=environment(home), capture_output=True, text=True, check=False)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    strike.tracebacks = done.stderr.count("Traceback")
    said = lines[-1] if lines else "nothing"
    strike.judge(f"exit code {done.returncode}: {said[:160]}", done.returncode == 2 and len(lines) == 1)


# --- helpers ----------------------------------------------------------------------------------------------------------


@contextmanager
def _redis(place: Path, how: str) -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """URL of a Redis, and what takes it away and brings it back."""
    servers = [RedisServer(place / "redis")]
    url = servers[0].address.url
    port, password = int(url.rpartition(":")[2].partition("/")[0]), url.removeprefix("redis://:").partition("@")[0]

    def come_back() -> None:
        servers[-1].close()
        if how == "cut":
            for file in (place / "redis").rglob("*.aof"):
                file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
        servers.append(RedisServer(place / "redis", port=port, password=password))

    try:
        if how == "frozen":
            pid = servers[0].pid
            yield url, lambda: os.kill(pid, signal.SIGSTOP), lambda: os.kill(pid, signal.SIGCONT)
        else:
            yield url, lambda: servers[-1].kill(), come_back
    finally:
        servers[-1].close()


def _rows(training: Training) -> list[dict[str, Any]]:
    return read_jsonl(training.directory.metrics_file)


def _is_back(training: Training, iteration: float) -> bool:
    """Whether the second process of a run has come to an iteration."""
    status = training.status()
    return status is not None and status.epoch >= 2 and status.iteration >= iteration


def _no_status() -> RunStatus:
    raise TandemError("the run has no status")


def _s(seconds: float | None) -> str:
    return "never" if seconds is None else f"{seconds:.1f} s"


def _cut_records(path: Path) -> None:
    file = path / "metrics.jsonl"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _change_records(path: Path) -> None:
    data = bytearray((path / "goals.jsonl").read_bytes())
    place = data.index(b".") + 1
    data[place] = ord("1") if data[place] != ord("1") else ord("2")
    (path / "goals.jsonl").write_bytes(bytes(data))


def _change_seed(path: Path) -> None:
    file = path / "config.yaml"
    file.write_text("\n".join("seed: 7" if line.startswith("seed:") else line for line in file.read_text().split("\n")))


def _change_identity(path: Path) -> None:
    tree = json.loads((path / "run.json").read_text())
    (path / "run.json").write_text(json.dumps(tree | {"run": "0" * 32}))


def strikes(spin_s: float) -> dict[str, tuple[str, Callable[[Strike], None]]]:
    """What must hold, and the strike, by name."""
    refused = "refused in one line, exit code 2"
    return {
        "learner-frozen": ("replaced in <= 60 s, nobody else killed, named", lambda s: frozen_worker(s, "learner")),
        "generator-frozen": ("replaced in <= 60 s, nobody else killed, named", lambda s: frozen_worker(s, "generator")),
        "actor-frozen": ("updates go on after <= 3 x its round + 2 s, replaced later", frozen_actor),
        "spinning": ("nobody is killed, no alert of a hang", lambda s: spinning(s, spin_s)),
        "driver-frozen": ("the status says stuck, nobody is killed", frozen_driver),
        "learner-killed-twice": ("nothing lost, <= 20 s", killed_twice),
        "driver-killed": ("back at the same iteration in <= 20 s", killed_driver),
        "two-drivers": ("the first stops in <= 5 s and writes nothing more", two_drivers),
        "disk-full": ("the status says disk, and well once there is room", full_disk),
        "redis-frozen": ("the status says redis, learning goes on", lambda s: without_redis(s, "frozen")),
        "redis-killed": ("the status says redis, learning goes on", lambda s: without_redis(s, "killed")),
        "redis-file-cut": ("the status says redis, learning goes on", lambda s: without_redis(s, "cut")),
        "records-deleted": (refused, lambda s: resumed(s, lambda path: (path / "metrics.jsonl").unlink())),
        "records-cut": (refused, lambda s: resumed(s, _cut_records)),
        "records-changed": (refused, lambda s: resumed(s, _change_records)),
        "seed-changed": (refused, lambda s: resumed(s, _change_seed)),
        "checkpoint-of-another-run": (refused, lambda s: resumed(s, _change_identity)),
    }


def main() -> int:
    """Parse the command line, strike, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="A,B", help="names with commas between; default: all")
    parser.add_argument("--spin-s", type=float, default=600.0, help="default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result, after each strike")
    given = parser.parse_args()
    known = strikes(given.spin_s)
    names = given.only.split(",") if given.only else list(known)
    if wrong := [name for name in names if name not in known]:
        parser.error(f"--only: no strike {wrong[0]!r}; choose of {', '.join(known)}")
    done: list[Strike] = []
    for name in names:
        must, play = known[name]
        strike = Strike(name, must)
        done.append(strike)
        try:
            play(strike)
        except Exception as error:
            traceback.print_exc()
            strike.judge(f"{type(error).__name__}: {str(error)[:160]}", reached=False)
        print(f"{name}: {strike.measured} ({strike.reached})", flush=True)
        if given.json is not None:
            where = machine("ray", "torch", "mujoco")
            tree = [asdict(each) for each in done]
            write_json(given.json, {"tool": "strikes", "machine": where, "strikes": tree})
    return int(any(strike.reached is False for strike in done))


if __name__ == "__main__":
    raise SystemExit(main())
