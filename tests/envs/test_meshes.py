"""Meshes as objects: measured, checked, held, and the same when they are loaded again."""

import numpy as np
import pytest

from service.base.errors import ConfigError
from service.config import dump_config, load_config
from service.config.model_files import MeshConfig
from service.envs.batch import WorldBatch
from tests.envs.scripted import place_in_air
from tests.runs.runs import assert_one_line

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Sides of a box, seen from outside."""


def write_box(path, size=(0.06, 0.04, 0.03), origin=(0.0, 0.0, 0.0), *, leave_out=0):
    """An OBJ file of a box whose least corner is at ``origin``."""
    corners = CORNERS * size + origin
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    triangles = [triple for a, b, c, d in QUADS for triple in ((a, b, c), (a, c, d))]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles[leave_out:]]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_l(path):
    """An OBJ file of a thick letter L, which is not convex."""
    outline = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]]) * 0.02
    lines = [f"v {x} {y} {z}" for z in (0.0, 0.03) for x, y in outline]
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in top] + [(a + 6, b + 6, c + 6) for a, b, c in top]
    for a in range(6):
        b = (a + 1) % 6
        faces += [(a, b, b + 6), (a, b + 6, a + 6)]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_ramp(path):
    """An OBJ file of a ramp, 8 cm long and 6 cm high at its back; its center of mass is a third of the way along."""
    outline = [(0.0, 0.0), (0.08, 0.0), (0.0, 0.06)]
    lines = [f"v {x} {y} {z}" for y in (0.0, 0.05) for x, z in outline]
    faces = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_split(path, *, flip=False):
    """An OBJ file of a box whose triangles have vertices of their own, as where textures meet."""
    triangles = [triple for a, b, c, d in QUADS for triple in ((a, b, c), (a, c, d))]
    places = [CORNERS[index] * (0.06, 0.04, 0.03) for triple in triangles for index in triple[:: -1 if flip else 1]]
    lines = [f"v {x} {y} {z}" for x, y, z in places]
    lines += [f"f {3 * n + 1} {3 * n + 2} {3 * n + 3}" for n in range(len(triangles))]
    path.write_text("\n".join(lines) + "\n")
    return path


def world_with(*pieces, scale=None, overrides=()):
    names = ", ".join(str(piece) for piece in pieces)
    extra = f", scale: {scale}" if scale is not None else ""
    return load_config(None, [f"world.object={{shape: mesh, mesh: {{pieces: [{names}]{extra}}}}}", *overrides])


def test_a_mesh_is_measured_by_its_file(tmp_path):
    config = world_with(write_box(tmp_path / "box.obj", origin=(1.0, 2.0, 3.0)))
    assert not config.world.is_symmetric  # as far as is known
    shape = config.world.shape
    np.testing.assert_allclose(shape.extent_m, (0.06, 0.04, 0.03), atol=1e-6)
    np.testing.assert_allclose(shape.mesh.center_m, (1.03, 2.02, 3.015), atol=1e-6)
    assert shape.mesh.volume_m3 == pytest.approx(0.06 * 0.04 * 0.03, rel=1e-5)
    with WorldBatch(config.world, 1) as worlds:
        assert worlds.model.body("object").mass[0] == pytest.approx(0.1, rel=1e-5)
        np.testing.assert_allclose(worlds.model.body("object").ipos, 0.0, atol=1e-6)
        worlds.reset(np.random.default_rng(0))
        start = worlds.object_position.copy()
        assert start[0, 2] == pytest.approx(0.015)
        for _ in range(50):
            worlds.step(np.zeros((1, 4), dtype=np.float32))
        np.testing.assert_allclose(worlds.object_position, start, atol=1e-3)


def test_its_weight_is_at_its_center_of_mass(tmp_path):
    """13.3 mm behind its middle: with that 8 mm inside a shelf's edge it falls off, with 20 mm it does not."""
    shelf = "world.fixtures=[{shape: box, size_m: [0.1, 0.3, 0.04], position_m: [0.0, 0.1]}]"
    config = world_with(write_ramp(tmp_path / "ramp.obj"), overrides=[shelf, "world.start_height_m=0.3"])
    with WorldBatch(config.world, 2) as worlds:
        states = worlds.states.copy()
        states[:, worlds.layout["object"]] = [(-0.042, 0.1, 0.071), (-0.03, 0.1, 0.071)]
        worlds.restore(states)
        for _ in range(40):
            worlds.step(np.zeros((2, 4), dtype=np.float32))
        assert worlds.object_position[0, 2] < 0.05
        np.testing.assert_allclose(worlds.object_position[1], (-0.03, 0.1, 0.07), atol=1e-3)


def test_several_pieces_are_one_object(tmp_path):
    """A letter T of two boxes."""
    bar = write_box(tmp_path / "bar.obj", (0.06, 0.03, 0.02), (0.0, 0.0, 0.04))
    config = world_with(bar, write_box(tmp_path / "stem.obj", (0.02, 0.03, 0.04), (0.02, 0.0, 0.0)))
    np.testing.assert_allclose(config.world.shape.extent_m, (0.06, 0.03, 0.06), atol=1e-6)
    with WorldBatch(config.world, 1) as worlds:
        body = worlds.model.body("object")
        assert (body.geomnum[0], body.mass[0]) == (2, pytest.approx(0.1, rel=1e-5))


def test_a_file_in_millimetres(tmp_path):
    file = write_box(tmp_path / "box.obj", (60.0, 40.0, 30.0))
    with pytest.raises(ConfigError) as error:
        world_with(file)
    assert_one_line(error.value, "60 x 40 x 30 m", "other units", "scale: 0.001")
    np.testing.assert_allclose(world_with(file, scale=0.001).world.shape.extent_m, (0.06, 0.04, 0.03), atol=1e-6)
    with pytest.raises(ConfigError) as error:
        world_with(write_box(tmp_path / "cm.obj", (6.0, 5.0, 5.0)))
    assert_one_line(error.value, "6 x 5 x 5 m", "scale: 0.01 ")


def test_a_size_that_is_not_that_of_its_files(tmp_path):
    file = write_box(tmp_path / "box.obj", (0.06, 0.04, 0.03))
    config = world_with(file, overrides=["world.object.size_m=[0.06, 0.04, 0.03]"])
    np.testing.assert_allclose(config.world.shape.extent_m, (0.06, 0.04, 0.03), atol=1e-6)
    with pytest.raises(ConfigError) as error:
        world_with(file, overrides=["world.object.size_m=[0.05, 0.04, 0.03]"])
    for wrong in ("small", "[a, b, c]", "[0.06, 0.04]", "[0.06, 0.04, null]"):
        with pytest.raises(ConfigError, match="size_m"):
            world_with(file, overrides=[f"world.object.size_m={wrong}"])
    assert_one_line(error.value, "size_m = [0.05, 0.04, 0.03]", "have [0.06, 0.04, 0.03]: leave it out, or give null")


def test_it_is_picked_up_carried_and_held(tmp_path):
    coarse = ("world.physics_step_s=0.005", "world.num_substeps=8")
    config = world_with(write_box(tmp_path / "box.obj", (0.05, 0.05, 0.05)), overrides=coarse)
    placement = place_in_air(config.world, 12, seed=0)
    held = (placement.distance_m < 0.01) & (placement.distance_after_hold_m < 0.01)
    assert held.mean() >= 0.9


def test_vertices_at_one_place_are_one(tmp_path):
    split, box = (world_with(each) for each in (write_split(tmp_path / "split.obj"), write_box(tmp_path / "box.obj")))
    assert split.world.object.size_m == box.world.object.size_m
    assert split.world.object.mesh.volume_m3 == pytest.approx(box.world.object.mesh.volume_m3)


def test_it_is_read_once(tmp_path, monkeypatch):
    file = write_box(tmp_path / "box.obj")
    monkeypatch.chdir(tmp_path)
    config = world_with("box.obj")
    (tmp_path / "saved.yaml").write_text(dump_config(config))
    monkeypatch.chdir("/")
    WorldBatch(config.world, 1).close()
    monkeypatch.setattr(MeshConfig, "measured", None)
    assert load_config(tmp_path / "saved.yaml") == config
    write_box(file, (0.05, 0.04, 0.03))
    with pytest.raises(ConfigError) as error:
        WorldBatch(config.world, 1)
    assert_one_line(error.value, "box.obj", "is not the one", "sha256")


def test_mistakes_are_one_line(tmp_path):
    for pieces, said in (
        ([tmp_path / "none.stl"], ["none.stl", "No such file"]),
        ([write_box(tmp_path / "open.obj", leave_out=2)], ["open.obj", "not closed", "4 of"]),
        ([write_l(tmp_path / "l.obj")], ["l.obj", "of its convex hull", "convex pieces"]),
        ([write_box(tmp_path / "thin.obj", (0.05, 0.05, 0.002))], ["0.05 x 0.05 x 0.002 m"]),
    ):
        with pytest.raises(ConfigError) as error:
            world_with(*pieces)
        assert_one_line(error.value, *said)
    with pytest.raises(ConfigError) as error:
        world_with(write_split(tmp_path / "inside_out.obj", flip=True))
    assert_one_line(error.value, "inside_out.obj", "MuJoCo cannot use it", "turn its faces outwards")
    (tmp_path / "text.stl").write_text("no mesh")
    with pytest.raises(ConfigError) as error:
        world_with(tmp_path / "text.stl")
    assert_one_line(error.value, "text.stl", "MuJoCo cannot use it", "give an STL or OBJ file")
    for described, said in (
        ("{shape: mesh, size_m: [0.05, 0.05, 0.05]}", ["shape: mesh needs its files, mesh: {pieces: [FILE]}"]),
        (
            "{shape: box, size_m: [0.05, 0.05, 0.05], mesh: {pieces: [a.stl]}}",
            ["belongs to shape: mesh, and this is a box"],
        ),
        ("{shape: mesh, size_m: [0.05, 0.05, 0.05], mesh: {pieces: []}}", ["world.object.mesh.pieces"]),
    ):
        with pytest.raises(ConfigError) as error:
            load_config(None, [f"world.object={described}"])
        assert_one_line(error.value, *said)
