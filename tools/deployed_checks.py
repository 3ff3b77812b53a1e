"""What a deployment has to show, one check after another; each says what it saw. ``tools.deployed`` runs them."""

from __future__ import annotations

import json
import os
import re
import signal
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from service.base.errors import TandemError
from tools.compose_services import Service
from tools.containers import Container, Containers

T = TypeVar("T")
WAIT_S = 300.0
"""For anything to happen, on a machine that may have other work to do."""
STATUS, PROMETHEUS, RAY = "http://127.0.0.1:8321", "http://127.0.0.1:9090", "http://127.0.0.1:8265"
"""What compose publishes on the machine."""
SMALL = ["game.num_worlds=8", "game.num_goals=2", "run.checkpoint_interval=2", "run.evaluation_interval=0"]
"""Settings of runs that have to work, and not to learn."""
SHORT = [*SMALL, "run.total_env_steps=20000"]
LONG = [*SMALL, "run.total_env_steps=1000000000"]
TASKS = ("push", "sphere")
NO_IMAGE = {"grafana": "Debian has no Grafana, and Docker Hub is out of reach"}
CAPABILITIES = ("CapEff", "CapPrm", "CapBnd")


@dataclass
class Deployment:
    """Everything that was deployed, and how to reach it from the machine."""

    home: Path
    services: Mapping[str, Service]
    variables: Mapping[str, str]
    containers: Containers
    job: str = ""
    """The newest long one, as Ray calls it."""

    @property
    def head(self) -> Container:
        """Where jobs are submitted."""
        return self.containers["head-1"]

    def up(self) -> list[str]:
        """Start everything that is to be started, in the order of compose, each when what it waits for is healthy."""
        names = []
        for service in self.services.values():
            if service.profiles or service.name in NO_IMAGE:
                continue
            for other in service.depends_on:
                if other.healthy:
                    wait(f"{other.service} is healthy", self.containers[f"{other.service}-1"].is_healthy)
            numbers = range(1, service.num_containers + 1)
            names += [self.containers.start(service, number=number).name for number in numbers]
        for name in names:
            wait(f"{name} is healthy", self.containers[name].is_healthy)
        return names

    def down(self) -> list[str]:
        """Stop everything, in the other order; return what did not end by SIGTERM."""
        names = [each.name for each in reversed(self.containers.all()) if each.runs]
        return [name for name in names if not self.containers.stop(name)]

    def submit(self, *command: str) -> str:
        """``ray job submit`` in the head, as the documents have it; what it printed when the job has ended."""
        job = self.head.run(["ray", "job", "submit", "--", *command], timeout_s=1800, check=False)
        if job.returncode != 0:
            raise TandemError(f"the job failed: {job.stdout[-1000:]}")
        return job.stdout

    def begin_long(self) -> None:
        """Submit a long pre-training, or go on with it, and leave it alone."""
        said = self.head.run(["ray", "job", "submit", "--no-wait", "--", *pretrain("long", LONG)]).stdout
        self.job = re.findall(r"raysubmit_\w+", said)[0]

    def ask(self, path: str, *, method: str = "GET", token: bool = True, url: str = STATUS) -> Any:
        """The answer of the status service, through nginx."""
        headers = {"Authorization": f"Bearer {self.variables['TANDEM_TOKEN']}"} if token else {}
        request = urllib.request.Request(url + path, method=method, headers=headers)
        with urllib.request.urlopen(request, timeout=30) as answer:
            return json.load(answer)

    def run_state(self, run_id: str) -> dict[str, Any]:
        """What the status service says of a run."""
        return dict(self.ask(f"/v1/runs/{run_id}"))

    def query(self, expression: str) -> list[Any]:
        """The rows of an answer of Prometheus."""
        path = "/api/v1/query?" + urllib.parse.urlencode({"query": expression})
        return list(self.ask(path, url=PROMETHEUS, token=False)["data"]["result"])


def pretrain(run_id: str, settings: Sequence[str] = ()) -> list[str]:
    """The command of a pre-training, as the documents have it."""
    words = ["tandem", "pretrain", "--runtime", "ray", "--address", "auto", "--status", "off", "--run-id", run_id]
    return words + [word for each in settings for word in ("--set", each)]


def wait(what: str, ask: Callable[[], T | None]) -> T:
    """Ask until the answer is true, and return it; services that are away are asked again."""
    end_s, last = time.monotonic() + WAIT_S, ""
    while time.monotonic() < end_s:
        try:
            if answer := ask():
                return answer
        except (OSError, TandemError, ValueError, LookupError) as error:
            last = f"; last: {error}"
        time.sleep(1.0)
    raise TandemError(f"waited {WAIT_S:.0f} s for: {what}{last}")


def status_code(ask: Callable[[], Any]) -> int:
    """The status of an answer."""
    try:
        ask()
    except urllib.error.HTTPError as error:
        return error.code
    return 200


def starts(deployment: Deployment) -> str:
    """Every service of compose.yaml starts in its order and is healthy."""
    names = deployment.up()
    left_out = {each.name: "a profile" for each in deployment.services.values() if each.profiles} | NO_IMAGE
    return f"healthy: {', '.join(names)}; not started: {'; '.join(f'{name}: {why}' for name, why in left_out.items())}"


def rights(deployment: Deployment) -> str:
    """No container has a capability, a program as root, or a way to get one."""
    users = {}
    for each in deployment.containers.all():
        status = each.status()
        assert all(int(status[name], 16) == 0 for name in CAPABILITIES), f"{each.name}: {status}"
        assert status["NoNewPrivs"] == "1", each.name
        users[each.name] = int(status["Uid"].split()[0])
        assert users[each.name] != 0, f"{each.name} runs as root"
    return f"no capability anywhere; users {users}"


def nodes(deployment: Deployment) -> str:
    """Ray has the head and every worker as nodes, each at its own address, and its jobs need the token."""
    expected = {each.address for each in deployment.containers.all() if each.service.name in ("head", "worker")}
    code = "import json, ray; ray.init('auto', logging_level='error'); print(json.dumps(ray.nodes()))"

    def found() -> list[dict[str, Any]]:
        listed = json.loads(deployment.head.run(["python", "-c", code]).stdout.splitlines()[-1])
        alive = [each for each in listed if each["Alive"]]
        return alive if {each["NodeManagerAddress"] for each in alive} == expected else []

    alive = wait(f"Ray has nodes at {sorted(expected)}", found)
    refused = status_code(lambda: deployment.ask("/api/jobs/", url=RAY, token=False))
    assert refused == 401, f"Ray's jobs without a token: {refused}"
    cpus = sum(each["Resources"].get("CPU", 0) for each in alive)
    least = min(each["Resources"]["memory"] + each["Resources"]["object_store_memory"] for each in alive)
    memory = f"Ray sees {least / 2**30:.1f} GiB where {deployment.services['worker'].memory_bytes} bytes are the limit"
    return f"{len(alive)} nodes with {cpus:.0f} cores; {memory}; jobs without the token: {refused}"


def pretrains(deployment: Deployment) -> str:
    """A job pre-trains on Ray and publishes; REST shows the run as finished and the version in the registry."""
    said = deployment.submit(*pretrain("first", SHORT))
    assert "succeeded" in said, said[-500:]
    run = wait("first is finished", lambda: _in_state(deployment, "first", "finished"))
    version = _mine(deployment)[-1]
    files = [each["name"] for each in deployment.ask("/v1/runs/first/files")["files"]]
    made = f"with {', '.join(files)}; panda-cube@{version} is published"
    return f"{run['state']} after {run['num_env_steps']} env steps, {made}"


def downstream(deployment: Deployment) -> str:
    """Jobs learn two tasks, from primitives of the registry's URL; REST shows them as runs that have finished."""
    source = ["--registry", "http://status:8321", "--primitives", "panda-cube@latest"]
    settings = [f"--set={each}" for each in ("run.total_env_steps=7000", "run.final_episodes=4")]
    for task in TASKS:
        deployment.submit("tandem", "train", task, "--run-id", task, *source, *settings)
    found = {task: wait(task, partial(_in_state, deployment, task, "finished")) for task in TASKS}
    return "; ".join(f"{task}: {run['state']} after {run['num_env_steps']} env steps" for task, run in found.items())


def begins_long(deployment: Deployment) -> str:
    """A job that was submitted with --no-wait goes on, and REST shows it through nginx, with its actors."""
    deployment.begin_long()
    run = wait("long runs, and learns", lambda: _beyond(deployment, "long", 2))
    refused = status_code(lambda: deployment.ask("/v1/runs/long", token=False))
    assert refused == 401, refused
    with urllib.request.urlopen(STATUS + "/livez", timeout=30) as answer:
        server = answer.headers["Server"]
    assert server == "nginx", server
    actors = f"{_alive(run)} actors alive"
    return f"{run['state']}, iteration {run['iteration']}, {actors}; from {server}; without a token: {refused}"


def begins_once(deployment: Deployment) -> str:
    """A second driver with the same run id is refused with one line, and the first goes on."""
    job = deployment.head.run(["ray", "job", "submit", "--", *pretrain("long")], check=False)
    lines = {line for line in job.stdout.splitlines() if line.startswith("error: ")}
    assert job.returncode == 1, job.returncode
    assert len(lines) == 1, job.stdout[-1000:]
    assert "Traceback" not in job.stdout, job.stdout[-1000:]
    _goes_on(deployment)
    return lines.pop()


def scrapes(deployment: Deployment) -> str:
    """Prometheus reaches the status service and every Ray node, with the addresses that DNS gives it."""
    num_nodes = 1 + deployment.services["worker"].num_containers

    def all_up() -> list[Any]:
        targets = list(deployment.ask("/api/v1/targets", url=PROMETHEUS, token=False)["data"]["activeTargets"])
        up = [each for each in targets if each["health"] == "up"]
        return up if len(up) == len(targets) == 1 + num_nodes else []

    up = wait("all targets are up", all_up)
    places = sorted(f"{each['labels']['job']} {each['labels']['instance']}" for each in up)
    return f"{len(up)} of {len(up)} targets up: {', '.join(places)}"


def loads_alerts(deployment: Deployment) -> str:
    """All alert rules are loaded and evaluated without an error."""

    def rules() -> list[Any]:
        groups = deployment.ask("/api/v1/rules", url=PROMETHEUS, token=False)["data"]["groups"]
        found = [rule for group in groups for rule in group["rules"]]
        return found if found and all(each["health"] == "ok" for each in found) else []

    found = wait("all rules are evaluated", rules)
    written = (deployment.home / "deploy" / "prometheus" / "alerts.yml").read_text().count("- alert: ")
    assert len(found) == written, (len(found), written)
    firing = sorted(each["name"] for each in found if each["state"] == "firing")
    return f"{len(found)} rules, all well; firing: {', '.join(firing) or 'none'}"


def grafana_rows(deployment: Deployment) -> str:
    """Every query of Grafana's dashboard is answered by the real Prometheus, with rows while a run goes on."""
    tree = json.loads((deployment.home / "deploy" / "grafana" / "tandem.json").read_text())
    queries = {
        f"{panel['title']}: {target['expr']}": target["expr"]
        for panel in tree["panels"]
        for target in panel.get("targets", [])
    }
    queries |= {each["name"]: each["expr"] for each in tree["annotations"]["list"]}
    rows = {}
    for name, expression in queries.items():
        filled = expression.replace("$run", ".*").replace("$__rate_interval", "1m").replace("$__range", "1h")
        rows[name] = len(deployment.query(filled))
    empty = sorted(name for name, number in rows.items() if number == 0)
    assert len(empty) < len(rows) / 4, empty
    return f"{len(rows) - len(empty)} of {len(rows)} queries have rows; without: {'; '.join(empty) or 'none'}"


def raises_an_alert(deployment: Deployment) -> str:
    """A driver that is frozen raises RunStuck; when it goes on, so does the run, and the alert ends."""
    firing = 'ALERTS{alertname="RunStuck", alertstate="firing", run="long"}'
    driver, begun_s = _driver("long"), time.monotonic()
    os.kill(driver, signal.SIGSTOP)
    try:
        wait("RunStuck fires", lambda: deployment.query(firing))
        raised_s = time.monotonic() - begun_s
    finally:
        os.kill(driver, signal.SIGCONT)
    wait("RunStuck ends", lambda: not deployment.query(firing))
    _goes_on(deployment)
    return f"RunStuck fired {raised_s:.0f} s after the driver was frozen, and ended when it went on"


def loses_a_node(deployment: Deployment) -> str:
    """A worker node is killed with all its processes: the run goes on, and has all its actors when the node is back."""
    before, worker = deployment.run_state("long"), deployment.containers["worker-2"]
    worker.kill()
    after = _goes_on(deployment)
    wait("worker-2 is healthy again", worker.is_healthy)
    wait("all actors are back", lambda: _alive(deployment.run_state("long")) >= _alive(before))
    later = _goes_on(deployment)
    assert worker.num_starts == 2, worker.num_starts
    replaced = later["totals"]["replacements"]
    steps = f"iteration {before['iteration']} before, {after['iteration']} after the kill"
    return (
        f"{steps}, {later['iteration']} with {_alive(later)} actors alive again; {replaced} replaced; {later['state']}"
    )


def loses_redis(deployment: Deployment) -> str:
    """Redis is killed: the run goes on, Redis starts again with its data, and the run reports to it again."""
    redis = deployment.containers["redis-1"]
    before = len(_keys(redis))
    redis.kill()
    _goes_on(deployment)
    wait("redis-1 is healthy again", redis.is_healthy)
    wait("the run reports to it", lambda: deployment.run_state("long")["condition"] == "well")
    after = len(_keys(redis))
    assert after >= before > 0, (before, after)
    return f"{before} keys before, {after} after"


def serves_from_redis(deployment: Deployment) -> str:
    """A status service without the volume of runs shows the run from Redis, with its history."""
    elsewhere = replace(deployment.services["status"], name="elsewhere", mounts=[], ports=[])
    container = deployment.containers.start(elsewhere)
    try:
        wait("it is healthy", container.is_healthy)
        url = f"http://{container.address}:8321"
        run = wait("it shows the run", lambda: _beyond(deployment, "long", 1, url))
        later = wait("it shows more", lambda: _beyond(deployment, "long", run["iteration"] + 1, url))
        rows = deployment.ask("/v1/runs/long/metrics?names=learner/version", url=url)["iteration"]
        assert container.run(["ls", "/var/lib/tandem/runs"]).stdout == ""
    finally:
        deployment.containers.stop(container.name)
    return f"{run['state']} at iterations {run['iteration']} and {later['iteration']}, {len(rows)} records, no file"


def stops_by_rest(deployment: Deployment) -> str:
    """A stop over REST ends the run saved, and the same submit goes on from there; then a second stop ends it."""
    first = _stop(deployment)
    deployment.begin_long()
    wait("long goes on", lambda: _beyond(deployment, "long", first + 1))
    return f"ended, saved, at iteration {first}; went on; ended at {_stop(deployment)}"


def goes_down_and_up(deployment: Deployment) -> str:
    """Everything stops and starts again in compose's order: runs, registry, history and samples are there as before."""
    runs, versions, count = _iterations(deployment), _mine(deployment), "count_over_time(tandem_store_up[1h])"
    samples = int(deployment.query(count)[0]["value"][1])
    killed = deployment.down()
    names = deployment.up()
    assert _iterations(deployment) == runs, (runs, _iterations(deployment))
    assert _mine(deployment) == versions
    wait("Prometheus has its samples", lambda: int(deployment.query(count)[0]["value"][1]) >= samples)
    deployment.begin_long()
    run = wait("long goes on", lambda: _beyond(deployment, "long", runs["long"] + 1))
    forced = f"SIGKILL was needed for {', '.join(killed) or 'none'}"
    return f"{len(names)} containers; {forced}; iterations {runs} as before; long goes on at {run['iteration']}"


def ends_saved(deployment: Deployment) -> str:
    """``ray job stop`` ends the run saved, and every service ends within its time."""
    deployment.head.run(["ray", "job", "stop", deployment.job])
    ended = wait("long has ended", lambda: _in_state(deployment, "long", "interrupted"))
    killed = deployment.down()
    assert killed == [], killed
    return f"{ended['state']} at iteration {ended['iteration']}; SIGTERM was enough for all"


CHECKS: Mapping[str, Callable[[Deployment], str]] = {
    each.__name__: each
    for each in (
        starts, rights, nodes, pretrains, downstream, begins_long, begins_once, scrapes, loads_alerts, grafana_rows,
        raises_an_alert, loses_a_node, loses_redis, serves_from_redis, stops_by_rest, goes_down_and_up, ends_saved,
    )
}  # fmt: skip
"""In the order in which they are made; each builds on those before it."""


def _in_state(deployment: Deployment, run_id: str, state: str) -> dict[str, Any] | None:
    run = deployment.run_state(run_id)
    return run if run["state"] == state else None


def _beyond(deployment: Deployment, run_id: str, iteration: int, url: str = STATUS) -> dict[str, Any] | None:
    run = dict(deployment.ask(f"/v1/runs/{run_id}", url=url))
    return run if run["state"] == "running" and run["iteration"] >= iteration else None


def _goes_on(deployment: Deployment) -> dict[str, Any]:
    """The long run, three iterations later."""
    now = deployment.run_state("long")["iteration"]
    return wait(f"long goes on after {now}", lambda: _beyond(deployment, "long", now + 3))


def _stop(deployment: Deployment) -> int:
    """Stop the long run over REST; its last iteration."""
    deployment.ask("/v1/runs/long/stop", method="POST")
    return int(wait("long has ended", lambda: _in_state(deployment, "long", "interrupted"))["iteration"])


def _iterations(deployment: Deployment) -> dict[str, int]:
    return {each["run_id"]: each["iteration"] for each in deployment.ask("/v1/runs")["runs"]}


def _mine(deployment: Deployment) -> list[int]:
    """The versions that were published here."""
    listed = deployment.ask("/v1/primitives/panda-cube")["versions"]
    return [each["version"] for each in listed if each["origin"] == "registry"]


def _alive(run: Mapping[str, Any]) -> int:
    return sum(each["state"] == "alive" for each in run["actors"])


def _keys(redis: Container) -> list[str]:
    ask = 'REDISCLI_AUTH="$(cat /run/secrets/redis_password)" redis-cli --scan'
    return redis.run(["sh", "-c", ask]).stdout.split()


def _driver(run_id: str) -> int:
    """The process of a run's driver, as this machine numbers it."""
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
            if b"--run-id" in words and run_id.encode() in words and b"pretrain" in words and b"python" in words[0]:
                return int(entry.name)
    raise TandemError(f"no process drives {run_id}")
