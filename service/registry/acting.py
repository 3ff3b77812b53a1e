"""What is read of a published configuration: how its policy acts and is evaluated, and nothing else.

So versions that any tandem has published load for ever, whatever keys learning has had.
"""

from __future__ import annotations

from typing import Any

from service.config import Config, parse_config
from service.config.tree import group_of

ACTING = (
    "name",
    "world",
    "policy",
    "game.success_distance_m",
    "game.bob_steps",
    "game.bob_hold_steps",
    "skills.method",
    "skills.size",
    "skills.episode_steps",
    "skills.hidden_sizes",
    "skills.sac.hidden_sizes",
    "run.evaluation_steps",
)
"""Keys of a published configuration that are read; versions of before must have them by these names."""


def acting_config(tree: dict[str, Any], *, where: str) -> Config:
    """Read how a policy acts and is evaluated from a configuration that any version recorded.

    Only ``ACTING`` is read. All else has its defaults, since it may be of a version with other keys.

    Raises:
        ConfigError: a value of ``ACTING`` that no version has written.
    """
    acting: dict[str, Any] = {}
    for key in ACTING:
        *groups, last = key.split(".")
        found: Any = tree
        for name in groups:
            found = found.get(name) if isinstance(found, dict) else None
        if isinstance(found, dict) and last in found:
            group, name = group_of(acting, key, where=where)
            group[name] = found[last]
    if "skills" in acting:
        acting["method"] = "skills"
        acting.pop("policy", None)
        acting.pop("game", None)
    return parse_config(acting, where=where)
