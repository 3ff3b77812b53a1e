"""Descriptions of objects: their shape and size, as they lie on the table."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Tag, ValidationError, model_validator

from service.config.frozen import DESCRIBED, NAMED, FrozenModel
from service.config.model_files import LEAST_M, MeshConfig, Vector

Shape = Literal["box", "sphere", "cylinder", "capsule", "ellipsoid", "mesh"]
_NUM_SIZES: dict[Shape, tuple[int, str]] = {
    "box": (3, "its extent along x, y and z"),
    "sphere": (1, "its diameter"),
    "cylinder": (2, "its diameter and height"),
    "capsule": (2, "its diameter and whole length"),
    "ellipsoid": (3, "its extent along x, y and z"),
    "mesh": (3, "its extent along x, y and z, which is read from its files"),
}
_Share = Annotated[float, Field(ge=0.0, le=1.0)]
Color = tuple[_Share, _Share, _Share]
"""Red, green and blue."""
ROUND: frozenset[Shape] = frozenset({"sphere", "cylinder", "capsule", "ellipsoid", "mesh"})
"""Shapes that may roll."""


class ObjectConfig(FrozenModel):
    """A rigid object of one shape, as it starts: a cylinder stands, a capsule lies along x.

    The fingers close along y.
    """

    shape: Shape
    size_m: tuple[Annotated[float, Field(ge=0.005, le=0.5)], ...] = Field(
        description="box, ellipsoid: extent along x, y, z; sphere: diameter; cylinder: diameter, height; capsule: "
        "diameter, whole length"
    )
    mesh: MeshConfig | None = Field(None, description="files of a mesh; size_m is read from them")
    color: Color = Field((0.86, 0.13, 0.11), description="red, green, blue in pictures, 0 to 1")

    @model_validator(mode="after")
    def _fits_shape(self) -> Self:
        expected, what = _NUM_SIZES[self.shape]
        if len(self.size_m) != expected:
            raise ValueError(f"size_m of a {self.shape} has {expected} numbers, {what}; got {len(self.size_m)}")
        if self.shape == "mesh" and self.mesh is None:
            raise ValueError("shape: mesh needs its files, mesh: {pieces: [FILE]}")
        if self.shape != "mesh" and self.mesh is not None:
            raise ValueError(f"mesh belongs to shape: mesh, and this is a {self.shape}: leave one of them out")
        if self.shape == "capsule" and self.size_m[1] <= self.size_m[0]:
            raise ValueError(f"size_m of a capsule: its length {self.size_m[1]:g} must exceed its diameter")
        return self

    @property
    def extent_m(self) -> Vector:
        """Extent along x, y and z as it starts, metres."""
        first, *others = self.size_m
        if self.shape == "sphere":
            return first, first, first
        if self.shape == "cylinder":
            return first, first, others[0]
        if self.shape == "capsule":
            return others[0], first, first
        return first, others[0], others[1]


class FixtureConfig(ObjectConfig):
    """A thing that stands on the table and cannot be moved."""

    position_m: tuple[float, float] = Field(description="middle of its bottom, x and y")
    bottom_m: float = Field(0.0, ge=0.0, le=1.0, description="height of its bottom above the table: a shelf's")
    turn_rad: float = Field(0.0, description="about the vertical")
    color: Color = (0.42, 0.47, 0.54)

    def placed(self, side: Literal[1, -1]) -> tuple[object, ...]:
        """What it is and where it stands, or where its reflection in y would, to be compared; no mesh is its own."""
        (x, y), turn_rad = self.position_m, 0.0 if self.shape in ("sphere", "cylinder") else self.turn_rad
        half_turns = round(side * turn_rad / math.pi % 1.0, 9) % 1.0
        same = side if self.shape == "mesh" else 1
        return self.shape, self.size_m, round(x, 9), round(side * y, 9) + 0.0, self.bottom_m, half_turns, same

    @property
    def corners_m(self) -> tuple[Vector, Vector]:
        """Corners with the least and the greatest coordinates of the upright box around it, metres."""
        (x, y), (length, width, height) = self.position_m, self.extent_m
        cosine, sine = abs(math.cos(self.turn_rad)), abs(math.sin(self.turn_rad))
        half_x, half_y = (cosine * length + sine * width) / 2, (sine * length + cosine * width) / 2
        return (x - half_x, y - half_y, self.bottom_m), (x + half_x, y + half_y, self.bottom_m + height)


class ObstacleConfig(ObjectConfig):
    """A further thing that lies about on the table, elsewhere at every start, and can be pushed."""

    mass_kg: float = Field(0.1, gt=0.0, le=5.0)
    friction: float = Field(1.0, gt=0.0, le=3.0, description="sliding friction of it on the table and on other things")
    color: Color = (0.90, 0.66, 0.20)


class OneOfSeveralConfig(ObjectConfig):
    """An object with a goal, beside others."""

    mass_kg: float | None = Field(None, gt=0.0, le=5.0, description="None: ``object_mass_kg`` of the world")
    friction: float | None = Field(None, gt=0.0, le=3.0, description="None: that of the world")


COLORS: tuple[Color, ...] = ((0.86, 0.13, 0.11), (0.13, 0.36, 0.78), (0.18, 0.55, 0.27), (0.55, 0.30, 0.65))
"""Of objects that are only named, by their place: red, blue, green and purple."""


def simple_object(name: Literal["cube", "sphere"], size_m: float) -> ObjectConfig:
    """The description of a cube, by its edge, or of a sphere, by its diameter."""
    size = (size_m, size_m, size_m) if name == "cube" else (size_m,)
    return ObjectConfig.model_construct(shape="box" if name == "cube" else "sphere", size_m=size)


def _read_mesh(value: Any) -> Any:
    """A description of a mesh with what is read from its files, where that has not been done."""
    if not isinstance(value, dict) or value.get("shape") != "mesh":
        return value
    try:
        mesh = MeshConfig.model_validate(value.get("mesh"))
    except ValidationError:
        return {"size_m": (LEAST_M,) * 3, **value}  # what is wrong with it is said with its place
    if mesh.sha256:
        return value
    read, extent_m = mesh.measured()
    given = extent_m if value.get("size_m") is None else value["size_m"]
    numbers = isinstance(given, list | tuple) and all(isinstance(each, int | float) for each in given)
    if numbers and len(given) == len(extent_m) and not np.allclose(given, extent_m, rtol=1e-3):
        raise ValueError(
            f"size_m = {[*given]} of a mesh is read from its files, which have "
            f"{[round(each, 4) for each in extent_m]}: leave it out, or give null; mesh.scale changes it"
        )
    return {**value, "mesh": read, "size_m": given}


Object = Annotated[
    Annotated[Literal["cube", "sphere"], Tag(NAMED)] | Annotated[ObjectConfig, Tag(DESCRIBED)],
    Discriminator(lambda value: NAMED if isinstance(value, str) else DESCRIBED),
    BeforeValidator(_read_mesh),
]
"""A name, or a description."""
OneOfSeveral = Annotated[
    Annotated[Literal["cube", "sphere"], Tag(NAMED)] | Annotated[OneOfSeveralConfig, Tag(DESCRIBED)],
    Discriminator(lambda value: NAMED if isinstance(value, str) else DESCRIBED),
    BeforeValidator(lambda value: _read_mesh(value.model_dump() if isinstance(value, ObjectConfig) else value)),
]
"""The same; a description may have its own mass and friction."""
Fixture = Annotated[FixtureConfig, BeforeValidator(_read_mesh)]
Obstacle = Annotated[ObstacleConfig, BeforeValidator(_read_mesh)]
