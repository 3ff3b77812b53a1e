"""Functions of ``service`` between the command and the first gradient step: on the stack, and entered before it.

    python -m benchmarks.first_step

The same program counts in another commit, where ``PYTHONPATH`` names its checkout. The stack of a learning thread goes
on with that of the main thread. The result is a line of JSON.
"""

from __future__ import annotations

import inspect
import json
import sys
import tempfile
import threading
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ARGUMENTS = (
    "pretrain --no-publish --quiet --set run.total_env_steps=3000 --set game.num_worlds=24"
    " --set learner.alice.minibatch_size=256 --set run.num_threads=1"
)


class _Reached(BaseException):
    """The first gradient step."""


def measure() -> dict[str, Any]:
    """Train until the first Adam step, and count."""
    import service

    root = str(Path(service.__file__).parent)
    entered: set[CodeType] = set()
    found: dict[str, Any] = {}

    def is_ours(code: CodeType) -> bool:
        return (
            code.co_filename.startswith(root) and bool(code.co_flags & inspect.CO_OPTIMIZED) and code.co_name[0] != "<"
        )

    def stack(frame: FrameType | None) -> list[str]:
        names = []
        while frame is not None:
            if is_ours(frame.f_code):
                names.append(f"{Path(frame.f_code.co_filename).stem}.{frame.f_code.co_qualname}")
            frame = frame.f_back
        return names

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        if event != "call" or found or not is_ours(frame.f_code):
            return
        entered.add(frame.f_code)
        if frame.f_code.co_qualname == "Adam.step":
            main = sys._current_frames()[threading.main_thread().ident or 0]
            own = threading.current_thread() is threading.main_thread()
            names = stack(frame) + ([] if own else stack(main))
            found.update(stack=names, num_on_stack=len(names), num_entered=len(entered))
            raise _Reached

    with tempfile.TemporaryDirectory() as home:
        sys.argv = ["tandem", *ARGUMENTS.split(), "--run-dir", f"{home}/run", "--registry", f"{home}/registry"]
        from service.cli.main import main

        threading.setprofile(profile)
        sys.setprofile(profile)
        try:
            main()
        except BaseException:  # whatever the command makes of it
            pass
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return found


if __name__ == "__main__":
    print(json.dumps(measure()))
