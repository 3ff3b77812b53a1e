"""Prometheus and Grafana: what they ask for is what the service exports, and the alerts do what they say."""

import ast
import importlib.util
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from service.status.metrics import HTTP_METRICS, RUN_METRICS, SERVICE_METRICS
from service.store.models import CONDITIONS
from tests.deploy.files import DEPLOY, PROMETHEUS, ROOT, load, scrape_job, walk

ALERTS = [
    (group["name"], rule) for group in load(DEPLOY / "prometheus" / "alerts.yml")["groups"] for rule in group["rules"]
]
DASHBOARD = json.loads((DEPLOY / "grafana" / "tandem.json").read_text())
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
OPERATIONS = (ROOT / "docs" / "operations.md").read_text()
OTHERS = {
    # prometheus_client's own, of the status service's process
    "tandem_process_resident_memory_bytes": set(),
    # the kubelet's; there is nothing to check them against
    "kubelet_volume_stats_available_bytes": {"namespace", "persistentvolumeclaim"},
    "kubelet_volume_stats_capacity_bytes": {"namespace", "persistentvolumeclaim"},
}
FUNCTIONS = {
    "absent", "avg", "avg_over_time", "histogram_quantile", "increase", "max_over_time", "min_over_time", "rate", "sum",
    "label_values", "time",
}  # fmt: skip
WORDS = {"and", "by", "offset", "on", "or", "unless", "le", "run"}


def exported():
    """Every name that can be asked for, with its labels."""
    names = dict(OTHERS)
    for metric in (*RUN_METRICS, *SERVICE_METRICS, *HTTP_METRICS):
        if metric.kind == "histogram":
            names |= {f"{metric.name}_bucket": {*metric.labels, "le"}}
            names |= {f"{metric.name}_{suffix}": set(metric.labels) for suffix in ("sum", "count")}
        else:
            names[metric.name] = set(metric.labels)
    for kind, name, labels in actor_metrics():
        suffixes = {"Counter": ["_total"], "Gauge": [""], "Histogram": ["_bucket", "_sum", "_count"]}[kind]
        names |= {f"ray_{name}{suffix}": {*labels, "le"} for suffix in suffixes}
    ray = Path(importlib.util.find_spec("ray").origin).parent
    source = (ray / "dashboard" / "modules" / "reporter" / "reporter_agent.py").read_text()
    names |= {f"ray_{name}": {"instance"} for name in re.findall(r'^    "(node_\w+)": Gauge\(', source, re.MULTILINE)}
    return names


def actor_metrics():
    """Kind, name and labels of each of the actors' own metrics, as the source makes them."""
    tree = ast.parse((ROOT / "service" / "cluster" / "ray_actors.py").read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("Counter", "Gauge", "Histogram"):
            (keys,) = [keyword.value for keyword in node.keywords if keyword.arg == "tag_keys"]
            yield node.func.id, node.args[0].value, ast.literal_eval(keys)


EXPORTED = exported()


def expressions():
    """Every query: where it stands, and its text."""
    found = [(rule["alert"], rule["expr"]) for _, rule in ALERTS]
    found += [(panel["title"], target["expr"]) for panel in PANELS for target in panel["targets"]]
    found += [(each["name"], each["expr"]) for each in DASHBOARD["annotations"]["list"]]
    found += [(each["name"], each["definition"]) for each in DASHBOARD["templating"]["list"] if "definition" in each]
    return found


def unknown(expression):
    """What a query asks for that nobody exports."""
    found = []
    for name, matchers in re.findall(r"(\w+)\{([^}]*)\}", expression):
        labels = set(re.findall(r'(\w+)\s*(?:=~|!~|!=|=)\s*"', matchers))
        found += [f"{name}{{{label}}}" for label in labels - EXPORTED.get(name, labels)]
    bare = re.sub(r"\{[^}]*\}|\[[^\]]*\]|\b(?:by|on) \([^)]*\)|offset \w+", " ", expression)
    return found + [word for word in re.findall(r"[A-Za-z_]\w*", bare) if word not in {*EXPORTED, *FUNCTIONS, *WORDS}]


@pytest.mark.parametrize(("where", "expression"), expressions())
def test_only_what_is_exported_is_asked_for(where, expression):
    assert unknown(expression) == []


def test_a_metric_or_label_that_is_not_there_is_found():
    assert unknown("rate(tandem_run_env_step_total[5m])") == ["tandem_run_env_step_total"]
    assert unknown('tandem_run_state{stat="running"} == 1') == ["tandem_run_state{stat}"]
    assert unknown("sum by (actor) (rate(ray_tandem_actor_env_steps[5m]))") == ["ray_tandem_actor_env_steps"]
    assert unknown("ray_node_disk_fre > 1") == ["ray_node_disk_fre"]


@pytest.mark.parametrize(("group", "rule"), ALERTS, ids=lambda each: each["alert"] if isinstance(each, dict) else each)
def test_alerts_say_what_is_wrong_and_where_to_read_on(group, rule):
    assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
    assert re.fullmatch(r"([A-Z][a-z]*)+", rule["alert"])
    assert rule["labels"].keys() == {"severity"}
    assert rule["labels"]["severity"] in {"page", "warning"}
    assert rule["annotations"].keys() == {"summary", "runbook"}
    assert rule["annotations"]["runbook"] == f"docs/operations.md#{rule['alert'].lower()}"
    assert len(re.findall(rf"^#+ {rule['alert']}$", OPERATIONS, re.MULTILINE)) == 1


def test_every_documented_alert_is_one():
    section = OPERATIONS.split("\n## Alerts\n")[1].split("\n## ")[0]
    assert re.findall(r"^### (\w+)$", section, re.MULTILINE) == [rule["alert"] for _, rule in ALERTS]


def test_every_condition_of_a_run_has_an_alert():
    asked = [
        re.match(r'tandem_run_condition\{condition="(\w+)"\} == 1( and| unless|$)', rule["expr"]) for _, rule in ALERTS
    ]
    assert {found[1] for found in asked if found is not None} == set(CONDITIONS) - {"well"}


def test_what_is_missing_is_missed_only_of_runs_that_had_it():
    asked = [rule["expr"] for _, rule in ALERTS]
    missed = [(each, name) for each in asked for name in re.findall(r"unless on \(run\) (\w+)\b(?!\{)", each)]
    assert missed
    assert all(f"max_over_time({name}[" in each for each, name in missed)


def test_only_the_alert_about_redis_sends_people_there():
    """Without Redis the service reads the run directories, and ``tandem_store_up`` stays 1."""
    summaries = {rule["alert"]: rule["annotations"]["summary"] for _, rule in ALERTS}
    assert [alert for alert, summary in summaries.items() if "Redis" in summary] == ["RunWithoutRedis"]


def test_every_trouble_has_an_alert_that_was_seen_to_fire():
    groups = load(ROOT / "tests" / "deploy" / "alerts_test.yml")["tests"]
    cases = [case for group in groups for case in group.get("alert_rule_test", [])]
    fired = {case["alertname"] for case in cases if case.get("exp_alerts")}
    asked = [question for group in groups for question in group.get("promql_expr_test", [])]
    for sample in [each for question in asked for each in question["exp_samples"] if each["value"] > 0]:
        fired |= set(re.findall(r'alertname="(\w+)"', sample["labels"]))
    assert {rule["alert"] for _, rule in ALERTS} <= fired


@pytest.mark.skipif(shutil.which("promtool") is None, reason="needs promtool, which comes with Prometheus, on PATH")
def test_promtool_agrees(tmp_path):
    for name in ("prometheus.yml", "alerts.yml"):
        text = re.sub(r"^# (alerting:|  .*)", r"\1", (DEPLOY / "prometheus" / name).read_text(), flags=re.MULTILINE)
        assert (name == "prometheus.yml") == ("\nalerting:\n" in text)  # as somebody who has an Alertmanager makes it
        (tmp_path / name).write_text(text.replace("/run/secrets/tandem_token", str(tmp_path / "token")))
    (tmp_path / "token").write_text("x")
    shutil.copy(ROOT / "tests" / "deploy" / "alerts_test.yml", tmp_path)
    for command in (["check", "config", "prometheus.yml"], ["test", "rules", "alerts_test.yml"]):
        result = subprocess.run(
            ["promtool", *command], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
        )
        assert result.returncode == 0, result.stdout + result.stderr


def test_prometheus_takes_the_rules_that_are_there():
    assert load(PROMETHEUS)["rule_files"] == ["alerts.yml"]
    (keep,) = scrape_job("ray")["metric_relabel_configs"]
    kept = re.compile(keep["regex"])
    asked = {name for _, expression in expressions() for name in re.findall(r"\bray_\w+", expression)}
    assert asked
    assert all(kept.fullmatch(name) for name in asked)
    assert not kept.fullmatch("ray_gcs_storage_operation_latency_ms_bucket")


def test_the_dashboard_is_whole():
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(set(ids)) == len(ids)
    (datasource, run) = DASHBOARD["templating"]["list"]
    assert (datasource["name"], datasource["query"], run["name"]) == ("datasource", "prometheus", "run")
    # Taken from the variable, so that it can be imported anywhere.
    uids = {value for path, value in walk(DASHBOARD) if path[-1] == "uid"}
    assert uids == {"${datasource}", "tandem"}
    for panel in PANELS:
        assert panel["title"]
        assert panel["description"], panel["title"]
        assert panel["targets"], panel["title"]
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24


def test_the_dashboard_shows_what_people_ask_for():
    queries = " ".join(target["expr"] for panel in PANELS for target in panel["targets"])
    not_shown = {metric.name for metric in (*RUN_METRICS, *SERVICE_METRICS) if metric.name not in queries}
    # A name for the menu, a mark in time, what the state says, what is known from the rate, names of versions.
    assert not_shown == {
        "tandem_run_info", "tandem_run_started_timestamp_seconds", "tandem_run_stopping", "tandem_run_iterations_total",
        "tandem_run_iteration", "tandem_run_env_steps_per_second", "tandem_registry_alias_version",
    }  # fmt: skip


def test_what_is_now_is_not_what_was_within_the_last_hours():
    targets = [target for panel in PANELS if panel["type"] == "stat" for target in panel["targets"]]
    assert targets
    assert all((target["instant"], target["range"]) == (True, False) for target in targets)


def test_grafana_finds_dashboard_and_datasource():
    provisioning = DEPLOY / "grafana" / "provisioning"
    (provider,) = load(provisioning / "dashboards" / "tandem.yaml")["providers"]
    volumes = load(DEPLOY / "compose" / "compose.yaml")["services"]["grafana"]["volumes"]
    assert f"../grafana/tandem.json:{provider['options']['path']}/tandem.json:ro" in volumes
    (datasource,) = load(provisioning / "datasources" / "prometheus.yaml")["datasources"]
    assert datasource["type"] == "prometheus"
    assert datasource["isDefault"] is True


def test_the_reference_is_the_codes():
    rows = [
        f"| `{metric.name}` | {metric.kind} | {', '.join(f'`{label}`' for label in metric.labels)} | {metric.help} |"
        for metric in (*RUN_METRICS, *SERVICE_METRICS, *HTTP_METRICS)
    ]
    documented = re.findall(r"^\| `tandem_.*$", OPERATIONS, re.MULTILINE)
    assert documented == rows, "docs/operations.md should have:\n" + "\n".join(rows)
    own = {f"ray_{name}" for _, name, _ in actor_metrics()}
    assert own == set(re.findall(r"^\| `(ray_tandem_\w+?)(?:_total)?` \|", OPERATIONS, re.MULTILINE))
