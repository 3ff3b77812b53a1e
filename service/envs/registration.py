"""The Gymnasium names of the environments. Importing this module registers them.

Gymnasium 1.x loads no plug-ins by itself, so a program imports this module first, or lets ``make`` do it:
``gymnasium.make("service.envs.registration:tandem/Tabletop-v0")``.
"""

from __future__ import annotations

import gymnasium

TABLETOP_ID = "tandem/Tabletop-v0"
EPISODE_STEPS = 50
"""Steps of an episode (paper: 50)."""


def register_all() -> None:
    """Register every environment; a second call changes nothing."""
    if TABLETOP_ID not in gymnasium.registry:
        gymnasium.register(
            id=TABLETOP_ID, entry_point="service.envs.tabletop:TabletopEnv", max_episode_steps=EPISODE_STEPS
        )


register_all()
