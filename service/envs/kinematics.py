"""Kinematics of many serial arms at once: forward kinematics, Jacobian, and damped steps towards a pose.

A chain is read from a compiled model, as the axes of its joints in one configuration, and becomes a table of Denavit
and Hartenberg (modified: Craig 2005, chapter 3), whatever frames the model has. Everything is NumPy over the worlds'
axis (N, ...), with no loop over worlds. Most arms have twists of 90 degrees; these are swaps of axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from service.base.types import BoolArray, IntArray, StateArray

Orientation = Literal["down", "down_any_turn", "free"]
"""What a gripper may do with its direction: it points down and does not turn, it points down, or nothing is asked."""
_NUM_ROWS = {"down": 6, "down_any_turn": 5, "free": 3}
"""Rows of the Jacobian that count: the last is the turn about the vertical."""
_LIMIT_MARGIN = 0.03
"""Distance, rad or share of the range in metres, that joints keep from their limits."""
_DAMPING = 0.02
_POSTURE_GAIN = 0.1


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Pose of N end effectors and how joints move them."""

    position: StateArray
    """(N, 3) end effector in the world frame, metres."""
    rotation: StateArray
    """(N, 3, 3) of the end effector; columns are its axes."""
    jacobian: StateArray
    """(N, 6, J) linear then angular velocity per joint velocity."""

    def __getitem__(self, index: slice | IntArray) -> Kinematics:
        """Some of the arms."""
        return Kinematics(self.position[index], self.rotation[index], self.jacobian[index])


class Chain:
    """A serial chain of J hinges and slides.

    Args:
        model: compiled, with the arm in it.
        joints: names, from the base to the end effector.
        frame: name of the site or body that the end effector is fixed to.
        position: (3,) of the end effector in that frame, metres.
        quaternion: (4,) its rotation there, w x y z.
        home: (J,) posture that joints are drawn to where the end effector leaves them free, rad or metres.
        orientation: asked of the gripper.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        frame: str,
        *,
        position: Sequence[float],
        quaternion: Sequence[float],
        home: Sequence[float],
        orientation: Orientation,
    ) -> None:
        self.num_joints = len(joints)
        self.home: StateArray = np.array(home)
        self._num_rows = _NUM_ROWS[orientation]
        data = mujoco.MjData(model)  # in the model's own configuration, qpos0
        mujoco.mj_kinematics(model, data)
        ids = [model.joint(name).id for name in joints]
        axes, anchors = data.xaxis[ids], data.xanchor[ids]
        is_slide = model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_SLIDE
        lower, upper = model.jnt_range[ids].T
        margin, limited = np.minimum(_LIMIT_MARGIN, 0.05 * (upper - lower)), model.jnt_limited[ids].astype(bool)
        self.lower, self.upper = np.where(limited, lower + margin, -np.inf), np.where(limited, upper - margin, np.inf)
        """(J,) limits less a margin, rad or metres; infinite where a joint has none."""
        is_upright = not is_slide[0] and abs(axes[0, 2]) > 1.0 - 1e-6
        self.base_axis: StateArray | None = anchors[0, :2] if is_upright else None
        """(2,) place of the first joint's axis, metres, if it is a hinge about the vertical."""
        end_position, end_rotation = _pose(model, data, frame, position, quaternion)
        self._slides: BoolArray = is_slide
        end_axes, end_origin = self._read_table(axes, anchors, end_rotation[:, 0])
        zero = model.qpos0[model.jnt_qposadr[ids]]
        self._angle[~is_slide] -= zero[~is_slide]
        self._offset_d[is_slide] -= zero[is_slide]
        self._end_position = _rounded(end_axes.T @ (end_position - end_origin))
        self._end_axes = _rounded(end_axes.T @ end_rotation).T

    def _read_table(self, axes: StateArray, anchors: StateArray, last_x: StateArray) -> tuple[StateArray, StateArray]:
        """Set the table of Denavit and Hartenberg for one configuration.

        Frame i has its z axis on joint i, and its x axis on the common normal of joints i and i + 1.

        Args:
            axes: (J, 3) directions of the joints.
            anchors: (J, 3) a point of each axis, metres.
            last_x: (3,) direction that the last frame's x axis gets, as far as it is free.

        Returns:
            The frame after the last joint: (3, 3) axes, which are columns, and (3,) origin, metres.
        """
        num = len(axes)
        normals, feet, ends = np.empty((3, num, 3))  # common normal, where it leaves axis i, where it meets axis i + 1
        for index in range(num - 1):
            pair = slice(index, index + 2)
            normals[index], feet[index], ends[index] = _common_normal(axes[pair], anchors[pair])
        across = last_x - axes[-1] * (axes[-1] @ last_x)
        free = across if np.linalg.norm(across) > 1e-6 else normals[num - 2]
        normals[-1], feet[-1] = free / np.linalg.norm(free), ends[num - 2]
        self._offset_a, self._twist = [0.0], [(1.0, 0.0)]  # along the x axis before each joint, metres; about it
        self._offset_d, self._angle = np.zeros(num), np.zeros(num)  # along the joint's own axis, metres; about it, rad
        for index in range(1, num):
            before, x_axis = axes[index - 1], normals[index - 1]
            self._offset_a.append(float(_rounded((ends[index - 1] - feet[index - 1]) @ x_axis)))
            cosine, sine = _rounded(np.array([before @ axes[index], np.cross(before, axes[index]) @ x_axis]))
            self._twist.append((float(cosine), float(sine)))
            self._offset_d[index] = _rounded((feet[index] - ends[index - 1]) @ axes[index])
            self._angle[index] = np.arctan2(np.cross(x_axis, normals[index]) @ axes[index], x_axis @ normals[index])
        self._base = np.stack([normals[0], np.cross(axes[0], normals[0]), axes[0], feet[0]])
        return np.stack([normals[-1], np.cross(axes[-1], normals[-1]), axes[-1]], axis=1), feet[-1]

    def forward(self, joints: StateArray) -> Kinematics:
        """Forward kinematics of (N, J) joint values, rad or metres."""
        num = joints.shape[0]
        angles = np.where(self._slides, 0.0, joints) + self._angle
        cosines, sines = np.cos(angles), np.sin(angles)
        x_axis, y_axis, z_axis, position = (np.tile(row, (num, 1)) for row in self._base)
        origins, axes = np.empty((2, self.num_joints, num, 3))
        for index, (offset_a, twist, offset_d) in enumerate(
            zip(self._offset_a, self._twist, self._offset_d, strict=True)
        ):
            if offset_a:
                position = position + offset_a * x_axis
            y_axis, z_axis = _twisted(y_axis, z_axis, *twist)
            if self._slides[index]:
                position = position + (offset_d + joints[:, index, None]) * z_axis
            elif offset_d:
                position = position + offset_d * z_axis
            cosine, sine = cosines[:, index, None], sines[:, index, None]
            x_axis, y_axis = cosine * x_axis + sine * y_axis, cosine * y_axis - sine * x_axis
            origins[index], axes[index] = position, z_axis
        end = (x_axis, y_axis, z_axis)
        position = position + _combined(self._end_position, end)
        rotation = np.stack([_combined(axis, end) for axis in self._end_axes], axis=-1)
        return Kinematics(position, rotation, self._jacobian(axes, position - origins))

    def _jacobian(self, axes: StateArray, arms: StateArray) -> StateArray:
        """(N, 6, J) of (J, N, 3) axes, and ways from each to the end effector, metres."""
        jacobian = np.empty((axes.shape[1], 6, self.num_joints))
        jacobian[:, :3], jacobian[:, 3:] = _cross(axes, arms).transpose(1, 2, 0), axes.transpose(1, 2, 0)
        if self._slides.any():
            jacobian[:, :3, self._slides] = axes[self._slides].transpose(1, 2, 0)
            jacobian[:, 3:, self._slides] = 0.0
        return jacobian

    def errors(self, here: Kinematics, target: StateArray) -> StateArray:
        """(N, E) way to (N, 3) targets, metres, and the turn to the orientation, rad, as far as one is asked."""
        rotation, turn = here.rotation, np.empty((len(target), 3))
        # Half the sum of the axes' cross products with those of a gripper that points down, whose y axis, along which
        # fingers open, is -y: diag(1, -1, -1). Written out, as it has only three numbers.
        turn[:, 0] = 0.5 * (rotation[:, 2, 1] - rotation[:, 1, 2])
        turn[:, 1] = 0.5 * (rotation[:, 2, 0] + rotation[:, 0, 2])
        turn[:, 2] = -0.5 * (rotation[:, 1, 0] + rotation[:, 0, 1])
        return np.concatenate([target - here.position, turn], axis=1)[:, : self._num_rows]

    def solve(
        self, joints: StateArray, target: StateArray, *, at: Kinematics | None = None, num_iterations: int = 2
    ) -> StateArray:
        """Joint values that bring the end effector to ``target`` with the orientation that is asked of it.

        Damped least squares (Wampler 1986) with the posture drawn to home in the null space.

        Args:
            joints: (N, J) where to start, rad or metres.
            target: (N, 3) end-effector positions, metres.
            at: kinematics of ``joints`` if already known.
            num_iterations: two leave an error below 1 mm for one action, 3 mm where an arm is nearly straight.

        Returns:
            (N, J) joint values inside the limits.
        """
        rows = self._num_rows
        for remaining in reversed(range(num_iterations)):
            here = self.forward(joints) if at is None else at
            at = None
            error = self.errors(here, target)
            # Not in the last iteration: damping lets a little of the posture through to the end effector, and since
            # every action starts from where the end effector is, that would add up to a drift of 2 mm in 40 idle steps.
            posture = (_POSTURE_GAIN if remaining else 0.0) * (self.home - joints)
            jacobian = here.jacobian[:, :rows]
            error -= np.matmul(jacobian, posture[:, :, None])[:, :, 0]
            transposed = jacobian.transpose(0, 2, 1)
            square = np.matmul(jacobian, transposed)
            square[:, range(rows), range(rows)] += _DAMPING**2
            step = np.matmul(transposed, np.linalg.solve(square, error[:, :, None]))[:, :, 0]
            joints = np.clip(joints + posture + step, self.lower, self.upper)
        return joints


def _common_normal(axes: StateArray, anchors: StateArray) -> tuple[StateArray, StateArray, StateArray]:
    """Direction of the shortest way from one axis to the next, and where it leaves the one and meets the other."""
    (first, second), (start, other) = axes, anchors
    way, normal = other - start, np.cross(first, second)
    if (length := float(np.linalg.norm(normal))) > 1e-6:
        normal = normal / length
        leave = start + first * (np.cross(way, second) @ normal / length)
        meet = other + second * (np.cross(way, first) @ normal / length)
        return normal, leave, meet
    across = way - first * (first @ way)  # of parallel axes there are many normals
    if np.linalg.norm(across) < 1e-9:
        across = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        return across / np.linalg.norm(across), start, start
    return across / np.linalg.norm(across), start, start + across


def _twisted(y_axis: StateArray, z_axis: StateArray, cosine: float, sine: float) -> tuple[StateArray, StateArray]:
    """The two axes turned about the third."""
    if not sine:
        return (y_axis, z_axis) if cosine > 0.0 else (-y_axis, -z_axis)
    if not cosine:
        return (z_axis, -y_axis) if sine > 0.0 else (-z_axis, y_axis)
    return cosine * y_axis + sine * z_axis, cosine * z_axis - sine * y_axis


def _combined(vector: StateArray, axes: Sequence[StateArray]) -> StateArray:
    """(N, 3) a vector of three numbers along (N, 3) axes; most of them are often 0."""
    terms = [axis if number == 1.0 else number * axis for number, axis in zip(vector, axes, strict=True) if number]
    return sum(terms[1:], terms[0]) if terms else np.zeros_like(axes[0])


def _cross(left: StateArray, right: StateArray) -> StateArray:
    """Cross product of (..., 3) arrays, five times faster than ``np.cross`` on small ones."""
    out = np.empty_like(left)
    out[..., 0] = left[..., 1] * right[..., 2] - left[..., 2] * right[..., 1]
    out[..., 1] = left[..., 2] * right[..., 0] - left[..., 0] * right[..., 2]
    out[..., 2] = left[..., 0] * right[..., 1] - left[..., 1] * right[..., 0]
    return out


def _rounded(numbers: Any) -> StateArray:
    """Numbers that differ from -1, 0 or 1 only by rounding, as those."""
    near = np.round(numbers)
    rounded: StateArray = np.where((np.abs(numbers - near) < 1e-12) & (np.abs(near) <= 1.0), near, numbers)
    return rounded


def _pose(
    model: mujoco.MjModel, data: mujoco.MjData, frame: str, position: Sequence[float], quaternion: Sequence[float]
) -> tuple[StateArray, StateArray]:
    """Position and rotation of what is fixed to a site or a body."""
    is_site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame) >= 0
    at = data.site(frame) if is_site else data.body(frame)
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, np.array(quaternion, dtype=float) / np.linalg.norm(quaternion))
    rotation = at.xmat.reshape(3, 3)
    return at.xpos + rotation @ np.array(position), rotation @ turned.reshape(3, 3)
