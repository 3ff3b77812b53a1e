"""Meshes of the user's in scenes."""

from __future__ import annotations

from typing import Any

import mujoco

from service.config.mesh_files import Vector
from service.config.model_files import model_file
from service.config.objects import MeshConfig


def add_mesh(spec: mujoco.MjSpec, mesh: MeshConfig, name: str, mass_kg: float) -> list[dict[str, Any]]:
    """Add the pieces of a mesh to a scene under construction; returns the settings of a geom for each.

    Raises:
        ConfigError: a file is gone, or another than it was.
    """
    parts = []
    for index, (piece, sha256) in enumerate(zip(mesh.pieces, mesh.sha256, strict=True)):
        spec.add_mesh(name=f"{name}{index}", file=str(model_file(piece, sha256)), scale=[mesh.scale] * 3)
        parts.append(
            {
                "type": mujoco.mjtGeom.mjGEOM_MESH,
                "meshname": f"{name}{index}",
                "pos": [-each for each in mesh.center_m],
                "density": mass_kg / mesh.volume_m3,
            }
        )
    return parts


def center_of_mass(mesh: MeshConfig) -> Vector:
    """Center of mass of a mesh, as dense everywhere, from the middle of its extent, metres.

    Raises:
        ConfigError: a file is gone, or another than it was.
    """
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="mesh")
    for part in add_mesh(spec, mesh, "piece", 1.0):
        body.add_geom(**part)
    x, y, z = map(float, spec.compile().body("mesh").ipos)
    return x, y, z
