"""Sphere: another object."""

from service.envs.task import Task

TASK = Task("Sphere", "a sphere of 5 cm instead of the cube", "mixed", {"object": "sphere"})
