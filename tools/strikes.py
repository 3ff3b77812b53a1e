"""Strike at each part of a run in turn: freeze it, kill it twice, take its disk, its Redis or its claim away.

    python -m tools.strikes --json docs/results/strikes.json
    python -m tools.strikes --only learner-frozen,driver-killed
    python -m tools.strikes --only freezes --freezes-s 3600 --json docs/results/strikes.json

Each strike is a real ``tandem pretrain`` of its own, seen from outside: pids, REST, files. What has to hold is judged
here, and written after each strike, so a program that is ended keeps what it has. Only processes that this program
started are struck. All of them take about half an hour on two cores that nobody else wants; the spinning processes ten
minutes of it (``--spin-s``), freezes at random five (``--freezes-s``).
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path

from benchmarks.measuring import ROOT, machine, write_json
from benchmarks.training_process import Training, environment, overrides, scratch
from service.store.models import RunStatus
from tools.rollout_audit import audit_run
from tools.strike_freezes import busy, endings, freeze_at_random
from tools.strike_runs import (
    ARGUMENTS,
    CALM,
    Clock,
    Strike,
    Watcher,
    changed,
    no_status,
    redis_to_strike,
    replaced_and_working,
    rows_of,
    run_of,
    run_on_nodes,
    seconds_text,
    versions_are_whole,
    wait_for_all,
    workers_of,
)

JUMP_S = 3600.0


# --- strikes ----------------------------------------------------------------------------------------------------------


def frozen_worker(strike: Strike, name: str) -> None:
    """Freeze the learner or the task generator for good."""
    with run_of(strike) as training:
        _freeze_worker(strike, training, name)


def frozen_worker_on_a_node(strike: Strike, name: str) -> None:
    """Freeze it on a cluster of two nodes."""
    with run_on_nodes(strike) as (_, training):
        _freeze_worker(strike, training, name)


def _freeze_worker(strike: Strike, training: Training, name: str) -> None:
    before = wait_for_all(training)
    watcher = Watcher(training, strike)
    os.kill(int(before[name][0] or 0), signal.SIGSTOP)
    seconds = replaced_and_working(watcher, name, before[name][1])
    status = watcher.look() or no_status()
    others = changed(before, workers_of(status), but=name)
    named = name in str(status.last_error) and "no progress" in str(status.last_error)
    said = "others were killed, too: " + ", ".join(others) if others else "nobody else killed"
    measured = f"{seconds_text(seconds)}, {said}, {'named' if named else 'not named'} as the last error"
    strike.judge(measured, seconds is not None and seconds <= 60.0 and not others and named, seconds)


def lost_node(strike: Strike, kind: signal.Signals) -> None:
    """Freeze or kill all of one of two nodes, the one with the learner on it: as if the network to it had parted."""
    with run_on_nodes(strike) as (nodes, training):
        before = wait_for_all(training)
        struck = nodes.of(int(before["learner"][0] or 0))
        there = [name for name, (pid, _) in before.items() if pid in struck]
        watcher = Watcher(training, strike)
        for pid in struck:
            os.kill(pid, kind)
        seconds = replaced_and_working(watcher, "learner", before["learner"][1])
        others = [each for each in changed(before, workers_of(watcher.look())) if each not in there]
        if kind == signal.SIGSTOP:  # what wakes up has to leave the run alone
            for pid in struck:
                _signal(pid, signal.SIGCONT)
            watcher.until_iterations(5)
        whole = versions_are_whole(training)
    measured = (
        f"{', '.join(there)} were on it; learning goes on after {seconds_text(seconds)}, "
        f"{'nobody else killed' if not others else 'others killed: ' + ', '.join(others)}, "
        f"{'no version missing or made twice' if whole else 'versions lost'}"
    )
    strike.judge(measured, seconds is not None and seconds <= 60.0 and not others and whole, seconds)


def frozen_actor(strike: Strike) -> None:
    """Freeze one of two rollout actors for good."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        recent = statistics.median(row["time/play_s"] + row["time/hand_over_s"] for row in rows_of(training)[-4:])
        iterations: list[tuple[float, int]] = []
        watcher = Watcher(training, strike)
        os.kill(int(before["rollout-0"][0] or 0), signal.SIGSTOP)

        def replaced(status: RunStatus) -> bool:
            if not iterations or iterations[-1][1] != status.iteration:
                iterations.append((watcher.since(), status.iteration))
            return workers_of(status)["rollout-0"][1] > before["rollout-0"][1]

        seconds = watcher.until(replaced)
        after = workers_of(watcher.look())
    gap = max((late - early for (early, _), (late, _) in itertools.pairwise(iterations)), default=1e9)
    others = changed(before, after, but="rollout-0")
    bound = 3.0 * recent + 2.0 + 1.0  # the status comes once a second
    measured = (
        f"updates stood still for {gap:.1f} s (a round takes {recent:.1f} s), replaced after {seconds_text(seconds)}"
    )
    strike.judge(measured, gap <= bound and seconds is not None and not others, gap)


def spinning(strike: Strike, seconds: float) -> None:
    """Let eight other processes spin."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        with busy(8):
            watcher.until(lambda status: False, seconds)
            after = workers_of(watcher.look())
    killed = changed(before, after)
    bad = sorted({condition for _, _, condition in strike.conditions} - {"well"})
    said = f"{', '.join(killed) or 'nobody'} killed, conditions besides well: {', '.join(bad) or 'none'}"
    strike.judge(f"{said}, in {seconds:.0f} s", not killed and not bad)


def random_freezes(strike: Strike, seconds: float, num_busy: int) -> None:
    """Freeze processes at random, one of them for up to 25 s or all for up to 30 s, beside others that spin."""
    settings = overrides({"game.num_worlds": 16, "run.evaluation_interval": 50})
    with run_of(strike, arguments=settings) as training, busy(num_busy):
        wait_for_all(training)
        watcher = Watcher(training, strike)
        freezes = list(freeze_at_random(training, watcher, seconds, random.Random(int(seconds))))
        went_on = training.ended is None and watcher.until_iterations(3) is not None
        ended = endings(training, freezes)
        training.stop()
        account = audit_run(training.directory, watcher.look() or no_status(), watcher.seen, late=True)
    unjustified = [f"{each['worker']} ({each['reason']})" for each in ended if not each["justified"]]
    strike.details = {"freezes": [asdict(each) for each in freezes], "endings": ended, "account": account}
    measured = (
        f"{len(freezes)} freezes in {seconds / 60.0:.0f} min beside {num_busy} that spin: {len(ended)} workers ended, "
        f"{len(unjustified)} of them healthy{': ' * bool(unjustified)}{'; '.join(unjustified[:3])}; "
        f"{account['num_iterations']} iterations, {account['num_counted']} rollouts counted, {account['num_refused']} "
        f"came too late, records and ledger {'agree' if account['complete'] else 'do not agree'}"
    )
    strike.judge(measured, went_on and not unjustified and bool(account["complete"]))


def frozen_driver(strike: Strike, seconds: float = 67.0) -> None:
    """Freeze the driver, and let it go on."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        os.kill(training.pid, signal.SIGSTOP)
        stuck = watcher.until(lambda status: status.condition == "stuck", seconds + 5.0)
        time.sleep(max(0.0, seconds - watcher.since()))
        iteration = (training.status() or no_status()).iteration
        os.kill(training.pid, signal.SIGCONT)
        back = watcher.until(lambda status: status.condition == "well" and status.iteration > iteration + 2)
        after = workers_of(watcher.look())
    killed = changed(before, after)
    measured = (
        f"the status says stuck after {seconds_text(stuck)}; nobody killed" if not killed else f"killed: {killed}"
    )
    strike.judge(measured, stuck is not None and back is not None and not killed, stuck)


def killed_twice(strike: Strike) -> None:
    """Kill the learner, and the one that takes its place as soon as it is there."""
    with run_of(strike) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        os.kill(int(before["learner"][0] or 0), signal.SIGKILL)
        incarnation = before["learner"][1]
        watcher.until(lambda status: (now := workers_of(status)["learner"])[1] > incarnation and now[0] is not None)
        second = workers_of(watcher.look())["learner"]
        os.kill(int(second[0] or 0), signal.SIGKILL)
        watcher.struck = time.monotonic()
        seconds = replaced_and_working(watcher, "learner", second[1])
        whole = versions_are_whole(training)
    lost = "no version missing or made twice" if whole else "versions lost"
    measured = f"{seconds_text(seconds)} after the second kill, {lost}"
    strike.judge(measured, whole and seconds is not None and seconds <= 20.0, seconds)


def killed_driver(strike: Strike) -> None:
    """Kill the driver, and type the command that resumes it."""
    with run_of(strike) as training:
        training.wait_until("iteration", 16)
        iteration = rows_of(training)[-1]["iteration"]
        os.kill(training.pid, signal.SIGKILL)
        started = time.monotonic()
        home = training.directory.path.parents[1]
        with Training(home, [*ARGUMENTS, "--num-actors", "2"]) as again:
            again.wait_for(lambda: _is_back(again, iteration))
            seconds = time.monotonic() - started
    strike.judge(f"back at iteration {iteration:.0f} after {seconds:.1f} s", seconds <= 20.0, seconds)


def two_drivers(strike: Strike, how: str) -> None:
    """Keep a driver from its claim in Redis until another one of the same run id has begun elsewhere.

    Args:
        strike: what is noted.
        how: ``frozen``: the first driver is; ``parted``: the network between it and Redis is.
    """
    with ExitStack() as stack:
        redis = stack.enter_context(redis_to_strike("parted"))
        first = stack.enter_context(run_of(strike, runtime="local", variables=redis.variables))
        if how == "frozen":
            os.kill(first.pid, signal.SIGSTOP)
        else:
            redis.away()
        time.sleep(12.0)
        home = stack.enter_context(scratch())
        second = stack.enter_context(Training(home, ARGUMENTS, runtime="local", variables=redis.direct))
        second.wait_until("iteration", 2)
        there = len(rows_of(first))
        if how == "frozen":
            os.kill(first.pid, signal.SIGCONT)
        else:
            redis.come_back()
        watcher = Watcher(first, strike)
        while first.ended is None and watcher.since() < 60.0:
            time.sleep(0.05)
        seconds, said = watcher.since(), first.last_words()
        grown, alive = len(rows_of(first)) - there, second.ended is None
    measured = f"it stops after {seconds:.1f} s, having recorded {grown} more iterations: {said}"
    few = grown <= 1 or how == "parted"
    strike.judge(measured, seconds <= 5.0 and alive and "taken over" in said and few, seconds)


def full_disk(strike: Strike) -> None:
    """Fill the disk that a run writes to, and make room again."""
    with ExitStack() as stack:
        home = stack.enter_context(scratch())
        (home / "runs").mkdir()
        command = ["mount", "-t", "tmpfs", "-o", "size=60m", "tmpfs", str(home / "runs")]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
            strike.measured = "not measured: no disk can be mounted here"
            return
        unmount = ["umount", "-l", str(home / "runs")]
        stack.callback(lambda: subprocess.run(unmount, capture_output=True, check=False))
        training = stack.enter_context(run_of(strike, home=home))
        filler = home / "runs" / "filler"
        watcher = Watcher(training, strike)
        with filler.open("wb") as file, suppress(OSError):
            while file.write(bytes(100_000)):
                file.flush()
        full = watcher.until(lambda status: status.condition == "disk", 120.0)
        watcher.until(lambda status: False, 30.0)
        filler.unlink()
        back = watcher.until_well()
    states = {state for _, state, _ in strike.conditions}
    measured = (
        f"the status says disk after {seconds_text(full)}, and well again {seconds_text(back)} after the strike; its "
        f"state: {', '.join(sorted(states))}"
    )
    strike.judge(measured, full is not None and back is not None and states == {"running"}, full)


def without_redis(strike: Strike, how: str) -> None:
    """Take Redis away, one way or another, and bring it back."""
    with redis_to_strike(how) as redis, run_of(strike, variables=redis.variables) as training:
        before = wait_for_all(training)
        watcher = Watcher(training, strike)
        redis.away()
        noticed = watcher.until(lambda status: status.condition == "redis", 60.0)
        learning = watcher.until_iterations(3, 120.0)
        redis.come_back()
        well = watcher.until_well()
        killed = changed(before, workers_of(watcher.look()))
    measured = (
        f"the status says redis after {seconds_text(noticed)}, it {'goes on learning' if learning else 'stands still'},"
        f" {'nobody killed' if not killed else 'killed: ' + ', '.join(killed)}, well again: {'yes' if well else 'no'}"
    )
    strike.judge(measured, None not in (noticed, learning, well) and not killed, noticed)


def wrong_clock(strike: Strike) -> None:
    """Let the clock of a run's machine jump an hour ahead, and an hour back, as seen from a machine that is right."""
    if not Clock.is_there():
        strike.measured = "not measured: libfaketime is not installed"
        return
    with scratch() as place:
        clock = Clock(place)
        with run_of(strike, runtime="local", variables=clock.variables) as training:
            watcher = Watcher(training, strike)
            clock.jump(JUMP_S)
            noticed = watcher.until(lambda status: status.condition == "clock", 60.0)
            ahead = watcher.until_iterations(3)
            clock.jump(-JUMP_S)
            well = watcher.until_well()
            back = watcher.until_iterations(3)
            clock.jump(0)
            right = watcher.until_iterations(3)
            rates = [row["time/env_steps_per_s"] for row in rows_of(training)]
    sane = min(rates) > 0.0 and max(rates) < 10.0 * statistics.median(rates)
    learned = "goes on learning each time" if None not in (ahead, back, right) else "stands still"
    measured = (
        f"the status says clock after {seconds_text(noticed)}, well again: {'yes' if well else 'no'}, it {learned}, "
        f"its rates are {'right' if sane else 'wrong'}"
    )
    strike.judge(measured, None not in (noticed, ahead, well, back, right) and sane, noticed)


def resumed(strike: Strike, damage: Callable[[Path], None]) -> None:
    """Change what a run left behind, and resume it."""
    with scratch() as home:
        with Training(home, [*ARGUMENTS, "--no-publish"], runtime="local") as training:
            training.wait_until("iteration", CALM)
        path = training.directory.path
        damage(path)
        command = [sys.executable, "-m", "service", "pretrain", "--resume", "--run-dir", str(path), "--no-publish"]
        done = subprocess.run(command, cwd=ROOT, env=environment(home), capture_output=True, text=True, check=False)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    strike.tracebacks = done.stderr.count("Traceback")
    said = lines[-1].replace(str(path), "RUN") if lines else "nothing"
    strike.judge(f"exit code {done.returncode}: {said}", done.returncode == 2 and len(lines) == 1)


# --- helpers ----------------------------------------------------------------------------------------------------------


def _signal(pid: int, kind: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, kind)


def _is_back(training: Training, iteration: float) -> bool:
    """Whether the second process of a run has come to an iteration."""
    status = training.status()
    return status is not None and status.epoch >= 2 and status.iteration >= iteration


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


def strikes(spin_s: float, freezes_s: float, num_busy: int) -> dict[str, tuple[str, Callable[[Strike], None]]]:
    """What must hold, and the strike, by name."""
    replaced = "replaced in <= 60 s, nobody else killed, named"
    away = "what was on it is replaced in <= 60 s, nothing lost"
    refused = "refused in one line, exit code 2"
    return {
        "learner-frozen": (replaced, lambda s: frozen_worker(s, "learner")),
        "generator-frozen": (replaced, lambda s: frozen_worker(s, "generator")),
        "actor-frozen": ("updates go on after <= 3 x its round + 2 s, replaced later", frozen_actor),
        "spinning": ("nobody is killed, no alert of a hang", lambda s: spinning(s, spin_s)),
        "freezes": (
            "every ending of a worker justified, nothing lost or counted twice",
            lambda s: random_freezes(s, freezes_s, num_busy),
        ),
        "driver-frozen": ("the status says stuck, nobody is killed", frozen_driver),
        "learner-killed-twice": ("nothing lost, <= 20 s", killed_twice),
        "driver-killed": ("back at the same iteration in <= 20 s", killed_driver),
        "two-drivers": ("the first stops in <= 5 s and writes nothing more", lambda s: two_drivers(s, "frozen")),
        "two-drivers-parted": ("the first stops <= 5 s after the network is back", lambda s: two_drivers(s, "parted")),
        "disk-full": ("the status says disk, and well once there is room", full_disk),
        "redis-frozen": ("the status says redis, learning goes on", lambda s: without_redis(s, "frozen")),
        "redis-killed": ("the status says redis, learning goes on", lambda s: without_redis(s, "killed")),
        "redis-file-cut": ("the status says redis, learning goes on", lambda s: without_redis(s, "cut")),
        "redis-parted": ("the status says redis, learning goes on", lambda s: without_redis(s, "parted")),
        "clock-jumps": ("the status says clock, learning goes on", wrong_clock),
        "node-frozen": (away, lambda s: lost_node(s, signal.SIGSTOP)),
        "node-killed": (away, lambda s: lost_node(s, signal.SIGKILL)),
        "learner-frozen-on-a-node": (replaced, lambda s: frozen_worker_on_a_node(s, "learner")),
        "generator-frozen-on-a-node": (replaced, lambda s: frozen_worker_on_a_node(s, "generator")),
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
    parser.add_argument("--freezes-s", type=float, default=300.0, help="default: %(default)s")
    parser.add_argument("--busy", type=int, default=4, help="processes that spin beside; default: %(default)s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result, after each strike")
    given = parser.parse_args()
    known = strikes(given.spin_s, given.freezes_s, given.busy)
    names = given.only.split(",") if given.only else list(known)
    if wrong := [name for name in names if name not in known]:
        parser.error(f"--only: no strike {wrong[0]!r}; choose of {', '.join(known)}")
    done = _recorded(given.json)
    for name in names:
        must, play = known[name]
        strike = done[name] = Strike(name, must)
        try:
            play(strike)
        except Exception as error:
            traceback.print_exc()
            strike.judge(f"{type(error).__name__}: {str(error)[:160]}", reached=False)
        where = machine("ray", "torch", "mujoco")
        strike.commit = where["git_commit"]
        print(f"{name}: {strike.measured} ({strike.reached})", flush=True)
        if given.json is not None:
            tree = [asdict(done[name]) for name in known if name in done]
            write_json(given.json, {"tool": "strikes", "machine": where, "strikes": tree})
    return int(any(done[name].reached is False for name in names))


def _recorded(file: Path | None) -> dict[str, Strike]:
    """Strikes that a file has already, by name; those struck again take their places."""
    if file is None or not file.exists():
        return {}
    return {each["name"]: Strike(**each) for each in json.loads(file.read_text())["strikes"]}


if __name__ == "__main__":
    raise SystemExit(main())
