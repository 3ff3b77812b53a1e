"""The state of a world: each part where MuJoCo has it, and worlds that are still to come."""

import mujoco
import pytest

from service.config import WorldConfig
from service.envs.batch import WorldBatch
from service.envs.scene import build_layout, build_spec


@pytest.mark.parametrize("fixture", ["none", "wall", "box"])
def test_every_part_is_where_mujoco_has_it(fixture):
    config = WorldConfig(fixture=fixture)
    model, layout = build_spec(config).compile(), build_layout(config)
    first = {"joints": "joint1", "fingers": "left_finger", "object": "object"}
    second = {"joints": "joint2", "fingers": "right_finger"}
    velocities = {"joints": "joint_velocities", "fingers": "finger_velocities", "object": "object_velocity"}
    for part, name in first.items():
        assert layout[part].start == 1 + model.joint(name).qposadr[0]
        assert layout[velocities[part]].start == 1 + model.nq + model.joint(name).dofadr[0]
    for part, name in second.items():
        assert layout[part].start + 1 == 1 + model.joint(name).qposadr[0]
    assert layout["joints"].stop == layout["fingers"].start
    assert layout["object_quaternion"] == slice(layout["object"].stop, 1 + model.nq)
    assert layout["object_spin"] == slice(layout["object_velocity"].stop, 1 + model.nq + model.nv)
    assert layout.velocities == slice(1 + model.nq, 1 + model.nq + model.nv)
    full = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
    assert layout.physics == slice(0, mujoco.mj_stateSize(model, full))


@pytest.mark.parametrize(
    ("fixture", "blocked_fraction", "box_place", "gripper_blocked"),
    [
        ("none", 0.0, slice(34, 34), slice(34, 34)),
        ("none", 0.2, slice(34, 34), slice(34, 35)),
        ("box", 0.0, slice(34, 37), slice(37, 37)),
        ("box", 0.2, slice(34, 37), slice(37, 38)),
    ],
)
def test_what_follows_the_physics(fixture, blocked_fraction, box_place, gripper_blocked):
    """Time 1, positions 7 + 2 + 7, velocities 7 + 2 + 6, contacts 2; checkpoints have it in this order."""
    config = WorldConfig(fixture=fixture)
    with WorldBatch(config, 1, num_threads=1, blocked_fraction=blocked_fraction) as worlds:
        layout, shape = worlds.layout, worlds.states.shape
    assert layout["contacts"] == slice(32, 34)
    assert (layout["box_place"], layout["gripper_blocked"]) == (box_place, gripper_blocked)
    assert layout.kept == slice(34, gripper_blocked.stop)
    assert shape == (1, layout.size) == (1, gripper_blocked.stop)
