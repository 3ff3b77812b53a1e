"""Box: into a box."""

from service.envs.task import Task

TASK = Task("Box", "into an open box, which is elsewhere in every episode", "table", {"fixture": "box"})
