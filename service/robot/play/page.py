"""What the browser shows: the world, a goal that can be dragged, and the controls beside them.

Shapes are mjviser's, from the decorated model. What a user does with a control is put into a queue. The thread to which
the game belongs does it between two steps.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from service.base.types import StateArray
from service.config import WorldConfig
from service.envs.objects import object_names
from service.envs.observations import each_object
from service.envs.rendering.camera import DEFAULT_VIEW
from service.envs.rendering.decoration import decorate
from service.envs.rendering.renderer import goal_colors
from service.envs.scene import build_layout, build_spec
from service.robot.play.following import Learning
from service.robot.play.game import Game, Mode

_HIDDEN = ("volume",)
"""Materials that are seen through, which mjviser does not draw so."""
_PLAIN = {"wood": (0.80, 0.70, 0.57, 1.0)}
"""Colours of materials whose texture mjviser does not draw on boxes."""
_GOAL_OPACITY = 0.5
_FIELD_OF_VIEW_RAD = 0.75
_HANDLE_M = 0.12
"""Length of the arrows by which the goal is dragged."""

_TITLES: dict[Mode, str] = {
    "goals": "Bob goes to the goal",
    "primitives": "I set the weights",
    "alice": "Alice proposes, Bob follows",
}
_LEAST_WEIGHT = 0.01
"""Of a slider; the range of Bob's gate is the same."""
SPEEDS = {"1/8": 0.125, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
_HELP = """**Drag the arrows at a transparent shape** to put that goal elsewhere: Bob goes there. Turn the view with the
left mouse button, move it with the right one."""


class LiveScene:
    """Shapes of one world on a ``viser`` server."""

    def __init__(self, server: Any, world: WorldConfig) -> None:
        from mjviser.conversions import merge_geoms
        from mjviser.scene import ViserMujocoScene

        spec = build_spec(world)
        decorate(spec, world)
        self.model = _plain(spec.compile())
        self._data = mujoco.MjData(self.model)
        self._layout = build_layout(world)
        self._scene = ViserMujocoScene(server, self.model, num_envs=1)
        self._scene.camera_tracking_enabled = False
        self._server = server
        self.goals = []
        """The handles of the objects' goals; the ``position`` of each is where a user dragged it."""
        colors = goal_colors([body.color for body in world.bodies])
        for name, rest, color in zip(object_names(world), world.rest_heights_m, colors, strict=True):
            low, high = (*world.workspace.lower_m[:2], rest), world.workspace.upper_m
            place = name.replace("object", "/goal")
            handle = server.scene.add_transform_controls(
                place,
                scale=_HANDLE_M,
                disable_rotations=True,
                disable_sliders=True,
                depth_test=False,
                translation_limits=tuple(zip(low, high, strict=True)),
            )
            self.goals.append(handle)
            body = self.model.body(name)
            shape = merge_geoms(self.model, [int(body.geomadr[0]) + index for index in range(int(body.geomnum[0]))])
            server.scene.add_mesh_simple(
                f"{place}/shape",
                np.asarray(shape.vertices, dtype=np.float32),
                np.asarray(shape.faces, dtype=np.uint32),
                color=color,
                opacity=_GOAL_OPACITY,
                cast_shadow=False,
            )
        server.initial_camera.position = DEFAULT_VIEW.position_m
        server.initial_camera.look_at = DEFAULT_VIEW.lookat_m
        server.initial_camera.fov = _FIELD_OF_VIEW_RAD

    def draw(self, before: StateArray, after: StateArray, share: float) -> None:
        """Show the world between two states.

        Args:
            before: (S,) state of the world.
            after: (S,) the next one.
            share: 0 at ``before``, 1 at ``after``.
        """
        state = before + share * (after - before)
        everything = mujoco.mjtState.mjSTATE_FULLPHYSICS
        mujoco.mj_setState(self.model, self._data, state[self._layout.physics], everything)
        mujoco.mj_normalizeQuat(self.model, self._data.qpos)
        if self.model.nmocap:
            self._data.mocap_pos[0] = state[self._layout["box_place"]]
        mujoco.mj_kinematics(self.model, self._data)
        self._scene.update_from_mjdata(self._data)

    @property
    def goal(self) -> StateArray:
        """(3 K,) where the goals are, metres, or where a user dragged them."""
        return np.concatenate([handle.position for handle in self.goals])

    def place_goal(self, goal: StateArray, *, visible: bool) -> None:
        """Show the goals at (3 K,) metres, or nowhere."""
        for handle, place in zip(self.goals, each_object(goal), strict=True):
            if not np.allclose(handle.position, place, atol=1e-6):
                handle.position = tuple(place)
            if handle.visible != visible:
                handle.visible = visible


class Panel:
    """GUI of a ``viser`` server.

    Args:
        server: shows it.
        game: that is played.
        follows: whether its players still learn.
    """

    def __init__(self, server: Any, game: Game, *, follows: bool = False) -> None:
        self._game, self._todo = game, queue.SimpleQueue[Callable[[], None]]()
        self._told: dict[tuple[int, str], Any] = {}
        self.paused = False
        self.speed = 1.0
        gui = server.gui
        self._learning: Learning | None = None
        if follows:
            self._learned, self._success = gui.add_markdown(""), gui.add_progress_bar(0.0)
            with gui.add_folder("Where Bob solves goals"):
                self._map = gui.add_image(np.full((1, 1, 3), 225, dtype=np.uint8), format="png")
        self.caption = gui.add_markdown("")
        self.mode = gui.add_dropdown("Who acts", [_TITLES[mode] for mode in game.modes])
        self.pause = gui.add_button("Pause")
        self.step = gui.add_button("Step", hint="40 ms, while paused")
        self.reset = gui.add_button("Reset")
        self.speed_choice = gui.add_dropdown("Speed", list(SPEEDS), initial_value="1")
        self.new_goals = gui.add_checkbox("New goals", game.new_goals, hint="another goal when Bob is there")
        gui.add_markdown(_HELP)
        self.weights: list[Any] = []
        if game.primitives is not None:
            with gui.add_folder("Weights of the primitives"):
                self.weights = [
                    gui.add_slider(f"{number}", _LEAST_WEIGHT, 1.0, 0.01, 1.0)
                    for number in range(1, game.primitives.num_primitives + 1)
                ]
        self._connect()

    def do_what_was_asked(self) -> bool:
        """Do in the calling thread what people have asked for; whether there was anything."""
        done = False
        while not self._todo.empty():
            self._todo.get()()
            done = True
        return done

    def show(self) -> None:
        """Tell what goes on now."""
        game = self._game
        paused = " (paused)" if self.paused else ""
        self._tell(self.caption, "content", f"**{game.title}**\n\n{game.caption}{paused}")
        self._tell(self.pause, "label", "Go on" if self.paused else "Pause")
        self._tell(self.new_goals, "value", game.new_goals)
        self._tell(self.mode, "value", _TITLES[game.mode])
        weights, own = game.weights_now(), game.mode == "primitives"
        for place, slider in enumerate(self.weights):
            self._tell(slider, "disabled", not own)
            if not own and weights is not None:
                self._tell(slider, "value", round(float(weights[place]), 2))

    def show_learning(self, learning: Learning) -> None:
        """Tell how far the run is, and how well Bob does."""
        if learning is self._learning:
            return
        self._learning = learning
        rate = "not measured yet" if learning.success is None else f"**{learning.success:.0%}**"
        steps = f"{learning.num_env_steps:,} of {learning.total_env_steps:,} steps"
        self._learned.content = f"Learning: {steps}\n\nRandom goals solved: {rate}"
        self._success.value = 100.0 * (learning.success or 0.0)
        if learning.goal_map is not None:
            self._map.image = learning.goal_map

    def _tell(self, handle: Any, name: str, value: Any) -> None:
        """Set what the game has changed since it was told; not what a user has, of which the game will hear yet."""
        if self._told.get((id(handle), name)) != value:
            self._told[id(handle), name] = value
            setattr(handle, name, value)

    def _connect(self) -> None:
        game, modes = self._game, {title: mode for mode, title in _TITLES.items()}
        self.pause.on_click(lambda event: self._todo.put(self.toggle_pause))
        self.step.on_click(lambda event: self._todo.put(self._one_step))
        self.reset.on_click(lambda event: self._todo.put(game.reset))
        for handle, change in (
            (self.mode, lambda value: game.set_mode(modes[value])),
            (self.new_goals, lambda value: setattr(game, "new_goals", value)),
            (self.speed_choice, lambda value: setattr(self, "speed", SPEEDS[value])),
        ):
            handle.on_update(self._asking(change))
        for slider in self.weights:
            slider.on_update(self._asking(lambda value: self._take_weights()))

    def _asking(self, change: Callable[[Any], None]) -> Callable[[Any], None]:
        """Ask for a change by a person; what ``show`` sets itself is none."""

        def ask(event: Any) -> None:
            value = event.target.value
            if event.client is not None:
                self._todo.put(lambda: change(value))

        return ask

    def toggle_pause(self) -> None:
        """Stop the world, or let it go on."""
        self.paused = not self.paused

    def _one_step(self) -> None:
        if self.paused:
            self._game.step()

    def _take_weights(self) -> None:
        if self._game.mode == "primitives":
            self._game.weights = np.array([slider.value for slider in self.weights], dtype=np.float32)


def _plain(model: mujoco.MjModel) -> mujoco.MjModel:
    """Change how a model looks to what mjviser can draw."""
    for material in range(model.nmat):
        name = model.material(material).name
        if name in _PLAIN:
            model.mat_rgba[material] = _PLAIN[name]
            model.mat_texid[material] = -1
        if name in _HIDDEN:
            model.geom_rgba[model.geom_matid == material, 3] = 0.0
    return model
