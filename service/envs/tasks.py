"""The paper's six downstream tasks, as data on one world: what of the world is replaced, and where goals are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from service.config import WorldConfig
from service.envs.goals import GoalKind
from service.errors import TandemError


@dataclass(frozen=True, slots=True)
class Task:
    """Random goals in a world, which differs from the one that primitives were trained in."""

    title: str
    """Name in the paper."""
    description: str
    """A few words on what it asks for."""
    goals: GoalKind
    air_share: float
    """The paper's p: share of goals that are drawn anywhere in the volume; the others lie on the table."""
    world: Mapping[str, Any] = field(default_factory=dict)
    """Settings of a world that are replaced."""
    version: int = 0
    """Version in its Gymnasium name; results of different ones are not compared."""

    @property
    def id(self) -> str:
        """Gymnasium name, such as ``tandem/InAir-v0``."""
        return f"tandem/{self.title}-v{self.version}"

    def world_from(self, world: WorldConfig) -> WorldConfig:
        """The world of this task, for primitives that were trained in ``world``."""
        tree = world.model_dump()
        for key, value in self.world.items():
            tree[key] = {**tree[key], **value} if isinstance(value, Mapping) else value
        return WorldConfig.model_validate(tree)


SUCCESS_DISTANCE_M = 0.05
"""Greatest distance from object to goal that counts as success, in every task (paper)."""

TASKS: Mapping[str, Task] = {
    "larger": Task(
        "Larger",
        "objects and goals in a larger workspace, 45 x 45 x 40 cm",
        "mixed",
        0.7,
        {"workspace": {"length_x_m": 0.45, "length_y_m": 0.45, "height_m": 0.40}},
    ),
    "inair": Task("InAir", "goals anywhere in the volume", "volume", 1.0),
    "push": Task("Push", "the gripper stays closed; goals on the table", "table", 0.0, {"gripper": "blocked"}),
    "sphere": Task("Sphere", "a sphere of 5 cm instead of the cube", "mixed", 0.7, {"object": "sphere"}),
    "wall": Task(
        "Wall",
        "from one side of a wall to the other",
        "table",
        0.0,
        {"fixture": "wall", "start_height_m": 0.12},
    ),
    "box": Task(
        "Box",
        "into an open box, which is elsewhere in every episode",
        "table",
        0.0,
        {"fixture": "box"},
        version=1,  # 0: a goal 5 mm higher, reached with the object's underside up to 5 mm above the rim
    ),
}
"""The tasks by the names that commands take, in the paper's order. Reasons for the numbers: docs/decisions/0007."""


def find_task(name: str) -> Task:
    """Find a task by its name.

    Raises:
        TandemError: no such task.
    """
    if name not in TASKS:
        raise TandemError(f"unknown task {name!r}; choose one of {', '.join(TASKS)}")
    return TASKS[name]
