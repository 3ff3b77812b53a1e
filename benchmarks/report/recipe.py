"""Times to a skill: whether their recipe is the one that ships, and what a page may say of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.measuring import RECIPE_FILE
from benchmarks.report.markdown import commit
from service.base.errors import TandemError
from service.config import load_config
from service.config.self_play import SelfPlayConfig
from service.config.tree import leaves

SHIPPED = "the shipped recipe"
_OF_ONE_RUN = ("name", "seed", "run.")
"""Keys that may differ between two runs of the same recipe."""
_GONE = {"generator": {"replay_over_cells": False}}
"""Keys that are gone and did something, with the values by which they did nothing."""


def differences(recorded: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Keys by which a recorded configuration differs from the shipped recipe, with its value and the recipe's.

    Keys that are newer than the recorded file have their defaults.
    """
    mine = dict(leaves(_tree(recorded)))
    ships = dict(leaves(_tree(load_config(RECIPE_FILE).model_dump(mode="json"))))
    return {
        key: (mine.get(key), ships.get(key))
        for key in sorted({*mine, *ships})
        if mine.get(key) != ships.get(key) and not key.startswith(_OF_ONE_RUN)
    }


def recipe_words(study: Mapping[str, Any]) -> str:
    """Which recipe a time to a skill was measured with, and when."""
    when = ", ".join(sorted({run["machine"]["time"][:10] for run in study["runs"]}))
    where = ", ".join(sorted({commit(run["machine"]["git_commit"]) for run in study["runs"]}))
    differing = differences(study["settings"]["recipe"])
    if not differing:
        return f"Measured on {when}, {where}, with {SHIPPED}."
    keys = ", ".join(f"`{key}` {had} (today {ships})" for key, (had, ships) in differing.items())
    return f"Measured on {when}, {where}. **The recipe was another one than today's**: {keys}."


def check_words(path: Path, page: str, study: Mapping[str, Any]) -> None:
    """Refuse a page that calls the recipe of a study the shipped one, where it is another."""
    if SHIPPED in " ".join(page.lower().split()) and (differing := differences(study["settings"]["recipe"])):
        raise TandemError(
            f"{path}: it says {SHIPPED!r}, but what it shows was recorded with another {', '.join(differing)}; "
            "record it anew, or say which recipe it was"
        )


def _tree(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """The recorded values of today's keys and of ``_GONE``; others that are gone did nothing in what is compared."""
    today = SelfPlayConfig().model_dump(mode="json")
    return _filled(today | {room: today[room] | keys for room, keys in _GONE.items()}, recorded)


def _filled(defaults: Mapping[str, Any], recorded: Mapping[str, Any]) -> dict[str, Any]:
    found = dict(defaults)
    for key in defaults.keys() & recorded.keys():
        both = isinstance(defaults[key], dict) and isinstance(recorded[key], dict)
        found[key] = _filled(defaults[key], recorded[key]) if both else recorded[key]
    return found
