"""The live world on its port, and in a real browser."""

import os
import signal
import socket
import sys
import threading
import time
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import pytest

from service.base.errors import TandemError
from service.robot.play import server
from service.robot.play.server import LiveWorld
from tests.cli.typed import tandem
from tests.status.browser import CHROMIUM, Visit, chromium


@pytest.fixture(scope="module")
def shared(champion):
    with closing(LiveWorld(champion, port=0, seed=1)) as live:
        yield live


@pytest.fixture
def live(shared):
    """The shared live world, as at its beginning."""
    shared.panel.paused, shared.panel.speed, shared.game.new_goals = False, 1.0, True
    shared.game.set_mode("goals")
    shared.game.reset()
    shared.tick(0.0)
    return shared


def object_of(live):
    return live.game.worlds.object_position[0].copy()


def test_a_dragged_goal_is_where_bob_goes(live):
    """The handle is what a browser moves; the loop reads it."""
    for _ in range(3):
        live.tick(0.04)
    live.scene.goals[0].position = (0.12, 0.1, 0.2)
    for _ in range(75):
        live.tick(0.04)
    np.testing.assert_allclose(live.game.goal, (0.12, 0.1, 0.2))
    assert np.linalg.norm(object_of(live) - (0.12, 0.1, 0.2)) < 0.05
    live.scene.goals[0].position = (3.0, 0.0, 0.2)
    live.tick(0.0)
    assert live.scene.goals[0].position[0] == pytest.approx(live.game.world.workspace.upper_m[0])


def test_time_goes_as_fast_as_is_asked(live):
    steps = live.game.num_steps
    live.panel.speed = 0.25
    live.tick(4 * live.game.step_s)
    assert live.game.num_steps == steps + 1
    live.panel.toggle_pause()
    live.tick(1.0)
    assert live.game.num_steps == steps + 1
    live.panel.toggle_pause()
    live.tick(1e9)  # a machine that was asleep: it goes on, and catches up with nothing
    assert live.game.num_steps == steps + 5


class Event(NamedTuple):
    """What a control gives when somebody has changed it; without a client the program itself has."""

    target: Any
    client: object = None


def test_what_a_person_sets_is_done_between_two_steps(live):
    """A control that is set from here, as the gate's weights are, is not taken for a person's wish."""
    panel, game = live.panel, live.game
    live.tick(0.04)
    asked = panel._asking(lambda title: game.set_mode("primitives"))
    asked(Event(panel.mode))
    live.tick(0.0)
    assert game.mode == "goals"
    asked(Event(panel.mode, client=object()))
    assert game.mode == "goals"  # not in the browser's thread
    live.tick(0.0)
    assert game.mode == "primitives"
    assert not panel.weights[0].disabled
    assert not live.scene.goals[0].visible
    panel.weights[0].value = 0.77
    panel._asking(lambda value: panel._take_weights())(Event(panel.weights[0], client=object()))
    live.tick(0.04)
    assert game.weights[0] == np.float32(0.77)
    assert panel.weights[0].value == 0.77


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH; on Debian: apt-get install chromium")
def test_a_browser_shows_and_drives_it(live):
    """The shapes are hidden: without a graphics card a browser draws one picture of them in seconds."""
    live.scene._scene.fixed_bodies_frame.visible = live.scene.goals[0].visible = False
    for group in live.scene._scene._mesh_groups:
        group.handle.visible = False
    live._server.scene.configure_default_lights(True, cast_shadow=False)
    live.panel.toggle_pause()
    before, stop = live.game.num_steps, threading.Event()
    thread = threading.Thread(target=live.run, args=(stop.is_set,))
    thread.start()
    try:
        with chromium() as browser:
            visit = Visit(browser, live.url, viewport={"width": 420, "height": 420}, device_scale_factor=0.25)
            page = visit.page
            page.goto(live.url)
            page.get_by_text(live.game.title).wait_for()
            assert live.game.num_steps == before
            # Not by its place: the panel still moves while it loads, and the click may meet the next button.
            page.get_by_role("button", name="Go on").dispatch_event("click")
            deadline = time.monotonic() + 60
            while live.game.num_steps == before:
                assert time.monotonic() < deadline
                page.wait_for_timeout(50)
            assert [url for url in visit.asked if not url.removeprefix("blob:").startswith(live.url)] == []
    finally:
        stop.set()
        thread.join()


def test_a_port_that_is_taken(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(TandemError, match=f"cannot listen on 127.0.0.1:{port}: Address already in use"):
            server.free_port("127.0.0.1", port)
        assert server.PORT == 8322
        monkeypatch.setattr(server, "PORT", port)
        assert port < server.free_port("127.0.0.1", None) < port + 50
    with pytest.raises(TandemError, match=r"cannot listen on 203\.0\.113\.7:0: .* check --host"):
        server.free_port("203.0.113.7", 0)


def test_without_its_packages(champion, monkeypatch):
    monkeypatch.setitem(sys.modules, "mjviser", None)
    with pytest.raises(TandemError, match=r"tandem play needs the package mjviser"):
        LiveWorld(champion)


def test_the_command_ends_cleanly(default_signals, monkeypatch):
    """A browser that connects and says nothing is no reason to stay."""
    run, before = LiveWorld.run, {*threading.enumerate()}

    def interrupted(live, stop):
        with socket.create_connection(("127.0.0.1", live.port)):
            os.kill(os.getpid(), signal.SIGINT)
            run(live, stop)

    monkeypatch.setattr(LiveWorld, "run", interrupted)
    ended = tandem("play", "--port", "0")
    assert (ended.exit_code, ended.stderr) == (0, "")
    first, second, last = ended.stdout.splitlines()
    port = int(first.rsplit(":", 1)[1])
    assert f"ssh -L {port}:127.0.0.1:{port} " in second
    assert last == "stopped"
    assert not [thread for thread in {*threading.enumerate()} - before if thread.is_alive() and not thread.daemon]
