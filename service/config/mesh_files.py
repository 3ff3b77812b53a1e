"""Files of meshes, measured and checked when an object is described by them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from service.base.errors import ConfigError
from service.base.types import StateArray
from service.config.model_files import digest_of, model_file

LEAST_M, MOST_M = 0.005, 0.5
"""Extents that an object may have."""
LEAST_CONVEX = 0.95
"""Share that a piece must have of the volume of its convex hull, which is what touches."""
Vector = tuple[float, float, float]


class Measured(NamedTuple):
    """A mesh of several files."""

    sha256: tuple[str, ...]
    """Of each file."""
    extent_m: Vector
    """Along x, y and z."""
    center_m: Vector
    """Middle of its extent, from its origin."""
    volume_m3: float


def measure(pieces: Sequence[str], scale: float) -> Measured:
    """Read a mesh, and check that it can be an object.

    Args:
        pieces: names of files, as for ``model_file``, each of one convex piece.
        scale: metres in a unit of the files.

    Raises:
        ConfigError: a file that cannot be read, is not closed, not convex, or not of the size of an object.
    """
    digests, lower, upper, volume = [], np.full(3, np.inf), np.full(3, -np.inf), 0.0
    for name in pieces:
        digests.append(digest_of(name))
        vertices, own_volume = _read(name, scale)
        lower, upper = np.minimum(lower, vertices.min(axis=0)), np.maximum(upper, vertices.max(axis=0))
        volume += own_volume
    extent = upper - lower
    if not _fits(extent):
        sizes = " x ".join(f"{each:.3g}" for each in extent)
        fitting = [scale * each for each in (1e-3, 1e3) if _fits(extent * each)]
        hint = f"; with scale: {fitting[0]:g} it would fit" if fitting else ""
        raise ConfigError(
            f"mesh {pieces[0]} is {sizes} m large, and objects have {LEAST_M:g} to {MOST_M:g} m: is its file in other "
            f"units?{hint}"
        )
    return Measured(tuple(digests), _vector(extent), _vector((lower + upper) / 2), volume)


def _fits(extent: StateArray) -> bool:
    return bool(extent.min() >= LEAST_M and extent.max() <= MOST_M)


def _vector(numbers: StateArray) -> Vector:
    x, y, z = map(float, numbers)
    return x, y, z


def _read(name: str, scale: float) -> tuple[StateArray, float]:
    """(V, 3) vertices, metres, and volume of a closed convex piece."""
    import mujoco  # only those who describe a mesh need it so early

    file = str(model_file(name))
    volumes = []
    for inertia in (mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT, mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX):
        spec = mujoco.MjSpec()
        spec.add_mesh(name="piece", file=file, scale=[scale] * 3, inertia=inertia)
        spec.worldbody.add_body(name="piece").add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname="piece", density=1000.0
        )
        try:
            model = spec.compile()
        except ValueError as error:
            raise ConfigError(f"mesh {name}: MuJoCo cannot use it: {' '.join(str(error).split())}") from None
        volumes.append(float(model.body("piece").mass[0]) / 1000.0)
    _check_closed(name, model.mesh_face)
    exact, convex = volumes
    if exact < LEAST_CONVEX * convex:
        raise ConfigError(
            f"mesh {name} fills {exact / convex:.0%} of its convex hull, and the hull is what touches: split it into "
            "convex pieces, a file each (for example with CoACD), and name them all"
        )
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, model.mesh_quat[0])
    vertices: StateArray = model.mesh_vert @ turned.reshape(3, 3).T + model.mesh_pos[0]
    return vertices, exact


def _check_closed(name: str, faces: Any) -> None:
    """Check that every edge has a triangle on either side."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if (num := int((counts != 2).sum())) > 0:
        raise ConfigError(
            f"mesh {name} is not closed: {num} of its {len(counts)} edges have not two triangles; repair it, for "
            "example in Blender (Mesh, Clean Up, Fill Holes)"
        )
