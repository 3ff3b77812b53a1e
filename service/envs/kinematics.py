"""Closed-form kinematics of many Pandas at once: forward kinematics, Jacobian, and one damped step towards a pose.

Everything is NumPy over the worlds' axis (N, ...), with no loop over worlds. The chain is the modified DH table of the
Franka documentation; every twist in it is a multiple of 90 degrees, so rotations are column swaps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.envs.panda import BASE_POSITION, FLANGE_TO_TIP_M, JOINT_LOWER, JOINT_UPPER, NUM_JOINTS
from service.types import StateArray

# (a, d, quarter turns about x) of each joint, modified DH (Craig): twist, then offset a along x and d along the new z.
_DH = (
    (0.0, 0.333, 0),
    (0.0, 0.0, -1),
    (0.0, 0.316, 1),
    (0.0825, 0.0, 1),
    (-0.0825, 0.384, -1),
    (0.0, 0.0, 1),
    (0.088, 0.0, 1),
)
_SHOULDER_HEIGHT_M = 0.333
_WRIST_OFFSET_M = 0.088
_ARM_LENGTH_M = float(np.hypot(0.316, 0.0825) + np.hypot(0.384, 0.0825))  # He & Liu: L24 + L46
_REACH_MARGIN_M = 0.015
_LIMIT_MARGIN_RAD = 0.03
_DAMPING = 0.02
_POSTURE_GAIN = 0.1
NEUTRAL_JOINTS = np.array([0.0, 0.41, 0.0, -1.85, 0.0, 2.26, np.pi / 4])
"""panda-gym's neutral pose; the redundant degree of freedom is drawn towards it."""


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Pose of N end effectors and how joints move them."""

    position: StateArray
    """(N, 3) end effector in the world frame, metres."""
    rotation: StateArray
    """(N, 3, 3) of the last link; columns are its axes."""
    jacobian: StateArray
    """(N, 6, 7) linear then angular velocity per joint velocity."""


def forward(joints: StateArray) -> Kinematics:
    """Forward kinematics of (N, 7) joint angles, rad."""
    num = joints.shape[0]
    x_axis, y_axis, z_axis = (np.tile(axis, (num, 1)) for axis in np.eye(3))
    position = np.tile(np.asarray(BASE_POSITION), (num, 1))
    origins = np.empty((NUM_JOINTS, num, 3))
    axes = np.empty((NUM_JOINTS, num, 3))
    cosines, sines = np.cos(joints), np.sin(joints)
    for index, (offset_a, offset_d, quarter) in enumerate(_DH):
        if offset_a:
            position = position + offset_a * x_axis
        if quarter == 1:
            y_axis, z_axis = z_axis, -y_axis
        elif quarter == -1:
            y_axis, z_axis = -z_axis, y_axis
        if offset_d:
            position = position + offset_d * z_axis
        cosine, sine = cosines[:, index, None], sines[:, index, None]
        x_axis, y_axis = cosine * x_axis + sine * y_axis, cosine * y_axis - sine * x_axis
        origins[index], axes[index] = position, z_axis
    position = position + FLANGE_TO_TIP_M * z_axis
    jacobian = np.empty((num, 6, NUM_JOINTS))
    jacobian[:, :3] = _cross(axes, position - origins).transpose(1, 2, 0)
    jacobian[:, 3:] = axes.transpose(1, 2, 0)
    return Kinematics(position, np.stack([x_axis, y_axis, z_axis], axis=-1), jacobian)


def _cross(left: StateArray, right: StateArray) -> StateArray:
    """Cross product of (..., 3) arrays, five times faster than ``np.cross`` on small ones."""
    out = np.empty_like(left)
    out[..., 0] = left[..., 1] * right[..., 2] - left[..., 2] * right[..., 1]
    out[..., 1] = left[..., 2] * right[..., 0] - left[..., 0] * right[..., 2]
    out[..., 2] = left[..., 0] * right[..., 1] - left[..., 1] * right[..., 0]
    return out


# Gripper down, fingers along y: the hand (turned -45 deg against the last link) has x forward, z down.
_HALF = np.sqrt(0.5)
DOWN = np.array([[_HALF, -_HALF, 0.0], [-_HALF, -_HALF, 0.0], [0.0, 0.0, -1.0]])
"""Rotation of the last link when the gripper points down."""


def _orientation_error(rotation: StateArray) -> StateArray:
    """(N, 3) small rotation vector that takes ``rotation`` to DOWN: half the sum of the axes' cross products."""
    error: StateArray = 0.5 * _cross(rotation.transpose(0, 2, 1), np.broadcast_to(DOWN.T, rotation.shape)).sum(axis=1)
    return error


def clip_to_reach(target: StateArray, lowest_z_m: float) -> StateArray:
    """Nearest point a gripper-down arm can reach: height first, then horizontal distance from the base.

    The wrist sits 0.2104 m above the end effector and 0.088 m nearer to the base; its distance from the shoulder is at
    most the arm's length.

    Args:
        target: (N, 3) end-effector positions, metres.
        lowest_z_m: least height, which keeps the fingertips off the table.
    """
    clipped = target.copy()
    arm = _ARM_LENGTH_M - _REACH_MARGIN_M
    np.clip(clipped[:, 2], lowest_z_m, _SHOULDER_HEIGHT_M - FLANGE_TO_TIP_M + 0.9 * arm, out=clipped[:, 2])
    rise = clipped[:, 2] + FLANGE_TO_TIP_M - _SHOULDER_HEIGHT_M
    furthest = _WRIST_OFFSET_M + np.sqrt(arm**2 - rise**2)
    horizontal = clipped[:, :2] - np.asarray(BASE_POSITION[:2])
    distance = np.maximum(np.linalg.norm(horizontal, axis=1), 1e-6)
    scale = np.clip(distance, 0.3, furthest) / distance
    clipped[:, :2] = np.asarray(BASE_POSITION[:2]) + horizontal * scale[:, None]
    return clipped


def solve(
    joints: StateArray, target: StateArray, *, at: Kinematics | None = None, num_iterations: int = 2
) -> StateArray:
    """Joint angles that bring the end effector to ``target`` with the gripper pointing down.

    Damped least squares (Wampler 1986) with the posture drawn to neutral in the null space.

    Args:
        joints: (N, 7) where to start, rad.
        target: (N, 3) end-effector positions, metres.
        at: kinematics of ``joints`` if already known.
        num_iterations: two leave an error below 1 mm for one action, 3 mm where the arm is nearly straight.

    Returns:
        (N, 7) joint angles inside the limits, rad.
    """
    for remaining in reversed(range(num_iterations)):
        here = forward(joints) if at is None else at
        at = None
        error = np.concatenate([target - here.position, _orientation_error(here.rotation)], axis=1)
        # Not in the last iteration: damping lets a little of the posture through to the end effector, and since every
        # action starts from where the end effector is, that little would add up to a drift of 2 mm in 40 idle steps.
        posture = (_POSTURE_GAIN if remaining else 0.0) * (NEUTRAL_JOINTS - joints)
        jacobian = here.jacobian
        error -= np.matmul(jacobian, posture[:, :, None])[:, :, 0]
        transposed = jacobian.transpose(0, 2, 1)
        square = np.matmul(jacobian, transposed)
        square[:, range(6), range(6)] += _DAMPING**2
        step = np.matmul(transposed, np.linalg.solve(square, error[:, :, None]))[:, :, 0]
        joints = np.clip(joints + posture + step, JOINT_LOWER + _LIMIT_MARGIN_RAD, JOINT_UPPER - _LIMIT_MARGIN_RAD)
    return joints
