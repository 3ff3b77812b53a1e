"""The paper's six downstream tasks, and harder ones, as data on one world: what is replaced, and where goals are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from service.base.errors import TandemError, did_you_mean
from service.config import WorldConfig
from service.config.run import SUCCESS_DISTANCE_M as SUCCESS_DISTANCE_M
from service.config.task import EPISODE_STEPS as EPISODE_STEPS

if TYPE_CHECKING:
    from service.envs.sampling import GoalKind


@dataclass(frozen=True, slots=True)
class Task:
    """Random goals in a world, which differs from the one that primitives were trained in."""

    title: str
    """Name in the paper."""
    description: str
    """A few words on what it asks for."""
    goals: GoalKind
    world: Mapping[str, Any] = field(default_factory=dict)
    """Settings of a world that are replaced."""
    version: int = 1  # 0: other contacts (docs/decisions/0010), and Box with another rule of success (0007)
    """Version in its Gymnasium name; results of different ones are not compared."""

    @property
    def id(self) -> str:
        """Gymnasium name, such as ``tandem/InAir-v1``."""
        return f"tandem/{self.title}-v{self.version}"

    def world_from(self, world: WorldConfig) -> WorldConfig:
        """The world of this task, for primitives that were trained in ``world``."""
        tree = world.model_dump()
        for key, value in self.world.items():
            tree[key] = {**tree[key], **value} if isinstance(value, Mapping) else value
        return WorldConfig.model_validate(tree)


TASKS: Mapping[str, Task] = {
    "larger": Task(
        "Larger",
        "objects and goals in a larger workspace, 45 x 45 x 40 cm",
        "mixed",
        {"workspace": {"length_x_m": 0.45, "length_y_m": 0.45, "height_m": 0.40}},
    ),
    "inair": Task("InAir", "goals anywhere in the volume", "volume"),
    "push": Task("Push", "the gripper stays closed; goals on the table", "table", {"gripper": "blocked"}),
    "sphere": Task("Sphere", "a sphere of 5 cm instead of the cube", "mixed", {"object": "sphere"}),
    "wall": Task("Wall", "from one side of a wall to the other", "table", {"fixture": "wall", "start_height_m": 0.12}),
    "box": Task(
        "Box",
        "into an open box, which is elsewhere in every episode",
        "table",
        {"fixture": "box"},
    ),
}
"""The tasks by the names that commands take, in the paper's order. Reasons for the numbers: docs/decisions/0007."""

_HARDER: Mapping[str, Any] = {"start_height_m": 0.20, "object_mass_kg": 1.0, "friction": 0.25, "pad_friction": 0.5}
"""Start and cube of panda-gym 3.0.7, but for the cube's edge, 4 cm there. Its simulator multiplies two frictions: 0.5
of the cube by 0.5 of the table, and by 1 of the fingers. MuJoCo takes the greater one."""

HARD_TASKS: Mapping[str, Task] = {
    f"hard-{name}": replace(
        task,
        title=f"Hard{task.title}",
        description=f"{task.description}; a higher start, a heavy and slippery cube",
        world={**task.world, **_HARDER},
    )
    for name, task in TASKS.items()
    if name not in ("sphere", "wall")  # a hand-written policy fails in most episodes, so their difficulty is not known
}
"""Tasks in a harder world, where chance seldom finds the object: docs/decisions/0007."""


def find_task(name: str) -> Task:
    """Find a task, one of the paper's or a harder one, by its name.

    Raises:
        TandemError: no such task.
    """
    known = {**TASKS, **HARD_TASKS}
    if name not in known:
        raise TandemError(f"unknown task {name!r}; choose one of {', '.join(known)}{did_you_mean(name, known)}")
    return known[name]
