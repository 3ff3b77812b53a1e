"""Files of models that descriptions name: where they are, whether they are still those that were described; meshes."""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import Field

from service.base.errors import ConfigError
from service.base.files import read_regular
from service.base.types import StateArray
from service.config.frozen import FrozenModel

MAX_BYTES = 64 * 1024 * 1024
"""Most bytes of a file; usual are some ten thousand."""
PACKAGE = "package:"
"""Begins the name of a file in a Python package."""
LEAST_M, MOST_M = 0.005, 0.5
"""Extents that an object may have."""
_WELD = 1e-5
"""Of the extent of a mesh: vertices so near to one another are at one place."""
_USUAL_M = 0.05
"""Extent of an object that is neither large nor small."""
LEAST_CONVEX = 0.95
"""Share that a piece must have of the volume of its convex hull, which is what touches."""
Vector = tuple[float, float, float]


def model_file(name: str, sha256: str | None = None) -> Path:
    """The file that a description names as its model.

    Args:
        name: an absolute path, or ``package:NAME/FILE``.
        sha256: digest that it must have.

    Raises:
        ConfigError: no such file or package, or one that has changed.
    """
    path = Path(name)
    if name.startswith(PACKAGE):
        package, _, rest = name.removeprefix(PACKAGE).partition("/")
        found = find_spec(package) if package.isidentifier() else None
        if found is None or not found.submodule_search_locations:
            raise ConfigError(
                f"model {name}: no Python package {package!r} is installed here; tandem configs says how to install "
                "what its robots need"
            )
        path = Path(found.submodule_search_locations[0]) / rest
    if sha256 is not None and (digest := file_digest(name)) != sha256:
        raise ConfigError(
            f"model {name} is not the one that was described: sha256 {digest[:12]}, not {sha256[:12]}; "
            "put that file back, or begin a new run"
        )
    return path


def absolute(name: str, directory: Path) -> str:
    """A file's name that means the same from everywhere; a relative one is from ``directory``."""
    return name if name.startswith(PACKAGE) else str((directory / name).resolve())


def file_digest(name: str) -> str:
    """The sha256 of a file that a description names.

    Raises:
        ConfigError: as for ``model_file``.
    """
    try:
        return hashlib.sha256(read_regular(model_file(name), MAX_BYTES, follow=True)).hexdigest()
    except OSError as error:
        raise ConfigError(f"model {name}: {error.strerror}: name a file that is there") from None


class MeshConfig(FrozenModel):
    """A mesh of convex pieces, each in a file; what is read from them is kept, so that they need not be read again."""

    pieces: tuple[str, ...] = Field(
        min_length=1, description="STL or OBJ files, each of one convex piece; package:NAME/FILE for one in a package"
    )
    scale: float = Field(1.0, gt=0.0, description="metres in a unit of the files: 0.001 where they are in millimetres")
    sha256: tuple[str, ...] = Field((), description="of each file, when it was read first")
    center_m: Vector = Field((0.0, 0.0, 0.0), description="middle of its extent, from its origin")
    volume_m3: float = Field(0.0, ge=0.0)

    def measured(self) -> tuple[Self, Vector]:
        """The same with what its files say, and its extent along x, y and z, metres.

        Raises:
            ConfigError: a file that cannot be read, is not closed, not convex, or not of the size of an object.
        """
        pieces = tuple(absolute(piece, Path()) for piece in self.pieces)
        digests, lower, upper, volume = [], np.full(3, np.inf), np.full(3, -np.inf), 0.0
        for name in pieces:
            digests.append(file_digest(name))
            vertices, own_volume = _read_piece(name, self.scale)
            lower, upper = np.minimum(lower, vertices.min(axis=0)), np.maximum(upper, vertices.max(axis=0))
            volume += own_volume
        extent = upper - lower
        if not _fits(extent):
            sizes = " x ".join(f"{each:.3g}" for each in extent)
            fitting = [each for each in (1e-3, 1e-2, 1e3) if _fits(extent * each)]
            likely = min(fitting, key=lambda each: abs(np.log(each * extent.max() / _USUAL_M)), default=None)
            hint = f"; with scale: {self.scale * likely:g} it would fit" if likely is not None else ""
            raise ConfigError(
                f"mesh {pieces[0]} is {sizes} m large, and objects have {LEAST_M:g} to {MOST_M:g} m: is its file in "
                f"other units?{hint}"
            )
        center = _vector((lower + upper) / 2)
        read = {"pieces": pieces, "sha256": tuple(digests), "center_m": center, "volume_m3": volume}
        return self.model_copy(update=read), _vector(extent)


def _fits(extent: StateArray) -> bool:
    return bool(extent.min() >= LEAST_M and extent.max() <= MOST_M)


def _vector(numbers: StateArray) -> Vector:
    x, y, z = map(float, numbers)
    return x, y, z


def _read_piece(name: str, scale: float) -> tuple[StateArray, float]:
    """(V, 3) vertices, metres, and volume of a closed convex piece."""
    import mujoco  # only those who describe a mesh need it so early

    volumes = []
    for inertia in (mujoco.mjtMeshInertia.mjMESH_INERTIA_EXACT, mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX):
        spec = mujoco.MjSpec()
        spec.add_mesh(name="piece", file=str(model_file(name)), scale=[scale] * 3, inertia=inertia)
        spec.worldbody.add_body(name="piece").add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname="piece", density=1000.0
        )
        try:
            model = spec.compile()
        except ValueError as error:
            said = " ".join(str(error).split())
            hints = (advice for words, advice in _ADVICE.items() if words in said)
            advice = next(hints, "give an STL or OBJ file")
            raise ConfigError(f"mesh {name}: MuJoCo cannot use it: {said}; {advice}") from None
        volumes.append(float(model.body("piece").mass[0]) / 1000.0)
    _check_closed(name, model.mesh_vert, model.mesh_face)
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


_ADVICE = {
    "misoriented": "turn its faces outwards, for example in Blender (Mesh, Normals, Recalculate Outside)",
    "ASCII": "save it as binary STL, or as OBJ",
}
"""What to do by words of MuJoCo's errors."""


def _check_closed(name: str, vertices: Any, faces: Any) -> None:
    """Check that every edge has a triangle on either side; vertices at one place are one, as where textures meet."""
    places = np.round((vertices - vertices.min(axis=0)) / (_WELD * np.ptp(vertices, axis=0).max()))
    _, same = np.unique(places, axis=0, return_inverse=True)
    faces = same.ravel()[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if (num := int((counts % 2 != 0).sum())) > 0:  # four where two closed parts touch
        raise ConfigError(
            f"mesh {name} is not closed: {num} of its {len(counts)} edges have not two triangles; repair it, for "
            "example in Blender (Mesh, Clean Up, Merge by Distance and Fill Holes)"
        )
