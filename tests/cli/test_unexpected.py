"""Errors that nobody expected, and usage errors: one line, and the traceback in a file that only this user reads."""

import errno
import re
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.cli.typed import assert_refused, tandem
from tests.runs.runs import write_yaml

ROOT = Path(__file__).parents[2]
SAID = re.compile(r"error: unexpected KeyError: 'x\\ny\\x1b'; its traceback is in (\S+), please report it\n")


def fail(*arguments, **options):
    raise KeyError("x\ny\x1b")


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The directory for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path / "temporary"


def pretrain(tmp_path):
    config = write_yaml(tmp_path / "tiny.yaml")
    return tandem("pretrain", "--config", config, "--run-dir", tmp_path / "run", "--registry", tmp_path / "registry")


def check(result, directory):
    """Exit code 1, one line, and the traceback in a file in that directory."""
    assert result.exit_code == 1, result.exception
    (name,) = SAID.fullmatch(result.stderr).groups()
    path = Path(name)
    assert path.parent == directory
    assert re.fullmatch(r"tandem-error-[0-9]{8}-[0-9]{6}-\w+\.txt", path.name)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    text = path.read_text()
    assert "Traceback (most recent call last)" in text
    assert "in fail" in text
    assert text.startswith("tandem 0.")
    return path


def test_of_a_run_it_is_in_the_run_directory(tmp_path, monkeypatch, temporary):
    monkeypatch.setattr("service.store.run_directory.RunDirectory.record", fail)
    check(pretrain(tmp_path), tmp_path / "run")
    assert list(temporary.iterdir()) == []


def test_of_a_run_without_a_directory_it_is_a_temporary_file(tmp_path, monkeypatch, temporary):
    monkeypatch.setattr("service.store.run_directory.RunDirectory.claim", fail)
    check(pretrain(tmp_path), temporary)
    assert not (tmp_path / "run").exists()


def test_every_other_command_leaves_a_temporary_file(monkeypatch, temporary):
    monkeypatch.setattr("service.registry.registry.Registry.names", fail)
    runs = [tandem("registry", "list") for _ in range(2)]
    assert len({check(result, temporary) for result in runs}) == 2  # nothing is written over


def test_where_no_file_can_be_written_the_line_says_where_it_happened(tmp_path, monkeypatch):
    monkeypatch.setattr("service.registry.registry.Registry.names", fail)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    result = tandem("registry", "list")
    assert_refused(result, "unexpected KeyError", "cannot be written", code=1)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            PermissionError(errno.EACCES, "Permission denied", "/a\n/b\x1b[2J"),
            2,
            r"error: cannot use /a /b\x1b[2J: Permission denied",
        ),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a" * 5000), 2, "File name too long; check the path"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, "error: cannot write what is printed: No space left"),
        (MemoryError("Unable to allocate 247. TiB"), 1, "error: not enough memory: Unable to allocate 247. TiB; ask"),
        (
            RuntimeError("CUDA out of memory. Tried 2 GiB"),
            1,
            "error: not enough memory: CUDA out of memory. Tried 2 GiB",
        ),
    ],
)
def test_what_is_no_mistake_of_the_program_has_no_traceback(monkeypatch, temporary, error, code, said):
    def fail(registry):
        raise error

    monkeypatch.setattr("service.registry.registry.Registry.names", fail)
    result = tandem("registry", "list")
    assert_refused(result, said, code=code)
    assert len(result.stderr) < 2500
    assert list(temporary.iterdir()) == []


def test_a_reader_that_is_gone_is_no_error(temporary):
    command = [sys.executable, "-m", "service", "registry", "show", "panda-cube", "--registry", "none"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1


def test_an_interrupt_is_no_error(monkeypatch, temporary):
    def interrupt(registry):
        raise KeyboardInterrupt

    monkeypatch.setattr("service.registry.registry.Registry.names", interrupt)
    result = tandem("registry", "list")
    assert result.exit_code == 130
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--nope"], "No such option: --nope; see "),
        (["pretend"], "No such command 'pretend'"),
        (["pretrain", "--nope"], "No such option: --nope; see "),
        (["pretrain", "--parallel", "0"], "'--parallel'"),
        (["publish"], "Missing argument 'RUN'; see "),
        (["registry", "show"], "Missing argument"),
        (["registry", "shove"], "No such command 'shove'"),
        (["pretrain", "--set", "seed=" + "[" * 100_000], "the value is nested more than 64 deep"),
        (["pretrain", "--set", "a=&a [*a]"], "the value is nested more than 64 deep"),
        (["pretrain", "--set", "game.num_worlds=" + "9" * 30], "the value is a whole number beyond 9.22e+18"),
        (["pretrain", "--set", "learner.bob.learning_rate=.nan"], "learning_rate"),
        (["pretrain", "--set", "name=x\nTraceback"], "name = 'x Traceback'"),
        (["pretrain", "--set", f"name={'x' * 100_000}"], "name = 'xxx"),
        (["evaluate", "x" * 5000], "File name too long"),
    ],
)
def test_what_is_typed_wrong_is_one_line(monkeypatch, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    result = tandem(*arguments)
    assert_refused(result, said)
    assert len(result.stderr) < 2500
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [[], ["registry"]])
def test_a_group_of_commands_alone_shows_its_help(arguments):
    result = tandem(*arguments)
    assert result.exit_code == 2
    assert "Usage: " in result.output
    assert "error" not in result.output
