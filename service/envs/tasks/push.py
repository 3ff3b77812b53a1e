"""Push: without grasping."""

from service.envs.task import Task

TASK = Task("Push", "the gripper stays closed; goals on the table", "table", {"gripper": "blocked"})
