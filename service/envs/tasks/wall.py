"""Wall: over a wall."""

from service.envs.task import Task

TASK = Task("Wall", "from one side of a wall to the other", "table", {"fixture": "wall", "start_height_m": 0.12})
