"""The configuration of a world: robot, table, object, workspace, and ranges of what is not known exactly."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from service.config.frozen import BUILT_IN, DESCRIBED, FrozenModel
from service.config.objects import (
    COLORS,
    Fixture,
    Object,
    Obstacle,
    ObstacleConfig,
    OneOfSeveral,
    OneOfSeveralConfig,
    simple_object,
)
from service.config.recipes import robots
from service.config.robot import RobotConfig, read_robot

Point = tuple[float, float, float]
"""x, y, z in the world frame."""
Range = tuple[float, float]
"""Least and greatest value, all in between alike."""
_LIMITS = {
    "object_size": (0.2, 3.0),
    "object_mass_kg": (1e-3, 10.0),
    "friction": (0.01, 5.0),
    "gain": (0.05, 20.0),
    "damping": (0.05, 20.0),
    "table_height_m": (-0.05, 0.05),
    "delay_steps": (0, 8),
    "object_noise_m": (0.0, 0.1),
    "object_offset_m": (0.0, 0.1),
}
"""Within which a range has to be, by its name."""
_LOWEST = {"table_height_m": 0.0, "object_size": 1.0}
"""What the lowest place of an object depends on, and what it is without a range."""


class WorkspaceConfig(FrozenModel):
    """The box in which goals are valid. Origin of the world: the table top, before the robot's base (Panda: 0.6 m)."""

    center_x_m: float = Field(-0.05, ge=-0.3, le=0.2, description="-0.05 keeps the downstream Larger task reachable")
    center_y_m: float = Field(0.0, ge=-0.3, le=0.3, description="its middle, to the left of the robot")
    length_x_m: float = Field(0.35, gt=0.0, le=0.8, description="paper: 35 cm")
    length_y_m: float = Field(0.35, gt=0.0, le=0.8, description="paper: 35 cm")
    height_m: float = Field(0.35, gt=0.0, le=0.8, description="paper: 35 cm")

    @property
    def lower_m(self) -> Point:
        """Corner with the least coordinates, metres; the box stands on the table top."""
        return self.center_x_m - self.length_x_m / 2, self.center_y_m - self.length_y_m / 2, 0.0

    @property
    def upper_m(self) -> Point:
        """Corner with the greatest coordinates, metres."""
        return self.center_x_m + self.length_x_m / 2, self.center_y_m + self.length_y_m / 2, self.height_m


class ObservedConfig(FrozenModel):
    """Entries of observations beyond the paper's: inputs of every policy, so they belong to what is published."""

    num_commands: int = Field(
        0,
        ge=0,
        le=8,
        description="last commands of its own that a policy sees, the newest first; 0 in the paper. With late "
        "observations or a slow arm, positions alone do not say what is still under way",
    )
    delay: bool = Field(
        False,
        description="policies see by how many control steps their commands are late; tandem robot run gives them the "
        "delay of the observation instead",
    )
    obstacles: bool = Field(False, description="whether policies see where the middle of each of world.obstacles is")


class RandomisationConfig(FrozenModel):
    """Each start of a world draws anew, where there is a range; None leaves what the world says.

    What is part of the physics comes from a bank of models, made once, that cover the ranges evenly.
    """

    num_models: int = Field(
        32, ge=1, le=1024, description="in the bank; more cover the ranges more densely, and 64 cost 5 % of throughput"
    )
    object_size: Range | None = Field(None, description="factor of all sizes of the object")
    object_mass_kg: Range | None = Field(None, description="mass of the object; of several of those without their own")
    friction: Range | None = Field(
        None,
        description="sliding friction of the object, also on the table; of several of those without their own",
    )
    gain: Range | None = Field(None, description="factor of the stiffness of the arm's servos")
    damping: Range | None = Field(
        None, description="factor of their damping; of the Panda's 0.4 to 1.7 cover 100 to 40 % of a step of 5 cm"
    )
    table_height_m: Range | None = Field(None, description="of the table and of what stands on it, above where it is")
    delay_steps: tuple[int, int] | None = Field(
        None, description="control steps until an action counts, drawn by game; let policies see as many commands"
    )
    object_noise_m: Range | None = Field(
        None, description="standard deviation of an object's seen position, each axis and step anew"
    )
    object_offset_m: Range | None = Field(
        None, description="length of an error of its seen position that stays for a game; its direction is any"
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        for name, (least, most) in _LIMITS.items():
            if (given := getattr(self, name)) is None:
                continue
            low, high = given
            if low > high:
                raise ValueError(f"{name} = [{low:g}, {high:g}] is the wrong way round: give the lesser number first")
            if low < least or high > most:
                raise ValueError(f"{name} = [{low:g}, {high:g}] goes beyond [{least:g}, {most:g}]")
        return self

    @property
    def model_ranges(self) -> dict[str, Range]:
        """Those of the physics, by name."""
        names = ("object_size", "object_mass_kg", "friction", "gain", "damping", "table_height_m")
        return {name: given for name in names if (given := getattr(self, name)) is not None}


def _read_robot(value: Any) -> Any:
    return read_robot(robots().get(value, Path(value))) if isinstance(value, str) and value != "panda" else value


Robot = Annotated[
    Annotated[Literal["panda"], Tag(BUILT_IN)] | Annotated[RobotConfig, Tag(DESCRIBED)],
    Discriminator(lambda value: BUILT_IN if isinstance(value, str) else DESCRIBED),
    BeforeValidator(_read_robot),
]


class WorldConfig(FrozenModel):
    """The MuJoCo world: robot, table, rigid objects."""

    robot: Robot = Field(
        "panda",
        description="panda, a name of tandem configs, or a YAML file with a description of yours (docs/robots.md)",
    )
    object: Object = Field("cube", description="cube, sphere, or a description: shape, size_m, color (docs/objects.md)")
    objects: tuple[OneOfSeveral, ...] = Field(
        (),
        max_length=len(COLORS),
        description="in place of object, several that each have a goal: cube, sphere, or a description, also of its "
        "mass_kg and friction (docs/objects.md)",
    )
    object_size_m: float = Field(
        0.05, ge=0.02, le=0.07, description="cube edge or sphere diameter; paper: 5 cm. A description has its own"
    )
    object_mass_kg: float = Field(0.1, gt=0.0, le=5.0, description="mass of an object without its own")
    friction: float = Field(1.0, gt=0.0, le=3.0, description="sliding friction of the object, also on the table")
    pad_friction: float = Field(1.0, gt=0.0, le=3.0, description="sliding friction of the fingertips on the object")
    gripper: Literal["free", "blocked"] = Field("free", description="blocked: held closed, whatever the action says")
    fixture: Literal["none", "wall", "box"] = Field(
        "none", description="what stands on the table besides the object; docs/decisions/0007 has its geometry"
    )
    fixtures: tuple[Fixture, ...] = Field(
        (), max_length=20, description="further things on the table that cannot be moved (docs/objects.md)"
    )
    obstacles: tuple[Obstacle, ...] = Field(
        (),
        max_length=8,
        description="further objects that lie about on the table and can be pushed (docs/objects.md)",
    )
    workspace: WorkspaceConfig = WorkspaceConfig()
    observed: ObservedConfig = ObservedConfig()
    randomisation: RandomisationConfig = RandomisationConfig()
    start_height_m: float = Field(
        0.08,
        ge=0.08,
        le=0.4,
        description="end effector at reset, above the workspace's centre; low, so that chance finds the object",
    )
    physics_step_s: float = Field(0.002, gt=0.0, le=0.01, description="time of one step of the physics")
    num_substeps: int = Field(20, ge=1, le=200, description="physics steps per action; 20 x 2 ms = 25 Hz as panda-gym")

    @model_validator(mode="before")
    @classmethod
    def _complete_objects(cls, values: Any) -> Any:
        """Keep a list of one as the one object; give descriptions of several a color, as to a name."""
        objects = values.get("objects") if isinstance(values, Mapping) else None
        if not isinstance(objects, list | tuple) or values.get("object", "cube") != "cube":
            return values
        rest = {key: value for key, value in values.items() if key != "objects"}
        if len(objects) != 1:
            filled = [
                {"color": color, **each} if isinstance(each, Mapping) else each
                for each, color in zip(objects, cycle(COLORS), strict=False)
            ]
            return {**rest, "objects": filled}
        (only,) = objects
        if isinstance(only, OneOfSeveralConfig):
            only = only.model_dump()
        if not isinstance(only, Mapping):
            return {**rest, "object": only}
        apart = {"mass_kg": "object_mass_kg", "friction": "friction"}
        given = {apart[key]: value for key, value in only.items() if key in apart and value is not None}
        return {**rest, **given, "object": {key: value for key, value in only.items() if key not in apart}}

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.fixtures and self.fixture != "none":
            raise ValueError(f"fixture = {self.fixture!r} and fixtures: a world has the one or the other")
        if self.objects and self.object != "cube":
            raise ValueError(f"object = {self.object!r} and objects: a world has the one or the other")
        if self.num_objects > 1 and self.fixture != "none":
            raise ValueError(
                f"fixture = {self.fixture!r} and {self.num_objects} objects: it is for one; take one, or describe it "
                "in fixtures of a world of your own"
            )
        if self.observed.obstacles and not self.obstacles:
            raise ValueError("observed.obstacles, and no obstacles: describe some, or leave it out")
        lowest_m, smallest = self._lowest
        if lowest_m + (rest_m := smallest * min(self.rest_heights_m)) < 0.0:
            raise ValueError(
                f"randomisation.table_height_m begins at {lowest_m:g}: the centre of the smallest object would lie "
                f"below z = 0, where the workspace begins; let it begin at {-rest_m:g} or higher"
            )
        if (highest_m := max(self.rest_heights_m)) >= self.workspace.height_m:
            raise ValueError(
                f"the object's centre lies {highest_m:g} m high, and the workspace ends at "
                f"{self.workspace.height_m:g} m, so no goal is in it: raise workspace.height_m, or lower the object"
            )
        return self

    @property
    def step_s(self) -> float:
        """Time of an env step."""
        return self.physics_step_s * self.num_substeps

    @property
    def num_objects(self) -> int:
        """K, objects that have goals."""
        return len(self.objects) or 1

    @property
    def num_observed_obstacles(self) -> int:
        """Number of obstacles whose positions policies see."""
        return len(self.obstacles) if self.observed.obstacles else 0

    @property
    def nominal(self) -> WorldConfig:
        """The same world as it says, nothing drawn; policies see what they saw."""
        return self.model_copy(update={"randomisation": RandomisationConfig()})

    @property
    def usual_goals(self) -> Literal["mixed", "table"]:
        """Random goals on which a policy is tried where nothing else is asked."""
        return "mixed" if self.fixture == "none" else "table"

    @property
    def is_symmetric(self) -> bool:
        """Whether its reflection in y is the same world, so that what is learned on one side holds on the other."""
        as_they_are, reflected = ({each.placed(side) for each in self.fixtures} for side in (1, -1))
        base_y_m = 0.0 if isinstance(self.robot, str) else self.robot.base_position_m[1]
        meshes = any(each.shape == "mesh" for each in (*self.bodies, *self.obstacles))  # none is its own reflection
        return self.workspace.center_y_m == base_y_m == 0.0 and as_they_are == reflected and not meshes

    @property
    def num_kept_commands(self) -> int:
        """Last commands that a world remembers: those that are seen, and those that do not count yet."""
        return max(self.observed.num_commands, (self.randomisation.delay_steps or (0, 0))[1])

    @property
    def bodies(self) -> tuple[ObstacleConfig, ...]:
        """The K objects that have goals: shape, size, mass and friction of each."""
        found = []
        for given, color in zip(self.objects or (self.object,), COLORS, strict=False):
            shape = simple_object(given, self.object_size_m) if isinstance(given, str) else given
            own_mass_kg, own_friction = (getattr(shape, name, None) for name in ("mass_kg", "friction"))
            body = ObstacleConfig.model_construct(
                shape=shape.shape,
                size_m=shape.size_m,
                mesh=shape.mesh,
                color=color if isinstance(given, str) else shape.color,
                mass_kg=self.object_mass_kg if own_mass_kg is None else own_mass_kg,
                friction=self.friction if own_friction is None else own_friction,
            )
            found.append(body)
        return tuple(found)

    @property
    def shape(self) -> ObstacleConfig:
        """The first object's shape and size."""
        return self.bodies[0]

    @property
    def rest_heights_m(self) -> tuple[float, ...]:
        """(K,) height of each object's centre as it lies on the table."""
        return tuple(body.extent_m[2] / 2 for body in self.bodies)

    @property
    def lowest_heights_m(self) -> tuple[float, ...]:
        """(K,) least height of each object's centre: the smallest one, on its flattest side, on the lowest table."""
        lowest_m, smallest = self._lowest
        return tuple(lowest_m + smallest * min(body.extent_m) / 2 for body in self.bodies)

    @property
    def _lowest(self) -> tuple[float, float]:
        """Height of the lowest table, metres, and size of the smallest object, as a share of what is described."""
        ranges = self.randomisation.model_ranges
        lowest_m, smallest = (ranges.get(name, (usual,))[0] for name, usual in _LOWEST.items())
        return lowest_m, smallest

    @property
    def rest_height_m(self) -> float:
        """Height of the first object's centre as it lies on the table."""
        return self.rest_heights_m[0]
