"""Commands as they are typed, in this process, and how one is refused."""

from typer.testing import CliRunner

from service.cli.main import app
from tests.runs.runs import assert_one_line


def tandem(*arguments, answers=None, **environment):
    """Run a command: ``answers`` is what is typed while it runs."""
    return CliRunner().invoke(app, [str(each) for each in arguments], answers, env={"COLUMNS": "80", **environment})


def assert_refused(result, *parts, code=2):
    """Nothing was printed but one line on stderr that has all of this in it."""
    assert result.exit_code == code, result.exception
    assert result.stdout == ""
    assert result.stderr.startswith("error: ")
    assert result.stderr.endswith("\n")
    assert_one_line(result.stderr, *parts)
