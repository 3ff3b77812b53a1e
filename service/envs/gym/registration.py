"""The Gymnasium names of the environments. Importing this module registers them.

Gymnasium 1.x loads no plug-ins by itself, so a program imports this module first, or lets ``make`` do it:
``gymnasium.make("service.envs.gym.registration:tandem/Tabletop-v1")``. ``gymnasium.make_vec`` of any of them makes a
``TabletopVectorEnv``, unless it is asked for ``vectorization_mode="sync"``.
"""

from __future__ import annotations

import gymnasium

from service.envs.tasks import EPISODE_STEPS, HARD_TASKS, TASKS

TABLETOP_ID = "tandem/Tabletop-v1"
_OPTIONS: dict[str, dict[str, str]] = {
    TABLETOP_ID: {},
    **{task.id: {"task": name} for name, task in {**TASKS, **HARD_TASKS}.items()},
}
for _name, _options in _OPTIONS.items():
    gymnasium.register(
        id=_name,
        entry_point="service.envs.gym.tabletop:TabletopEnv",
        vector_entry_point="service.envs.gym.vector:TabletopVectorEnv",
        max_episode_steps=EPISODE_STEPS,
        kwargs=_options,
    )
