"""The commit of the program."""

import subprocess
from pathlib import Path

from service.base.version import git_commit

ROOT = Path(__file__).parents[2]


def test_the_commit_is_of_this_checkout_or_none():
    command = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    expected = said if (ROOT / ".git").exists() else ""  # not the commit of somebody else's repository around it
    assert (git_commit() or "").removesuffix("-dirty") == expected
