"""InAir: goals anywhere in the volume."""

from service.envs.task import Task

TASK = Task("InAir", "goals anywhere in the volume", "volume")
