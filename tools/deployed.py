"""Deploys ``deploy/compose`` on this machine without Docker, and checks that all of it works together.

    python -m tools.deployed --json docs/results/deployed.json
    python -m tools.deployed --wheels DIR       # torch from a directory, where its index is out of reach

Needs root, Debian's archive and a package index. Builds the image from the Dockerfile, and starts every service with
the command, environment, user, secrets and mounts of ``compose.yaml``, each in namespaces of its own. Grafana is not in
Debian: its dashboard's queries are asked of the real Prometheus. Takes about half an hour the first time; what was
built stays in ``--home``. All containers, mounts and networks end with this program, however it ends.
"""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.measuring import ROOT, machine, one_line_errors, write_json
from service.base.errors import TandemError
from tools.compose_services import read_services, read_variables
from tools.containers import Containers, need_programs, remove_memory_groups, run
from tools.deployed_checks import CHECKS, Deployment
from tools.images import Store

PROGRAMS = ("buildah", "debootstrap", "dnsmasq", "ip", "nsenter", "setpriv", "socat", "tini-static", "unshare")
SPACES = ("--mount", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")
HOME = Path("/var/tmp/tandem-deployed")
INSIDE = "TANDEM_DEPLOYED_INSIDE"
_log = logging.getLogger("deployed")


@one_line_errors
def main() -> int:
    """Parse the command line; build; start again in namespaces of our own, and check there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--home", type=Path, metavar="DIR", default=HOME, help="default: %(default)s")
    parser.add_argument("--wheels", type=Path, metavar="DIR", help="has a wheel of torch; default: torch's own index")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result")
    given = parser.parse_args()
    logging.basicConfig(format="%(asctime)s %(message)s", level=logging.INFO)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    store = Store(given.home)
    if INSIDE in os.environ:
        return check(store, Path(os.environ[INSIDE]), given.json)
    return build_and_enter(store, given.wheels)


def build_and_enter(store: Store, wheels: Path | None) -> int:
    """Build the images, and start this program again in namespaces of its own; clean up behind it."""
    if os.geteuid() != 0:
        raise TandemError("needs root: it makes mounts, networks and users of containers")
    need_programs(PROGRAMS)
    begun_s = time.monotonic()
    store.build(wheels)
    _log.info("the images are there after %.0f s", time.monotonic() - begun_s)
    with tempfile.TemporaryDirectory(prefix="tandem-deployed-", dir="/var/tmp") as home:
        command = ["unshare", *SPACES, sys.executable, "-m", "tools.deployed", *sys.argv[1:]]
        try:
            return subprocess.run(command, env=os.environ | {INSIDE: home}, check=False).returncode
        finally:
            remove_memory_groups()
            store.forget()


def check(store: Store, home: Path, file: Path | None) -> int:
    """Make all checks in order, also after one has failed; 1 if one did."""
    shutil.copytree(ROOT / "deploy", home / "deploy", ignore=shutil.ignore_patterns(".env"))
    run(["sh", str(home / "deploy" / "compose" / "make-env.sh")])
    variables = read_variables(home / "deploy" / "compose" / ".env")
    services = read_services(home / "deploy" / "compose" / "compose.yaml", variables)
    deployment = Deployment(home, services, variables, Containers(home, store.images()))
    results = [_make(name, each, deployment) for name, each in CHECKS.items()]
    deployment.down()
    failed = any(each["outcome"] == "failed" for each in results)
    if failed:
        kept = store.directory / "last-failure"
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(home / "logs", kept)
        _log.info("the logs of all containers are in %s", kept)
    if file is not None:
        result = {"tool": "deployed", "recorded": machine(), "image": store.describe(), "checks": results}
        write_json(file, result)
    return int(failed)


def _make(name: str, function: Callable[[Deployment], Any], deployment: Deployment) -> dict[str, Any]:
    begun_s, outcome = time.monotonic(), "passed"
    try:
        seen = function(deployment)
    except (TandemError, AssertionError, OSError, ValueError, LookupError, subprocess.TimeoutExpired) as error:
        outcome, seen = "failed", f"{type(error).__name__}: {error}"
    seconds = round(time.monotonic() - begun_s, 1)
    _log.info("%7.1f s  %-8s %s: %s", seconds, outcome, name, seen)
    what = (function.__doc__ or "").strip()
    return {"name": name, "what": what, "outcome": outcome, "seconds": seconds, "seen": seen}


if __name__ == "__main__":
    raise SystemExit(main())
