"""SIGINT and SIGTERM at any moment of a run: what is on the disk then, what is said, and the exit code."""

import os
import pty
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from types import SimpleNamespace

import pytest

from service.base.errors import TandemError
from service.registry.registry import Registry
from service.runs import train as training
from service.runs.run import Run
from service.runs.signals import PASSED_ON, STOPPING, InterruptError, StopSignals
from tests.cli.typed import tandem
from tests.runs.runs import assert_one_line, assert_same_run, newest, play, write_yaml

pytestmark = pytest.mark.usefixtures("default_signals")
BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)


def send(number):
    os.kill(os.getpid(), number)


def send_when_called(patch, name, number):
    """The first thing that this function does from now on is to get a signal."""

    def interrupted(*args, **kwargs):
        send(number)
        raise AssertionError("nobody minded the signal")

    patch.setattr(name, interrupted)


# --- the handlers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", STOPPING)
def test_a_signal_raises_where_nothing_else_was_asked_for(number):
    with pytest.raises(InterruptError, match=number.name) as caught, StopSignals() as signals:
        send(number)
    assert caught.value.number == signals.first == number
    assert not isinstance(caught.value, Exception)  # or a broad ``except`` would swallow it


def test_a_terminal_that_closes_sends_one_stop_however_often_it_says_so():
    asked, (reader, terminal) = [], pty.openpty()
    kept = [os.dup(descriptor) for descriptor in range(3)]
    try:
        for descriptor in range(3):
            os.dup2(terminal, descriptor)
        with StopSignals() as signals, signals.asking(lambda: asked.append("stop")):
            os.close(terminal)
            os.close(reader)
            for _ in range(3):
                send(signal.SIGHUP)
            os.write(1, b"to nobody, and no error")
            said = list(asked)
    finally:
        for descriptor, before in enumerate(kept):
            os.dup2(before, descriptor)
            os.close(before)
    assert (signals.first, said) == (signal.SIGHUP, ["stop"])


def test_a_hang_up_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignals() as signals:
            send(signal.SIGHUP)
        assert signals.first is None
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@BOTH
def test_the_first_signal_asks_and_the_second_raises(number):
    asked = []
    with StopSignals() as signals, signals.asking(lambda: asked.append("stop")):
        send(number)
        assert asked == ["stop"]
        with pytest.raises(InterruptError, match="SIGTERM"):
            send(signal.SIGTERM)
    assert signals.first == number
    assert asked == ["stop"]


def test_after_the_question_a_signal_raises_again():
    with StopSignals() as signals:
        with signals.asking(lambda: pytest.fail("asked too late")):
            pass
        with pytest.raises(InterruptError):
            send(signal.SIGINT)


def test_a_forked_process_ends_by_its_own_signal_alone():
    """As one of ``multiprocessing.Pool`` in a method of a user's: SIGTERM ends it, Ctrl-C in a terminal does not."""
    with StopSignals() as signals, signals.asking(lambda: None):
        child = os.fork()
        if not child:
            for number in (signal.SIGINT, signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
                os.kill(os.getpid(), number)
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM
        assert signals.first is None


def test_another_thread_gets_no_signals_and_is_told_so():
    with ThreadPoolExecutor(1) as threads, pytest.raises(TandemError) as error:
        threads.submit(StopSignals().__enter__).result()
    assert_one_line(error.value, "this needs the main thread", "in a process of its own")


def test_a_signal_that_somebody_swallowed_is_not_forgotten():
    asked = []
    with StopSignals() as signals:
        with suppress(BaseException):
            send(signal.SIGTERM)
        with signals.asking(lambda: asked.append("stop")):
            assert asked == ["stop"]


def test_the_handlers_from_before_are_put_back():
    before = [signal.getsignal(number) for number in STOPPING]
    with pytest.raises(InterruptError), StopSignals():
        send(signal.SIGTERM)
    assert [signal.getsignal(number) for number in STOPPING] == before


@pytest.mark.parametrize("order", [(PASSED_ON, signal.SIGTERM), (signal.SIGTERM, PASSED_ON)])
def test_a_stop_that_comes_directly_and_is_passed_on_is_one(order):
    asked = []
    with StopSignals() as signals, signals.asking(lambda: asked.append("stop")):
        for number in order:
            send(number)
        assert asked
        with pytest.raises(InterruptError, match="SIGINT"):
            send(signal.SIGINT)
    assert signals.first == order[0]


# --- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A quick end of a run, and ``run(*more)``: a pre-training there from the command line."""
    make_artifacts = training.make_artifacts
    monkeypatch.setattr(training, "make_artifacts", lambda directory, registry: {})
    monkeypatch.setattr("service.media.artifacts.NUM_SKILLS", 2)
    monkeypatch.setattr("service.media.artifacts.COVERAGE_STEPS", 2)
    monkeypatch.setattr("service.media.video.write_video", lambda takes, world, path, options: path)
    monkeypatch.setattr("service.media.artifacts.plot_curves", lambda path, method: path / "curves.png")
    home = SimpleNamespace(path=tmp_path / "run", registry=tmp_path / "registry")
    config = write_yaml(tmp_path / "tiny.yaml")

    def draw():
        monkeypatch.setattr(training, "make_artifacts", make_artifacts)

    def run(*more):
        arguments = ("pretrain", "--run-dir", home.path, "--registry", home.registry, *more)
        arguments += () if "--resume" in more else ("--config", config)
        return tandem(*arguments)

    home.run, home.draw = run, draw
    home.hint = f"continue with: tandem train --resume --run-dir {home.path} --registry {home.registry}\n"
    return home


@pytest.mark.parametrize(
    ("where", "number"),
    [
        ("service.registry.publishing.success_metrics", signal.SIGINT),
        ("service.media.recording.record_rounds", signal.SIGTERM),
    ],
)
def test_a_signal_behind_the_learning(home, uninterrupted, where, number):
    home.draw()
    with pytest.MonkeyPatch.context() as patch:
        send_when_called(patch, where, number)
        result = home.run()
    assert result.exit_code == 128 + number, result.output
    assert "finished after" in result.stdout
    assert result.stdout.endswith(f"saved, but not evaluated, published and drawn to the end; {home.hint}")
    assert_same_run(home.path, uninterrupted)


def test_a_resume_does_what_the_signal_kept_from_being_done(home, uninterrupted, monkeypatch):
    home.draw()
    with monkeypatch.context() as patch:
        send_when_called(patch, "service.media.artifacts.plot_goals", signal.SIGTERM)
        assert home.run().exit_code == 143
    result = home.run("--resume")
    assert result.exit_code == 0, result.output
    assert (home.path / "goals.png").exists()
    assert [str(version) for version in Registry(home.registry).versions("tiny")] == ["tiny@1"]
    assert_same_run(home.path, uninterrupted)


def test_a_signal_while_a_run_is_being_begun(home, monkeypatch):
    with monkeypatch.context() as patch:
        send_when_called(patch, "service.store.checkpoints.write_atomic", signal.SIGTERM)
        result = home.run()
    assert result.exit_code == 128 + signal.SIGTERM
    assert result.stdout == "stopped at once; nothing was saved yet\n"
    assert home.run().exit_code == 0  # the same command works


def test_a_signal_while_a_run_is_being_loaded(home, uninterrupted, monkeypatch):
    play(home.path, kill_after=3)
    with monkeypatch.context() as patch:
        send_when_called(patch, "service.methods.workers.TaskGenerator.load_state", signal.SIGTERM)
        result = home.run("--resume")
    assert result.exit_code == 128 + signal.SIGTERM
    assert result.stdout == f"stopped at once; {home.hint}"
    home.run("--resume")
    assert_same_run(home.path, uninterrupted)


def test_a_signal_during_an_iteration(home, uninterrupted, monkeypatch):
    record = Run._take_snapshot

    def signalled(self, **kwargs):
        record(self, **kwargs)
        if self.iteration == 3:
            send(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Run, "_take_snapshot", signalled)
        result = home.run()
    assert result.exit_code == 130
    assert "stopping after this iteration; again to end now\n" in result.stderr
    assert "interrupted after" in result.stdout
    assert result.stdout.endswith(f"\nsaved; {home.hint}")
    assert newest(home.path).step == 3
    home.run("--resume")
    assert_same_run(home.path, uninterrupted)


def test_two_signals_during_an_iteration(home, uninterrupted, monkeypatch):
    def signalled(self, *args):
        send(signal.SIGTERM)
        send(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(Run, "_record", signalled)
        result = home.run()
    assert result.exit_code == 130
    assert result.stdout == f"stopped at once; {home.hint}"
    assert newest(home.path).step == 0
    home.run("--resume")
    assert_same_run(home.path, uninterrupted)


def test_a_signal_while_the_last_checkpoint_is_written(home, uninterrupted, monkeypatch):
    """It came too late to end the learning, but in time to leave out what follows."""
    save = Run._save_last

    def signalled(self):
        send(signal.SIGTERM)
        save(self)

    monkeypatch.setattr(Run, "_save_last", signalled)
    result = home.run()
    assert result.exit_code == 143
    assert "finished after" in result.stdout
    assert not (home.path / "curves.png").exists()
    assert not home.registry.exists()
    assert_same_run(home.path, uninterrupted)
