"""The controls beside the live world: who acts, pause, step, speed, weights of the primitives.

What a user does is put into a queue. The thread to which the game belongs does it between two steps.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from typing import Any

import numpy as np

from service.base.types import FloatArray
from service.robot.play.game import Game, Mode

_TITLES: dict[Mode, str] = {
    "goals": "Bob goes to the goal",
    "primitives": "I set the weights",
    "alice": "Alice proposes, Bob follows",
}
_LEAST_WEIGHT = 0.01
"""Of a slider; the range of Bob's gate is the same."""
SPEEDS = ("1/8", "1/4", "1/2", "1", "2", "4")
_HELP = """**Drag the arrows at the green shape** to put the goal elsewhere: Bob goes there. Turn the view with the left
mouse button, move it with the right one."""


class Panel:
    """GUI of a ``viser`` server."""

    def __init__(self, server: Any, game: Game) -> None:
        self._game, self._todo = game, queue.SimpleQueue[Callable[[], None]]()
        self._told: dict[tuple[int, str], Any] = {}
        self.paused = False
        self.speed = 1.0
        gui = server.gui
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
            (self.speed_choice, self._set_speed),
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

    def _set_speed(self, text: str) -> None:
        above, _, below = text.partition("/")
        self.speed = float(above) / float(below or 1)

    def _take_weights(self) -> None:
        if self._game.mode == "primitives":
            self._game.weights = weights_of(self.weights)


def weights_of(sliders: list[Any]) -> FloatArray:
    """(K,) values of sliders."""
    return np.array([slider.value for slider in sliders], dtype=np.float32)
