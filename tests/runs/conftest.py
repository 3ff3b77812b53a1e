"""Runs that several modules compare theirs with."""

import pytest

from tests.runs.runs import play


@pytest.fixture(scope="session")
def uninterrupted(tmp_path_factory):
    """The directory of a tiny run from start to end."""
    path = tmp_path_factory.mktemp("uninterrupted")
    _, result = play(path)
    assert (result.reason, result.iteration >= 4) == ("finished", True)
    return path
