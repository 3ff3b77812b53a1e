"""The Gymnasium names of the environments. Importing this module registers them.

Gymnasium 1.x loads no plug-ins by itself, so a program imports ``tandem_skills`` first, or lets ``make`` do it:
``gymnasium.make("tandem_skills:tandem/Tabletop-v1")``. ``gymnasium.make_vec`` of any of them makes a
``TabletopVectorEnv``, unless it is asked for ``vectorization_mode="sync"``.
"""

from __future__ import annotations

import gymnasium

from service.envs.task import Task
from service.envs.tasks import TASKS, find_task

TABLETOP_ID = "tandem/Tabletop-v1"
for _task in [Task("Tabletop"), *map(find_task, TASKS)]:
    gymnasium.register(
        id=_task.id,
        entry_point="service.envs.gym.tabletop:TabletopEnv",
        vector_entry_point="service.envs.gym.vector:TabletopVectorEnv",
        max_episode_steps=_task.episode_steps if _task.name else None,  # one of a user's may be longer
        kwargs={"registered": _task.name} if _task.name else {},
    )
