"""Meshes of the user's in scenes."""

from __future__ import annotations

from typing import Any

import mujoco

from service.model_files import model_file
from service.object_config import MeshConfig


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
