"""The demo as a newcomer runs it: what becomes of it by seed, and what it costs that it is shown.

    python -m benchmarks.demo --seeds 40-44 --json docs/results/demo.json

The cost compares runs of one seed in turn: the recipe alone, and the demo with somebody who watches. That is a client
which takes all that a browser is sent, and draws nothing. The machine should do nothing else.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.measuring import ROOT, machine, one_line_errors, write_json
from benchmarks.training_process import scratch
from service.base.errors import TandemError
from service.base.jsonl import read_jsonl
from service.runs.grid import parse_seeds

FROM, TO = 150_000, 710_000
"""Env steps between which the cost is measured: the viewer is up, and then 100 updates are made."""
_ADDRESS = re.compile(r"watch it at http://([\d.]+:\d+)")
_MIXED = "evaluation/mixed_success_last"


def tandem(home: Path, *words: str) -> subprocess.Popen[str]:
    """Start a command in a directory; its output is one stream of text."""
    return subprocess.Popen(
        [sys.executable, "-m", "service", *words], cwd=home, env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def lines_of(process: subprocess.Popen[str]) -> Iterator[str]:
    """What it prints, until it ends.

    Raises:
        TandemError: it fails.
    """
    assert process.stdout is not None
    said = ""
    for said in process.stdout:
        yield said
    if process.wait() != 0:
        raise TandemError(f"{process.args!r}: ended with {process.returncode}: {said.strip()}")


@contextmanager
def watching(sizes: list[int]) -> Iterator[Callable[[str], None]]:
    """Give a function that takes what the live world at an address sends, in a thread, and notes the sizes.

    A world moves for those whose camera it knows, so that is sent.
    """
    import msgspec.msgpack
    from viser import __version__ as viser_version
    from viser._messages import ViewerCameraMessage
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    camera = msgspec.msgpack.encode(
        ViewerCameraMessage(
            wxyz=(1.0, 0.0, 0.0, 0.0), position=(1.0, 0.0, 1.0), fov=0.75, near=0.1, far=10.0,
            image_height=540, image_width=960, look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 0.0, 1.0),
        ).as_serializable_dict()
    )  # fmt: skip
    ended, protocol = threading.Event(), Subprotocol(f"viser-v{viser_version}")

    def take(address: str) -> None:
        while not ended.is_set():
            try:
                with connect(f"ws://{address}", subprotocols=[protocol], max_size=None) as socket:
                    socket.send(camera)
                    while not ended.is_set():
                        sizes.append(len(socket.recv(timeout=1.0)))
            except (OSError, WebSocketException):  # not yet up, quiet for a second, or gone
                time.sleep(0.2)

    try:
        yield lambda address: threading.Thread(target=take, args=(address,), daemon=True).start()
    finally:
        ended.set()


def run_seed(seed: int) -> dict[str, Any]:
    """Run the demo with the live world and nobody who looks; for JSON."""
    with scratch() as home:
        begun_s = time.monotonic()
        said = list(lines_of(tandem(home, "demo", "--seed", str(seed), "--run-dir", "demo")))
        rows = read_jsonl(home / "demo" / "metrics.jsonl")
        status = json.loads((home / "demo" / "status.json").read_text())
        curve = [[row["time/wall_s"], row["env_steps"], row[_MIXED]] for row in rows if _MIXED in row]
        return {
            "seed": seed,
            "made_it": status["state"] == "converged",
            "minutes": round((time.monotonic() - begun_s) / 60, 2),
            "learning_minutes": round(rows[-1]["time/wall_s"] / 60, 2),
            "env_steps": rows[-1]["env_steps"],
            "said": next(line.strip() for line in said if "random goals" in line or "are over" in line),
            "curve": curve,
        }


def seconds_between(*words: str, watched: bool) -> float:
    """Seconds of a run from ``FROM`` to ``TO`` env steps.

    Raises:
        TandemError: the live world sent next to nothing to who watches.
    """
    sizes = list[int]()
    with scratch() as home, watching(sizes) as begin:
        for line in lines_of(tandem(home, *words, "--run-dir", "run")):
            if watched and (found := _ADDRESS.search(line)):
                begin(found[1])
        rows = read_jsonl(home / "run" / "metrics.jsonl")
        if watched and len(sizes) < 100:
            raise TandemError(f"the live world sent {len(sizes)} messages")
        times = [next(row["time/wall_s"] for row in rows if row["env_steps"] >= steps) for steps in (FROM, TO)]
        return float(times[1] - times[0])


def cost(seed: int, pairs: int) -> dict[str, Any]:
    """Seconds of the recipe alone and of the demo that is watched, in turn; for JSON."""
    plain, shown = [], []
    for _ in range(pairs):
        budget = f"run.total_env_steps={TO + 10_000}"
        alone = ("train", "panda-cube", "--no-publish", "--set", f"seed={seed}", "--set", budget)
        plain.append(seconds_between(*alone, watched=False))
        demo = ("demo", "--seed", str(seed), "--env-steps", str(TO + 10_000))
        shown.append(seconds_between(*demo, watched=True))
        print(f"{plain[-1]:.1f} s alone, {shown[-1]:.1f} s watched", flush=True)
    return {"seed": seed, "from": FROM, "to": TO, "alone_s": plain, "watched_s": shown}


@one_line_errors
def main() -> int:
    """Entry point of ``python -m benchmarks.demo``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="40-44")
    parser.add_argument("--pairs", type=int, default=2, help="of runs whose speeds are compared")
    parser.add_argument("--json", type=Path, required=True)
    given = parser.parse_args()
    before = json.loads(given.json.read_text()) if given.json.exists() else {"runs": []}
    result: dict[str, Any] = {"benchmark": "demo", "machine": machine(), **before}
    for seed in parse_seeds(given.seeds):
        if seed not in [run["seed"] for run in result["runs"]]:
            result["runs"].append(run_seed(seed))
            print(json.dumps({key: value for key, value in result["runs"][-1].items() if key != "curve"}), flush=True)
            write_json(given.json, result)
    if "cost" not in result and given.pairs:
        result["cost"] = cost(parse_seeds(given.seeds)[0], given.pairs)
        write_json(given.json, result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
