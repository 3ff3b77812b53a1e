"""The compose file as ``tools/compose_services.py`` reads it, which starts what it finds there."""

import pytest
import yaml

from service.base.errors import TandemError
from tests.deploy.files import COMPOSE, DEPLOY, load
from tools.compose_services import Port, read_services, read_variables

SECRETS = {
    "RAY_AUTH_TOKEN": "ray-token",
    "TANDEM_TOKEN": "tandem-token",
    "REDIS_PASSWORD": "p4ss",
    "GRAFANA_PASSWORD": "x",
}
VARIABLES = SECRETS | {"WORKERS": "3"}


@pytest.fixture(scope="module")
def services():
    return read_services(COMPOSE, VARIABLES)


def changed(tmp_path, service, **values):
    """The compose file with other values of a service, written beside nothing else."""
    tree = yaml.safe_load(COMPOSE.read_text())
    tree["services"][service] |= values
    path = tmp_path / "compose.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


def test_values_are_put_in(services):
    assert services["head"].environment["TANDEM_REDIS_URL"] == "redis://:p4ss@redis:6379/0"
    assert services["head"].secrets == {"ray_token": "ray-token"}
    assert services["worker"].num_containers == 3
    assert "--num-cpus=2" in services["worker"].command
    assert "requirepass $(cat /run/secrets/redis_password)" in services["redis"].command[0]  # $$ is $
    assert services["worker"].memory_bytes == 4 * 2**30
    assert services["head"].shm_bytes == 2 * 2**30
    assert services["head"].stop_grace_s == 45
    assert services["nginx"].ports == [Port("127.0.0.1", 8321, 8000)]


def test_mounts_are_files_of_the_machine_or_volumes(services):
    config, alerts, volume = services["prometheus"].mounts
    assert (config.source, config.target) == (DEPLOY / "prometheus/prometheus.yml", "/etc/prometheus/prometheus.yml")
    assert alerts.source.is_file()
    assert [each.read_only for each in (config, alerts, volume)] == [True, True, False]
    assert (volume.source, volume.target) == ("prometheus", "/prometheus")


def test_services_come_after_what_they_wait_for(services):
    order = list(services)
    for service in services.values():
        for other in service.depends_on:
            assert order.index(other.service) < order.index(service.name)
    assert order.index("redis") < order.index("head") < order.index("worker")  # the pattern above had something to see


@pytest.mark.parametrize(
    ("service", "values", "said"),
    [
        ("redis", {"sysctls": {"net.core.somaxconn": 1024}}, "sysctls is not known"),
        ("redis", {"cap_drop": []}, "cap_drop is not"),
        ("status", {"read_only": True}, "not into a read_only one"),
        ("redis", {"volumes": ["other:/data"]}, "the volume other, which is not listed"),
        ("redis", {"depends_on": ["nginx"]}, "wait for each other"),
    ],
)
def test_what_compose_would_not_do_is_an_error(tmp_path, service, values, said):
    with pytest.raises(TandemError, match=said):
        read_services(changed(tmp_path, service, **values), VARIABLES)


def test_a_secret_that_has_no_value_is_named():
    with pytest.raises(TandemError, match=r"REDIS_PASSWORD: run make-env\.sh first"):
        read_services(COMPOSE, VARIABLES | {"REDIS_PASSWORD": ""})


def test_what_all_services_share_is_read(services):
    assert {each.name for each in services.values()} == load(COMPOSE)["services"].keys()
    assert all(each.health for each in services.values() if each.name != "grafana")
    assert {each.name for each in services.values() if each.read_only} == {"nginx"}


def test_the_variables_are_read_as_they_are_written(tmp_path):
    (tmp_path / ".env").write_text("# a comment\nWORKERS=2\nTANDEM_TOKEN=ab=c\n")
    assert read_variables(tmp_path / ".env") == {"WORKERS": "2", "TANDEM_TOKEN": "ab=c"}
