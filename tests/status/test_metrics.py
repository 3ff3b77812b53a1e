"""The text of ``/metrics``, parsed by Prometheus' own parser."""

import re
from datetime import UTC, datetime, timedelta

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.status import metrics
from service.status.metrics import HTTP_METRICS, NUM_ENDED_RUNS, RUN_METRICS, SERVICE_METRICS
from service.store.models import CONDITIONS
from tests.status.conftest import serve
from tests.status.runs import BEARER, CLIENT, append, record, status, write_runs, write_status


@pytest.fixture
def service(tmp_path):
    """The pair (client, directory of runs), after one request."""
    write_runs(tmp_path / "runs")
    with serve(tmp_path) as server, httpx.Client(base_url=server.url, headers=BEARER, **CLIENT) as client:
        client.get("/v1/runs/old")
        yield client, tmp_path / "runs"


def scrape(client):
    """Values by name and labels."""
    answer = client.get("/metrics")
    assert (answer.status_code, answer.headers["content-type"]) == (200, metrics.CONTENT_TYPE)
    families = text_string_to_metric_families(answer.text)
    return {(each.name, *sorted(each.labels.items())): each.value for family in families for each in family.samples}


def value(samples, name, /, **labels):
    return samples[(name, *sorted(labels.items()))]


def test_metrics_of_a_run(service):
    samples = scrape(service[0])
    expected = {
        "tandem_run_iteration": 3,
        "tandem_run_env_steps": 3000,
        "tandem_run_iterations_total": 4,
        "tandem_run_env_steps_total": 3900,
        "tandem_run_env_steps_budget": 10_000,
        "tandem_run_env_steps_per_second": 500,
        "tandem_run_policy_version": 2,
        "tandem_run_policy_lag_versions": 1,
        "tandem_run_rollouts_counted_total": 6,
        "tandem_run_rollouts_refused_total": 1,
        "tandem_run_actor_replacements_total": 3,
        "tandem_run_valid_goals_ratio": 0.5,
        "tandem_run_lifted_goals_ratio": 0.25,
        "tandem_run_bob_success_ratio": 0.375,
        "tandem_run_learner_idle_ratio": 0.0625,
        "tandem_run_stopping": 0,
        "tandem_run_warnings": 0,
    }
    assert {name: value(samples, name, run="cube") for name in expected} == expected
    assert value(samples, "tandem_run_actors", run="cube", state="alive") == 2
    assert value(samples, "tandem_run_actors", run="cube", state="starting") == 1
    assert value(samples, "tandem_run_info", run="cube", name="panda-cube", runtime="ray") == 1
    assert value(samples, "tandem_run_state", run="cube", state="running") == 1
    assert value(samples, "tandem_run_state", run="cube", state="failed") == 0
    assert value(samples, "tandem_run_condition", run="cube", condition="well") == 1
    assert value(samples, "tandem_run_condition", run="cube", condition="disk") == 0
    assert 0 <= value(samples, "tandem_run_heartbeat_age_seconds", run="cube") < 3600
    assert value(samples, "tandem_runs", state="finished") == value(samples, "tandem_runs", state="running") == 1


def test_what_a_run_suffers_from(service):
    """Alerts are made of it."""
    client, runs = service
    write_status(runs, "cube", condition="disk", warnings=("cannot write checkpoints",))
    samples = scrape(client)
    conditions = {name: value(samples, "tandem_run_condition", run="cube", condition=name) for name in CONDITIONS}
    assert {name for name, holds in conditions.items() if holds} == {"disk"}
    assert value(samples, "tandem_run_warnings", run="cube") == 1


def test_missing_metrics_are_left_out(service):
    client, runs = service
    append(runs, "cube", record(4, **{"bob/success_rate": None}))
    samples = scrape(client)
    assert ("tandem_run_bob_success_ratio", ("run", "cube")) not in samples
    assert ("tandem_run_bob_success_air_ratio", ("run", "cube")) not in samples
    assert ("tandem_run_bob_success_ratio", ("run", "old")) in samples


def test_actors_of_an_ended_run_cause_no_alert(service):
    client, runs = service
    write_status(runs, "cube", state="failed")
    assert [
        key for key in scrape(client) if key[0] in ("tandem_run_actors", "tandem_run_actor_heartbeat_age_seconds")
    ] == []


def test_an_actor_that_has_not_started_is_not_silent(service):
    client, runs = service
    alive, starting, learner = status("cube").actors
    long_ago = starting.model_copy(update={"heartbeat": starting.heartbeat - timedelta(hours=1)})
    write_status(runs, "cube", actors=(alive, long_ago, learner))
    assert value(scrape(client), "tandem_run_actor_heartbeat_age_seconds", run="cube") < 1800
    write_status(runs, "cube", actors=(long_ago,))
    assert ("tandem_run_actor_heartbeat_age_seconds", ("run", "cube")) not in scrape(client)


def test_an_actor_of_a_machine_whose_clock_is_slow_is_not_silent(service):
    client, runs = service
    then = datetime.now(UTC) - timedelta(seconds=30)
    actor, _, learner = status("cube").actors
    late, newest = (then + timedelta(seconds=each) for each in (0, 7))
    actors = actor.model_copy(update={"heartbeat": late}), learner.model_copy(update={"heartbeat": newest})
    write_status(runs, "cube", heartbeat=newest, actors=actors)
    assert value(scrape(client), "tandem_run_actor_heartbeat_age_seconds", run="cube") == 7


def test_actors_are_not_silent_while_the_run_measures_at_its_end(service):
    client, runs = service
    now = datetime.now(UTC)
    actors = tuple(each.model_copy(update={"heartbeat": now - timedelta(hours=1)}) for each in status("cube").actors)
    write_status(runs, "cube", heartbeat=now, actors=actors)
    assert value(scrape(client), "tandem_run_actor_heartbeat_age_seconds", run="cube") == 0


def test_the_registry(tmp_path, home):
    with serve(home) as server, httpx.Client(base_url=server.url, **CLIENT) as client:
        samples = scrape(client)
    assert value(samples, "tandem_registry_up") == 1
    assert value(samples, "tandem_registry_versions", name="tiny") == 2
    assert value(samples, "tandem_registry_alias_version", name="tiny", alias="champion") == 1


def test_requests_by_route_and_never_by_path(service):
    client, _ = service
    for path in ("/v1/runs/a", "/v1/runs/b", "/x", "/y"):
        client.get(path)
    httpx.request("PROPFIND", f"{client.base_url}/x", **CLIENT)
    samples = scrape(client)
    route = "/v1/runs/{run_id}"
    assert value(samples, "tandem_http_requests_total", method="GET", route=route, status="200") == 1
    assert value(samples, "tandem_http_requests_total", method="GET", route=route, status="404") == 2
    assert value(samples, "tandem_http_requests_total", method="GET", route="other", status="404") == 2
    assert value(samples, "tandem_http_requests_total", method="other", route="other", status="401") == 1
    assert value(samples, "tandem_http_request_duration_seconds_count", route=route) == 3


def test_the_store_is_away(service):
    client, runs = service
    runs.rename(runs.parent / "elsewhere")
    samples = scrape(client)
    assert value(samples, "tandem_store_up") == 0
    assert [key for key in samples if key[0].startswith("tandem_run")] == []
    assert value(samples, "tandem_registry_up") == 1


def test_a_damaged_name_hides_no_other(service, caplog):
    client, runs = service
    for name, alias in (("damaged", "none"), ("tiny", "1")):
        model = runs.parent / "registry" / "models" / name
        (model / "aliases").mkdir(parents=True)
        (model / "aliases" / "latest").write_text(alias)
        (model / "versions").mkdir()
        (model / "versions" / "1").write_text("{}")
    samples = scrape(client)
    assert value(samples, "tandem_registry_up") == 1
    assert value(samples, "tandem_registry_alias_version", name="tiny", alias="latest") == 1
    assert "/metrics has not all of damaged in the registry" in caplog.text


def test_a_registry_that_cannot_be_read(service):
    client, runs = service
    (runs.parent / "registry").write_text("a file where a directory should be")
    samples = scrape(client)
    assert value(samples, "tandem_registry_up") == 0
    assert [key for key in samples if key[0].startswith("tandem_registry_")] == [("tandem_registry_up",)]


def test_the_number_of_series_is_bounded():
    when, hour = datetime(2026, 1, 1, tzinfo=UTC), timedelta(hours=1)
    runs = [
        status(f"run-{number}", state=state, started=when - number * hour, heartbeat=when - number * hour)
        for number, state in enumerate(["finished", "running"] * 600)
    ]
    runs[-1] = runs[-1].suffering("stuck", "it hangs")
    runs[-3] = runs[-3].suffering("disk", "it is full")
    ids = [run.run_id for run in metrics.shown(runs)]
    assert ids[:4] == ["run-1199", "run-1197", "run-1", "run-3"]
    ended = [f"run-{n}" for n in range(0, 2 * NUM_ENDED_RUNS, 2)]
    assert ids[metrics.MAX_ACTIVE_RUNS :] == ended  # however many are active: or none that fails would be told of
    ids = [run.run_id for run in metrics.shown(runs[:60])]
    assert ids == [f"run-{n}" for n in range(1, 60, 2)] + ended


def test_a_long_run_that_failed_just_now_is_shown():
    when, hour = datetime(2026, 1, 1, tzinfo=UTC), timedelta(hours=1)
    ended = [when - number * hour for number in range(2 * NUM_ENDED_RUNS)]
    short = [status(f"wall-{n}", state="finished", started=at, heartbeat=at) for n, at in enumerate(ended)]
    failed = status("cube", state="failed", started=when - 100 * hour, heartbeat=when)
    ids = [run.run_id for run in metrics.shown([*short, failed])]
    assert ids == ["wall-0", "cube", *(f"wall-{n}" for n in range(1, NUM_ENDED_RUNS - 1))]


def test_a_run_that_was_interrupted_minutes_ago_is_shown_however_many_have_ended_since():
    now, minute = datetime.now(UTC), timedelta(minutes=1)
    later = [status(f"wall-{n}", state="finished", heartbeat=now) for n in range(NUM_ENDED_RUNS)]
    killed = [status(f"killed-{n}", state="interrupted", heartbeat=now - n * minute) for n in (5, 70)]
    ids = [run.run_id for run in metrics.shown([*later, *killed])]
    assert (ids[0], len(ids)) == ("killed-5", NUM_ENDED_RUNS)
    assert "killed-70" not in ids


def test_everything_served_is_in_the_reference(service):
    served = {family.name: family for family in text_string_to_metric_families(service[0].get("/metrics").text)}
    reference = {
        metric.name.removesuffix("_total"): metric for metric in (*RUN_METRICS, *SERVICE_METRICS, *HTTP_METRICS)
    }
    own = {name for name in served if not name.startswith("tandem_process_") and not name.endswith("_created")}
    assert own == set(reference)
    assert "tandem_process_resident_memory_bytes" in served
    for name in own:
        assert (served[name].type, served[name].documentation) == (reference[name].kind, reference[name].help)
        labels = {label for sample in served[name].samples for label in sample.labels} - {"le"}
        assert labels <= set(reference[name].labels)


def test_names_follow_prometheus():
    for metric in (*RUN_METRICS, *SERVICE_METRICS, *HTTP_METRICS):
        assert re.fullmatch(r"tandem_[a-z_]+", metric.name)
        assert metric.name.endswith("_total") == (metric.kind == "counter")
