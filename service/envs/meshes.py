"""Meshes of the user's: measured and checked once, when they are described, and added to scenes."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from service.errors import ConfigError
from service.model_files import digest_of, model_file
from service.object_config import MeshConfig
from service.types import FloatArray

LEAST_M, MOST_M = 0.005, 0.5
"""Extents that an object may have."""
LEAST_CONVEX = 0.95
"""Share that a piece must have of the volume of its convex hull, which is what touches."""


def measure(mesh: MeshConfig) -> tuple[MeshConfig, tuple[float, float, float]]:
    """Read a mesh, and check that it can be an object.

    Returns:
        The mesh with what was read, and its extent along x, y and z, metres.

    Raises:
        ConfigError: a file that cannot be read, is not closed, not convex, or not of the size of an object.
    """
    digests, lower, upper, volume = [], np.full(3, np.inf), np.full(3, -np.inf), 0.0
    for name in mesh.pieces:
        digests.append(digest_of(name))
        vertices, own_volume = _read(name, mesh.scale)
        lower, upper = np.minimum(lower, vertices.min(axis=0)), np.maximum(upper, vertices.max(axis=0))
        volume += own_volume
    extent = upper - lower
    if not (extent.min() >= LEAST_M and extent.max() <= MOST_M):
        sizes = " x ".join(f"{each:.3g}" for each in extent)
        fitting = [mesh.scale * each for each in (1e-3, 1e3) if _fits(extent * each)]
        hint = f"; with scale: {fitting[0]:g} it would fit" if fitting else ""
        raise ConfigError(
            f"mesh {mesh.pieces[0]} is {sizes} m large, and objects have {LEAST_M:g} to {MOST_M:g} m: is its file in "
            f"other units?{hint}"
        )
    center = (lower + upper) / 2
    read = {"sha256": tuple(digests), "center_m": tuple(map(float, center)), "volume_m3": volume}
    x, y, z = map(float, extent)
    return mesh.model_copy(update=read), (x, y, z)


def _fits(extent: FloatArray) -> bool:
    return bool(extent.min() >= LEAST_M and extent.max() <= MOST_M)


def add_mesh(spec: mujoco.MjSpec, mesh: MeshConfig, mass_kg: float) -> list[dict[str, Any]]:
    """Add the pieces of a mesh to a scene under construction; returns the settings of a geom for each.

    Raises:
        ConfigError: a file is gone, or another than it was.
    """
    parts = []
    for index, (name, sha256) in enumerate(zip(mesh.pieces, mesh.sha256, strict=True)):
        file = str(model_file(name, sha256))
        spec.add_mesh(name=f"object{index}", file=file, scale=[mesh.scale] * 3)
        parts.append(
            {
                "type": mujoco.mjtGeom.mjGEOM_MESH,
                "meshname": f"object{index}",
                "pos": [-each for each in mesh.center_m],
                "density": mass_kg / mesh.volume_m3,
            }
        )
    return parts


def _read(name: str, scale: float) -> tuple[FloatArray, float]:
    """(V, 3) vertices, metres, and volume of a closed convex piece."""
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
    vertices: FloatArray = model.mesh_vert @ turned.reshape(3, 3).T + model.mesh_pos[0]
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
