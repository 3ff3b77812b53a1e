"""``tandem doctor``: what this machine and this installation have, and what to do about what is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from service.base.cores import usable_cores
from service.base.errors import TandemError
from service.base.version import __version__, git_commit
from service.cli.common import JsonOption, print_json, print_table

_EXTRAS = {
    "play": "viser", "serve": "fastapi", "cluster": "ray", "downstream": "stable_baselines3", "export": "onnx",
    "data": "minari", "pybullet": "pybullet", "franka": "franky",
}  # fmt: skip
"""Packages by the extras that bring them."""
_FOR_ROBOTS = ("pybullet", "franka")
"""Not advised: the first is compiled for long where it has no wheel, the second is for the machine of an arm."""
_LEAST_GB = 2.0
"""Of memory and of disk; a run of the recipe takes about half."""


def doctor(as_json: JsonOption = False) -> None:
    """Tell what this machine has for Tandem: versions, cores, OpenGL, memory, disk; and what is missing."""
    import torch

    threads = os.cpu_count() or 1
    missing = [extra for extra, package in _EXTRAS.items() if importlib.util.find_spec(package) is None]
    advised = [extra for extra in missing if extra not in _FOR_ROBOTS]
    memory_gb, disk_gb = _free_memory_gb(), shutil.disk_usage(Path.cwd()).free / 1e9
    rows = [
        ("tandem", f"{__version__}, commit {(git_commit() or 'unknown')[:12]}", ""),
        ("installed in", str(Path(__file__).parents[1]), ""),
        ("python", platform.python_version(), ""),
        *((name, version(name), "") for name in ("mujoco", "gymnasium", "numpy")),
        ("torch", f"{torch.__version__}, {'CUDA' if torch.cuda.is_available() else 'no CUDA'}", ""),
        ("extras", ", ".join(extra for extra in _EXTRAS if extra not in missing) or "none",
         f"for more: pip install 'tandem-skills[{','.join(advised)}]'" if advised else ""),
        ("system", platform.platform(), "" if platform.system() == "Linux" else "only Linux is tested"),
        ("cores", f"{usable_cores()} of {threads}", ""),
        ("free memory", f"{memory_gb:.1f} GB" if memory_gb < float("inf") else "unknown",
         "a run takes about 1 GB: end other programs" if memory_gb < _LEAST_GB else ""),
        ("free disk here", f"{disk_gb:.1f} GB", "a run takes up to 1 GB" if disk_gb < _LEAST_GB else ""),
        ("OpenGL", *_opengl()),
    ]  # fmt: skip
    if as_json:
        print_json([dict(zip(("what", "found", "to_do"), row, strict=True)) for row in rows])
    else:
        print_table(("what", "found", "to do"), rows)


def _opengl() -> tuple[str, str]:
    """Draw one picture."""
    from service.config import WorldConfig
    from service.envs.rendering.renderer import SceneRenderer

    try:
        SceneRenderer(WorldConfig(), 64, 64).close()
    except TandemError as error:
        return "no", str(error)
    return "draws", ""


def _free_memory_gb() -> float:
    """What Linux says is available; infinite where it is not known."""
    found = None
    with suppress(OSError):
        found = re.search(r"MemAvailable: *([0-9]+)", Path("/proc/meminfo").read_text(encoding="ascii"))
    return int(found[1]) / 1e6 if found is not None else float("inf")
