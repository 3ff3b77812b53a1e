"""The commit of the program."""

import subprocess
from pathlib import Path

from service.base import version
from service.base.version import git_commit

ROOT = Path(__file__).parents[2]


def test_the_commit_is_of_this_checkout_or_none():
    command = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    expected = said if (ROOT / ".git").exists() else ""  # not the commit of somebody else's repository around it
    assert (git_commit() or "").removesuffix("-dirty") == expected


def test_local_changes_are_told_and_a_repository_around_an_installation_is_not_its_own(monkeypatch):
    here, asked = str(Path(version.__file__).resolve().parents[2]), []

    def answering(top):
        def git(root, *arguments):
            asked.append(arguments)
            return top if arguments[0] == "rev-parse" else "0123-dirty"

        monkeypatch.setattr(version, "_git", git)
        return git_commit.__wrapped__()

    assert answering(None) is None
    assert answering(str(Path(here).parent)) is None
    assert answering(here) == "0123-dirty"
    assert "--dirty" in asked[-1]
