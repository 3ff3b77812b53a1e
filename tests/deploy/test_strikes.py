"""The alerts, judged by what the status said in the recorded strikes."""

import json
import shutil
import subprocess

import pytest
import yaml

from service.store.models import CONDITIONS
from tests.deploy.files import DEPLOY, ROOT

STRIKES = json.loads((ROOT / "docs" / "results" / "strikes.json").read_text())["strikes"]
CONDITION = {
    "driver-frozen": "stuck",
    "freezes": "stuck",  # the driver is among those that are frozen
    "disk-full": "disk",
    "redis-frozen": "redis",
    "redis-killed": "redis",
    "redis-file-cut": "redis",
    "redis-parted": "redis",
    "clock-jumps": "clock",
}
"""What is wrong with a run in a strike that it does not mend by itself; in all others nothing is."""
ALERTS = {"stuck": "RunStuck", "disk": "RunCannotWrite", "redis": "RunWithoutRedis", "clock": "ClockWrong"}
STEP_S = 5
STAYS = 1200 // STEP_S


def test_each_strike_was_recorded_and_has_the_condition_that_fits():
    assert {each["name"] for each in STRIKES} >= CONDITION.keys()
    for strike in STRIKES:
        seen = {condition for _, _, condition in strike["conditions"]}
        assert seen <= {"well", CONDITION.get(strike["name"], "well")}, strike["name"]
        assert {state for _, state, _ in strike["conditions"]} <= {"running", "interrupted"}, strike["name"]


def series(strike):
    """A run whose status is as it was recorded, until the trouble begins; then that stays for 20 minutes."""
    wrong = CONDITION.get(strike["name"])
    begins = next((seconds for seconds, _, condition in strike["conditions"] if condition == wrong), None)
    calm = round((strike["lasted_s"] if begins is None else begins) // STEP_S) + 60 // STEP_S
    for condition in CONDITIONS:
        now = int(condition == (wrong if begins is not None else "well"))
        values = f"{int(condition == 'well')}x{calm} {now}x{STAYS}"
        yield {"series": f'tandem_run_condition{{run="a", condition="{condition}"}}', "values": values}
    yield {"series": 'tandem_run_state{run="a", state="running"}', "values": f"1x{calm + STAYS}"}
    yield {"series": "tandem_store_up", "values": f"1x{calm + STAYS}"}


@pytest.mark.skipif(shutil.which("promtool") is None, reason="needs promtool, which comes with Prometheus, on PATH")
def test_the_alert_that_fits_fires_if_the_trouble_stays_and_no_other(tmp_path):
    shutil.copy(DEPLOY / "prometheus" / "alerts.yml", tmp_path)
    tests = []
    for strike in STRIKES:
        wrong = CONDITION.get(strike["name"])
        fired = [{"labels": f'{{alertname="{ALERTS[wrong]}"}}', "value": 1}] if wrong else []
        tests.append(
            {
                "name": strike["name"],
                "interval": f"{STEP_S}s",
                "input_series": list(series(strike)),
                "promql_expr_test": [
                    {
                        "expr": 'count by (alertname) (ALERTS{alertstate="firing"})',
                        "eval_time": "15m",
                        "exp_samples": fired,
                    }
                ],
            }
        )
    rules = {"rule_files": ["alerts.yml"], "evaluation_interval": "15s", "tests": tests}
    (tmp_path / "test.yml").write_text(yaml.safe_dump(rules))
    command = ["promtool", "test", "rules", "test.yml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
