"""Many worlds stepped together: native threads for the physics, NumPy over the worlds for everything else."""

from __future__ import annotations

from typing import Any, Self

import mujoco
import numpy as np
from mujoco import rollout

from service.base.cores import usable_cores
from service.base.errors import ConfigError, DivergedError, TandemError
from service.base.liveness import count_work
from service.base.types import BoolArray, FloatArray, IntArray, StateArray
from service.config import WorldConfig
from service.envs.objects import object_names
from service.envs.observations import ACTION, COMMAND_PREFIX, Layouts, ObservationLayout, each_object, layouts
from service.envs.overlap import gripper_boxes, inside_gripper_or_table, join
from service.envs.randomisation import KEYS, ModelBank, normal
from service.envs.reach import reach_of
from service.envs.robot import Robot, described
from service.envs.sampling import Places, draw_starts
from service.envs.scene import FIXTURE_PREFIX, build_layout
from service.envs.state_layout import OBSTACLE_PREFIX, object_columns, obstacle_columns, places_at

DISPLACEMENT_M = 0.05
"""Way from the end effector to its set-point that a full action asks for (paper); in a step the arm covers a part of
it, of the Panda 56 to 61 % in motion."""
WIDTH_CHANGE_M = 0.10
"""Change of the finger width that a full action asks for (paper)."""
MAX_TURN_RAD = 0.5
"""Most a joint is asked to turn in one action; behind the base and near a straight arm the solution would ask for 2."""
SEEN_WITHIN_M = 1.0
"""An obstacle further from the origin along an axis, such as one on the floor, is seen at this bound."""
MAX_SPEED = 1e3
"""A joint (rad/s) or object (m/s, rad/s) faster than this has diverged; the arm reaches 3, a falling object 30."""
_TOUCHING_M = 1e-4
_MOVED = ("object", OBSTACLE_PREFIX)
"""Begin the names of what is put elsewhere at every start."""
_NUM_TRIED_STARTS = 32
_PHYSICS = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
_CONTROL_AND_BOX = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_MOCAP_POS)


class WorldBatch:
    """N independent worlds with one flat state each.

    The state of a world, see ``layout``, is MuJoCo's full physics state, the finger contacts of the last action, the
    last actions where policies see them, the place of a box, whether the gripper is blocked where only some are, and
    what was drawn of ``config.randomisation``. A world is a pure function of (state, action), because each action
    starts the constraint solver cold: saving is copying rows of ``states``, restoring is ``restore``, and the
    continuation is bit-identical.

    Args:
        config: the world.
        num_worlds: N.
        num_threads: native threads; 0 for one per core.
        blocked_fraction: share of starts whose gripper stays closed as if ``config.gripper`` were ``blocked``.
    """

    def __init__(
        self, config: WorldConfig, num_worlds: int, *, num_threads: int = 0, blocked_fraction: float = 0.0
    ) -> None:
        self.config = config
        self.num_worlds = num_worlds
        self.observed = layouts(config)
        """What policies see here."""
        self.bank = ModelBank(config)
        self.model = self.bank.nominal
        self.robot = Robot(config, self.model)
        robot = described(config)
        self.reach = reach_of(robot, self.robot.arm)
        """Where the end effector can be commanded to."""
        log = mujoco.MjLogConfig.get()  # MuJoCo's own log is a file in the working directory
        log.logto_file = log.logto_console = False
        log.set()
        num_threads = self._num_threads = min(num_threads or usable_cores(), num_worlds)
        self._pool = rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        self._closed = False
        self._data = [mujoco.MjData(self.model) for _ in range(max(num_threads, 1))]
        self.layout = build_layout(config, blocked_fraction=blocked_fraction)
        """Columns of ``states``."""
        self._commands = self.layout["commands"]
        self._names = object_names(config)
        self._objects = object_columns(self.layout, config.num_objects)
        self._obstacles = obstacle_columns(self.layout, len(config.obstacles))
        self._num_commands = self._commands.stop - self._commands.start
        # The weights of objects and obstacles are actuators, too, the last ones, which ignore their control.
        num_things = config.num_objects + len(config.obstacles)
        assert self.model.nu == self.robot.num_joints + self.robot.num_fingers + num_things
        assert mujoco.mj_stateSize(self.model, _PHYSICS) == self.layout.physics.stop
        self.blocked_fraction = blocked_fraction
        """Share of later starts with a blocked gripper; more than 0 only where it was when the batch was made."""
        self._control_spec = _CONTROL_AND_BOX if self.model.nmocap else int(mujoco.mjtState.mjSTATE_CTRL)
        self.reach.check(config.workspace, robot.name, self.robot.arm)
        self._fresh_state = self._make_fresh_state()
        self.states: StateArray = np.tile(self._fresh_state, (num_worlds, 1))
        """(N, S)."""
        self._see()
        self.diverged: list[tuple[StateArray, FloatArray]] = []
        """(last finite state, action) of every world whose physics diverged; the reader clears the list."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[object, ...]:
        """A copy, or what is unpickled, is made anew and gets the states: MuJoCo's pool of threads cannot be copied."""
        blocked = self.layout["gripper_blocked"]
        made = self.config, self.num_worlds, self._num_threads, blocked.stop > blocked.start
        kept = {"blocked_fraction": self.blocked_fraction, "diverged": list(self.diverged)}
        return _made_again, (*made, self.states.copy(), kept, self._closed)

    def close(self) -> None:
        """Stop the native threads; the batch cannot step afterwards."""
        self._closed = True
        self._pool.close()

    # --- state -----------------------------------------------------------------------------------------------------

    @property
    def joints(self) -> StateArray:
        """(N, J) joints of the arm, rad or metres."""
        return self.states[:, self.layout["joints"]]

    @property
    def object_position(self) -> StateArray:
        """(N, 3 K) centres of the objects, one after the other, metres."""
        return self._of_objects("object")

    @property
    def object_velocity(self) -> StateArray:
        """(N, 3 K) velocities of the objects, m/s."""
        return self._of_objects("object_velocity")

    @property
    def rest_heights(self) -> StateArray:
        """(N, K) height of each object's centre as it lies on the table of its world, metres."""
        model = self.states[:, self.layout["model"]].sum(axis=1)  # 0 where there is but one, and no such column
        heights: StateArray = self.bank.rest_heights_m[model.astype(np.intp)]
        return heights

    @property
    def box_place(self) -> StateArray:
        """(N, 3) middle of the bottom of each world's box, metres; (N, 0) in worlds without."""
        return self.states[:, self.layout["box_place"]]

    @property
    def obstacle_positions(self) -> StateArray:
        """(N, M, 3) centres of the M obstacles, metres."""
        return places_at(self.states, self._obstacles)

    @property
    def blocked(self) -> BoolArray:
        """(N,) whether a world's gripper stays closed."""
        told = np.any(self.states[:, self.layout["gripper_blocked"]] > 0.0, axis=1)
        found: BoolArray = np.logical_or(told, self.config.gripper == "blocked")
        return found

    @property
    def places(self) -> Places:
        """Where the things are that start elsewhere in every game."""
        return Places(self.object_position, self.box_place, self.obstacle_positions)

    @property
    def ee_position(self) -> StateArray:
        """(N, 3) point between the fingertips, metres."""
        return self._kinematics.position

    def reset(self, rng: np.random.Generator, worlds: BoolArray | None = None) -> None:
        """Put worlds (all, or where ``worlds`` is true) back to a start, see ``draw_starts``."""
        mask = np.ones(self.num_worlds, dtype=bool) if worlds is None else worlds
        self.restore(self.draw_starts(rng, int(mask.sum())), mask)

    def draw_starts(self, rng: np.random.Generator, num: int) -> StateArray:
        """(num, S) states in which games and episodes start.

        The arm is at home, the gripper open unless it is blocked, the object anywhere on the table inside the
        workspace, and so are obstacles. Beside a wall or a box the object is where ``sampling.draw_first`` says, and
        a box is anywhere.
        """
        states = np.tile(self._fresh_state, (num, 1))
        places = draw_starts(rng, num, self.bank.largest, self.gripper_at_start)
        smaller_m = np.subtract(self.config.rest_heights_m, self.bank.largest.rest_heights_m)
        places_at(states, self._objects)[:] = each_object(places.object)
        places_at(states, self._objects)[:, :, 2] += smaller_m
        states[:, self.layout["box_place"]] = places.box
        places_at(states, self._obstacles)[:] = places.obstacles
        self._draw_physics(rng, states)
        if self.blocked_fraction:
            blocked = rng.random(num) < self.blocked_fraction
            states[blocked, self.layout["fingers"]] = self.robot.finger_values(np.zeros(1))
            states[:, self.layout["gripper_blocked"]] = blocked[:, None]
        return states

    def _draw_physics(self, rng: np.random.Generator, states: StateArray) -> None:
        """Draw what ``config.randomisation`` has ranges for, in new states."""
        num, drawn, layout = len(states), self.config.randomisation, self.layout
        if drawn.model_ranges:
            model = rng.integers(len(self.bank), size=num)
            states[:, layout["model"]] = model[:, None]
            places_at(states, self._objects)[:, :, 2] += self.bank.rest_heights_m[model] - self.config.rest_heights_m
            places_at(states, self._obstacles)[:, :, 2] += self.bank.table_height_m[model][:, None]
            if self.config.fixture == "box":
                states[:, layout["box_place"].start + 2] += self.bank.table_height_m[model]
        if drawn.delay_steps is not None:
            low, high = drawn.delay_steps
            states[:, layout["delay"]] = rng.integers(low, high + 1, (num, 1))
        if drawn.object_offset_m is not None:
            direction = rng.normal(size=(num, self.config.num_objects, 3))
            direction /= np.linalg.norm(direction, axis=2, keepdims=True)
            direction *= rng.uniform(*drawn.object_offset_m, (num, self.config.num_objects, 1))
            states[:, layout["object_offset"]] = direction.reshape(num, 3 * self.config.num_objects)
        if drawn.object_noise_m is not None:
            std, key = rng.uniform(*drawn.object_noise_m, num), rng.integers(KEYS, size=num)
            states[:, layout["object_noise"]] = np.column_stack((std, key))

    def restore(self, states: StateArray, worlds: BoolArray | None = None) -> None:
        """Overwrite the states of all worlds, or of those where ``worlds`` is true, with (N or count, S) rows."""
        self.states[slice(None) if worlds is None else worlds] = states
        self._see()

    def put_objects(self, place: StateArray, worlds: slice) -> None:
        """Put the objects of some worlds at (count, 3 K) centres, metres; they stay turned as they are."""
        places_at(self.states[worlds], self._objects)[:] = each_object(place)
        self._see()

    # --- stepping --------------------------------------------------------------------------------------------------

    def step(self, actions: FloatArray, worlds: IntArray | None = None) -> BoolArray:
        """Act for one control step (40 ms by default).

        Args:
            actions: (N, 4), or (M, 4) for M ``worlds``; clipped to [-1, 1]. Way x, y, z from where the end effector is
                now to its set-point, and change of the finger width; the arm covers a part of it in a step.
            worlds: indices of the worlds that act; all by default. The others stand still.

        Returns:
            (N,) true where the physics diverged. Such a world keeps its last finite state; ``diverged`` has it.

        Raises:
            ValueError: actions of the wrong shape.
            DivergedError: actions that are not finite; no world has moved.
            TandemError: the batch is closed.
        """
        if self._closed:
            raise TandemError("step of worlds that are closed: make new ones")
        index = slice(None) if worlds is None else worlds
        if worlds is not None and not worlds.size:
            return np.zeros(self.num_worlds, dtype=bool)  # MuJoCo's rollout of no states is a segmentation fault
        count_work()
        start = self.states[index]
        if actions.shape != (start.shape[0], ACTION.size):
            raise ValueError(f"actions: expected shape {(start.shape[0], ACTION.size)}, got {actions.shape}")
        if not np.isfinite(actions).all():
            num = int((~np.isfinite(actions).all(axis=1)).sum())
            raise DivergedError(
                f"actions of {num} of {len(actions)} worlds are not finite: the policy that made them has diverged; "
                "use an earlier version"
            )
        commands: StateArray = np.clip(actions.astype(np.float64), -1.0, 1.0)
        control = self._control(start, self._acted(start, commands), index)
        states, sensors = self._pool.rollout(
            self.bank.of(start[:, self.layout["model"]].ravel()),
            self._data,
            start[:, self.layout.physics],
            control[:, None, :],
            control_spec=self._control_spec,
            nstep=self.config.num_substeps,
        )
        after = np.empty_like(start)
        after[:, self.layout.physics] = states[:, -1]
        after[:, self.layout["contacts"]] = self.robot.contacts((sensors > 0).any(axis=1))
        after[:, self._commands] = np.concatenate((commands, start[:, self._commands]), axis=1)[:, : self._num_commands]
        after[:, self.layout.kept] = start[:, self.layout.kept]
        finite = (np.abs(after[:, self.layout.velocities]) < MAX_SPEED).all(axis=1) & np.isfinite(after).all(axis=1)
        diverged = np.zeros(self.num_worlds, dtype=bool)
        if not finite.all():
            after[~finite] = start[~finite]
            diverged[index] = ~finite
            self.diverged += [(start[row].copy(), actions[row].copy()) for row in np.flatnonzero(~finite)]
        self.states[index] = after
        self._see()
        return diverged

    def _acted(self, start: StateArray, commands: StateArray) -> StateArray:
        """(M, 4) commands that count now: new ones, or earlier ones where they come late."""
        delay = start[:, self.layout["delay"]].ravel().astype(np.intp)
        if not delay.any():
            return commands
        queue = np.concatenate((commands, start[:, self._commands]), axis=1).reshape(len(start), -1, ACTION.size)
        late: StateArray = queue[np.arange(len(start)), delay]
        return late

    def _control(self, start: StateArray, actions: StateArray, index: slice | IntArray) -> StateArray:
        here, num_joints = self._kinematics[index], self.robot.num_joints
        target = self.reach.clip(here.position + DISPLACEMENT_M * actions[:, :3])
        width = self.robot.openings(start[:, self.layout["fingers"]]).sum(axis=1) + WIDTH_CHANGE_M * actions[:, 3]
        joints, box_place = start[:, self.layout["joints"]], start[:, self.layout["box_place"]]
        control = np.zeros((start.shape[0], self.model.nu + box_place.shape[1]))
        solution = self.robot.arm.solve(joints, target, at=here)
        control[:, :num_joints] = np.clip(solution, joints - MAX_TURN_RAD, joints + MAX_TURN_RAD)
        widest_m = self.robot.widest_m * ~(start[:, self.layout["gripper_blocked"]] > 0.0).any(axis=1)
        fingers = self.robot.finger_values(np.clip(width, 0.0, widest_m))
        control[:, num_joints : num_joints + self.robot.num_fingers] = fingers
        control[:, self.model.nu :] = box_place
        return control

    # --- observations ----------------------------------------------------------------------------------------------

    def positions(self) -> FloatArray:
        """(N, P) input of Bob's primitives: ``Layouts.positions``."""
        return self.observe(self.observed.positions)

    def true_positions(self, seen: Layouts) -> FloatArray:
        """(N, P) positions of any layouts without the errors of ``config.randomisation``."""
        place = self.object_position
        return self.observe(seen.positions, object=place, object_from_effector=self._from_effector(place))

    def full(self, elapsed: float) -> FloatArray:
        """(N, F) input of Alice: ``Layouts.full``; ``elapsed`` is the share of her turn gone by, in [0, 1]."""
        return self.observe(self.observed.full, elapsed=elapsed)

    def bob_value(self, goal: StateArray) -> FloatArray:
        """(N, V) input of Bob's value network, ``Layouts.bob_value``, for (N, 3 K) goals, metres; without errors."""
        place = self.object_position
        given = {"goal": goal, "object": place, "goal_from_object": goal - place}
        return self.observe(self.observed.bob_value, object_from_effector=self._from_effector(place), **given)

    def observe(self, layout: ObservationLayout, **given: StateArray | float) -> FloatArray:
        """(N, O) vectors of any layout; ``given`` are the (N, size) entries a world does not know, such as a goal."""
        out = np.empty((self.num_worlds, layout.size), dtype=np.float32)
        for name, part in layout.columns.items():
            out[:, part] = given[name] if name in given else self._measure(name)
        return out

    def _measure(self, name: str) -> StateArray:
        """(N, size) one entry of an observation: computed here, or else a part of the state of the same name."""
        if name == "fingers":
            return self.robot.openings(self.states[:, self.layout["fingers"]])
        if name == "finger_velocities":
            return self.robot.opening_speeds(self.states[:, self.layout["finger_velocities"]])
        if name.startswith(COMMAND_PREFIX):
            first = self._commands.start + ACTION.size * (int(name.removeprefix(COMMAND_PREFIX)) - 1)
            return self.states[:, first : first + ACTION.size]
        if name.startswith(OBSTACLE_PREFIX):
            return np.clip(self.states[:, self.layout[name]], -SEEN_WITHIN_M, SEEN_WITHIN_M)
        if name == "effector":
            return self.ee_position
        if name == "delay" and self.config.randomisation.delay_steps is None:
            return np.zeros((self.num_worlds, 1))
        if name == "object":
            return self._seen_object
        if name == "object_from_effector":
            return self._from_effector(self._seen_object)
        if name == "object_velocity":
            return self.object_velocity
        if name == "effector_velocity":
            velocity = self.states[:, self.layout["joint_velocities"]]
            linear: StateArray = np.matmul(self._kinematics.jacobian[:, :3], velocity[:, :, None])[:, :, 0]
            return linear
        return self.states[:, self.layout[name]]

    def _see(self) -> None:
        """Compute what several observations of the same states need."""
        self._kinematics = self.robot.arm.forward(self.joints)
        self._seen_object, drawn = self.object_position, self.config.randomisation  # with the errors of what is seen
        if drawn.object_offset_m is not None:
            self._seen_object = self._seen_object + self.states[:, self.layout["object_offset"]]
        if drawn.object_noise_m is not None:
            std, key = self.states[:, self.layout["object_noise"]].T
            steps = np.rint(self.states[:, 0] / self.config.step_s)
            self._seen_object = self._seen_object + std[:, None] * normal(key, steps, 3 * self.config.num_objects)

    def contacts(self) -> BoolArray:
        """(N, 2 K) left, right finger touched each object during the last action."""
        return self.states[:, self.layout["contacts"]] > 0

    def _of_objects(self, name: str) -> StateArray:
        """(N, 3 K) a part of the state that each object has; of one object a view."""
        parts = [self.states[:, self.layout[name.replace("object", each, 1)]] for each in self._names]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def _from_effector(self, place: StateArray) -> StateArray:
        """(N, 3 K) ways from the end effector to (N, 3 K) places."""
        return place - np.tile(self.ee_position, self.config.num_objects)

    def _make_fresh_state(self) -> StateArray:
        workspace = self.config.workspace
        home = np.array([[workspace.center_x_m, workspace.center_y_m, self.config.start_height_m]])
        state = np.zeros(self.layout.size)
        mujoco.mj_getState(self.model, mujoco.MjData(self.model), state[self.layout.physics], _PHYSICS)
        arm = self.robot.arm
        state[self.layout["joints"]] = arm.solve(arm.home[None], home, num_iterations=30)[0]
        state[self.layout["fingers"]] = self.robot.finger_values(np.array([self.robot.widest_m]))[0]
        self._check_start(state)
        # Where there is no room, it is said now.
        places = draw_starts(np.random.default_rng(0), _NUM_TRIED_STARTS, self.bank.largest, self.gripper_at_start)
        as_built = places_at(state[None], self._objects).reshape(1, -1)
        rest_m = np.array(self.config.rest_heights_m)
        inside = inside_gripper_or_table(as_built, self.config, self.gripper_at_start, rest_m).any()
        if self.config.obstacles or self.config.objects or inside:  # before the first reset, too, nothing is in another
            state[self.layout["box_place"]] = places.box[0]
            places_at(state[None], self._objects)[:] = each_object(places.object[:1])
            places_at(state[None], self._objects)[:, :, 2] = self.config.rest_heights_m
            places_at(state[None], self._obstacles)[:] = places.obstacles[:1]
        return state

    def _check_start(self, state: StateArray) -> None:
        """Refuse a world in which the gripper starts inside something."""
        data = mujoco.MjData(self.model)
        mujoco.mj_setState(self.model, data, state[self.layout.physics], _PHYSICS)
        mujoco.mj_forward(self.model, data)
        gripper, higher_m = gripper_boxes(self.model, data), float(self.bank.table_height_m.max())
        if self.blocked_fraction:
            closed = state.copy()
            closed[self.layout["fingers"]] = self.robot.finger_values(np.zeros(1))[0]
            mujoco.mj_setState(self.model, other := mujoco.MjData(self.model), closed[self.layout.physics], _PHYSICS)
            mujoco.mj_forward(self.model, other)
            gripper = join(gripper, gripper_boxes(self.model, other))
        # On the highest table, things come as much nearer to the gripper.
        self.gripper_at_start = gripper._replace(lower=gripper.lower - np.array([0.0, 0.0, higher_m]))
        for contact in data.contact[: data.ncon]:
            names = [self.model.geom(int(geom)).name for geom in contact.geom]
            fixed = [name for name in names if name.startswith(FIXTURE_PREFIX)]
            if contact.dist < -_TOUCHING_M and fixed and not any(name.startswith(_MOVED) for name in names):
                raise ConfigError(
                    f"at its start, {self.config.start_height_m:g} m above the middle of the workspace, the gripper is "
                    f"{-contact.dist:.3f} m deep inside {_fixture(fixed[0])}: raise world.start_height_m, or put the "
                    "fixture elsewhere"
                )


def _fixture(geom: str) -> str:
    """The words for the fixture that a part of the model belongs to."""
    name = geom.removeprefix(FIXTURE_PREFIX).partition("-")[0]
    return f"world.fixtures[{name}]" if name.isdigit() else f"the {name}"


def _made_again(
    config: WorldConfig,
    num_worlds: int,
    num_threads: int,
    has_blocked: bool,
    states: StateArray,
    kept: dict[str, Any],
    closed: bool,
) -> WorldBatch:
    worlds = WorldBatch(config, num_worlds, num_threads=num_threads, blocked_fraction=float(has_blocked))
    vars(worlds).update(kept)
    worlds.states = states
    worlds._see()
    if closed:
        worlds.close()
    return worlds
