"""The live world's server: a port on this machine, a loop that keeps up with the clock, and a clean end.

The loop steps the game and tells the browsers; it waits for the clock alone, and without a viewer for a browser.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from service.base import ports
from service.base.errors import TandemError, needs_extra
from service.envs.objects import object_names
from service.registry.loading import Trained
from service.robot.play.following import Following
from service.robot.play.game import Game
from service.robot.play.page import LiveScene, Panel

PORT = 8322
_FRAME_S = 1 / 30
_MOST_STEPS = 4
"""In one frame: a machine that is too slow shows a slower world, and does not fall behind for ever."""


class LiveWorld:
    """A game, and the server that shows it.

    Args:
        players: see ``Game``.
        host: to listen on; others than this machine's own let everybody who reaches it play along.
        port: to listen on; None for 8322, or the next one that is free.
        seed: of the game.
        following: the run that the players are of, where it goes on.

    Raises:
        TandemError: the packages of the extra ``play`` are missing, the port is taken, or the host is not here.
    """

    def __init__(
        self,
        players: Trained,
        host: str = "127.0.0.1",
        port: int | None = None,
        seed: int = 0,
        following: Following | None = None,
    ) -> None:
        with needs_extra("play", "tandem play"):
            import mjviser  # noqa: F401
            import viser
        self.port = free_port(host, port)
        self.url = ports.url_of(host, self.port)
        """Address for a browser on this machine."""
        self.game, self._following = Game(players, seed), following
        self._server = _quiet_server(viser, host, self.port)
        try:
            self.scene = LiveScene(self._server, self.game.world)
            self.panel = Panel(self._server, self.game, follows=following is not None)
        except BaseException:
            self.close()
            raise
        self._before = self.game.state.copy()
        self._progress = 0.0
        self._shown_goal: Any = None
        self.tick(0.0)

    def close(self) -> None:
        """Close every connection, and stop."""
        self._server.stop()
        self.game.close()

    def run(self, stop: Callable[[], bool]) -> None:
        """Play until ``stop`` says so; the world stands still without a viewer."""
        last = time.monotonic()
        while not stop():
            begun = time.monotonic()
            elapsed_s, last = begun - last, begun
            if self._server.get_clients():
                self.tick(elapsed_s)
            time.sleep(max(_FRAME_S - (time.monotonic() - begun), 0.005))

    def tick(self, elapsed_s: float) -> None:
        """Let time go by, and tell the browsers.

        Args:
            elapsed_s: seconds on the clock since the last tick.
        """
        game, panel = self.game, self.panel
        if self._following is not None and (learning := self._following.learning) is not None:
            if learning.players is not None and learning.players is not game.players:
                game.take(learning.players)
            panel.show_learning(learning)
        asked = panel.do_what_was_asked()
        dragged = self._take_dragged_goal()
        steps = game.num_steps
        if not panel.paused:
            self._progress += elapsed_s * panel.speed / game.step_s
            for _ in range(min(int(self._progress), _MOST_STEPS)):
                self._before = game.state.copy()
                game.step()
            self._progress %= 1.0
        moved = game.num_steps != steps
        if asked or (moved and _has_jumped(self._before, game.state, game)):
            self._before = game.state.copy()
        if asked or moved or dragged or not panel.paused:
            self.scene.draw(self._before, game.state, 1.0 if panel.paused else self._progress)
        self.scene.place_goal(game.goal, visible=game.shows_goal)
        self._shown_goal = self.scene.goal
        panel.show()

    def _take_dragged_goal(self) -> bool:
        """Give the game the goal where a user has put it."""
        position = self.scene.goal
        if self._shown_goal is None or np.allclose(position, self._shown_goal, atol=1e-6) or not self.game.shows_goal:
            return False
        if self.game.mode == "goals":
            self.game.set_goal(position)
        return True


def _has_jumped(before: Any, after: Any, game: Game) -> bool:
    """Whether a world was put elsewhere: what lies between is not to be shown."""
    layout = game.worlds.layout
    far_m = max(np.abs(after[layout[name]] - before[layout[name]]).max() for name in object_names(game.world))
    far_rad = np.abs(after[layout["joints"]] - before[layout["joints"]]).max()
    return bool(far_m > 0.15 or far_rad > 0.6)


def _quiet_server(viser: Any, host: str, port: int) -> Any:
    """Start a server that says nothing on the terminal and opens no tunnel to viser's own site."""
    import rich

    class Server(viser.ViserServer):  # type: ignore[misc]
        def request_share_url(self, verbose: bool = True) -> None:
            """Stay on this machine: the page's share button would show the world to everybody who has a link."""

    rich.get_console().quiet = True  # viser prints a box when it starts, and a line when it stops
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a traceback for each connection that a browser drops
    server = Server(host=host, port=port, label="Tandem", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    return server


def free_port(host: str, port: int | None) -> int:
    """A port that can be listened on: the one that is asked for, or the first free one from the usual one on.

    ``viser`` itself would silently take another one, and wait for ever where a host is not here.
    """
    try:
        chosen = ports.free_port(host, PORT) if port is None else port
        with ports.listen(host, chosen) as found:
            return int(found.getsockname()[1])
    except OSError as error:
        where = f"{host}:{PORT if port is None else port}"
        raise TandemError(
            f"cannot listen on {where}: {error.strerror}; take another --port or leave it out, and check --host"
        ) from None
