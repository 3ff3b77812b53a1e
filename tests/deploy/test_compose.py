"""The compose file: what it refers to is there, and nothing is to be reached from outside."""

import re

import pytest

from tests.deploy.files import DEPLOY, NGINX, PROMETHEUS, ROOT, compose, manifest, scrape_job

SERVICES = compose()["services"]
ENV_EXAMPLE = (DEPLOY / "compose" / ".env.example").read_text()
EXAMPLE_VALUES = dict(re.findall(r"^(\w+)=(.*)$", ENV_EXAMPLE, re.MULTILINE))
HERE = DEPLOY / "compose"


def container_ports(service):
    """Ports that something inside a service listens at, by its own command or its image's habit."""
    by_option = re.findall(r"--(?:dashboard-|metrics-export-)?port=(\d+)", " ".join(service.get("command", [])))
    (listen,) = re.findall(r"^ *listen (\d+)\b", NGINX.read_text(), re.MULTILINE)
    by_image = {"redis": "6379", "prom": "9090", "grafana": "3000", "nginx": listen}
    return {*by_option, *(port for name, port in by_image.items() if service["image"].startswith(name))}


@pytest.mark.parametrize("name", SERVICES)
def test_only_this_machine_reaches_it(name):
    for port in SERVICES[name].get("ports", []):
        host, outside, inside = port.split(":")
        assert host == "127.0.0.1"
        assert outside == inside or name == "nginx"  # which stands for the status service
        assert inside in container_ports(SERVICES[name])


def test_the_doors_are_those_in_the_comment():
    published = {port.split(":")[1] for service in SERVICES.values() for port in service.get("ports", [])}
    heading = (HERE / "compose.yaml").read_text().split("\nname:")[0]
    assert published == set(re.findall(r"\b(?:port |at )(\d{4})\b", heading))


def test_the_status_service_is_reached_through_nginx_alone():
    assert "ports" not in SERVICES["status"]
    assert "../nginx/nginx.conf:/etc/nginx/nginx.conf:ro" in SERVICES["nginx"]["volumes"]


@pytest.mark.parametrize("name", SERVICES)
def test_secrets_and_volumes_and_files_are_there(name):
    service, tree = SERVICES[name], compose()
    secrets = service.get("secrets", [])
    assert set(secrets) <= set(tree["secrets"])
    used = {path.group(1) for path in re.finditer(r"/run/secrets/(\w+)", str(service))}
    if name == "prometheus":
        used |= set(re.findall(r"/run/secrets/(\w+)", PROMETHEUS.read_text()))
    assert used == set(secrets)
    for volume in service.get("volumes", []):
        source = volume.split(":")[0]
        if source.startswith("."):
            assert (HERE / source).resolve().exists(), volume
            assert volume.endswith(":ro")
        else:
            assert source in tree["volumes"], volume
    for dependency in service.get("depends_on", []):
        assert dependency in SERVICES
        if isinstance(service["depends_on"], dict):
            assert "healthcheck" in SERVICES[dependency]


def test_every_node_may_fetch_from_the_registry():
    for name in ("head", "worker", "gpu-worker"):
        environment = SERVICES[name]["environment"]
        assert environment["TANDEM_URL"] == "http://status:8321"
        assert environment["TANDEM_TOKEN"].startswith("${TANDEM_TOKEN:?")


def test_no_secret_or_volume_is_left_over():
    tree = compose()
    assert set(tree["secrets"]) == {each for service in SERVICES.values() for each in service.get("secrets", [])}
    mounted = {volume.split(":")[0] for service in SERVICES.values() for volume in service.get("volumes", [])}
    assert set(tree["volumes"]) == {each for each in mounted if not each.startswith(".")}


def test_every_variable_is_in_the_example():
    text = re.sub(r"^\s*#.*$", "", (HERE / "compose.yaml").read_text(), flags=re.MULTILINE).replace("$$", "")
    variables = set(re.findall(r"\$\{(\w+)", text)) | {each["environment"] for each in compose()["secrets"].values()}
    assert variables == set(EXAMPLE_VALUES)
    for name, value in EXAMPLE_VALUES.items():
        defaults = set(re.findall(rf"\$\{{{name}:-([^}}]*)\}}", text))
        assert defaults <= {value}, name  # a secret has neither a default nor a value
    assert "WORKERS" in variables  # the pattern still finds something


def test_ray_asks_for_its_token():
    nodes = [name for name, service in SERVICES.items() if service.get("entrypoint") == ["ray"]]
    assert nodes == ["head", "worker", "gpu-worker"]
    for name in nodes:
        environment = SERVICES[name]["environment"]
        assert environment["RAY_AUTH_MODE"] == "token"
        assert environment["RAY_AUTH_TOKEN_PATH"] == "/run/secrets/ray_token"
    assert "--num-cpus=0" in SERVICES["head"]["command"]


def test_names_in_addresses_are_services():
    addresses = re.findall(r"(?:@|--address=|//)([a-z][\w-]*):(\d+)", str(SERVICES))
    (discovered,) = scrape_job("ray")["dns_sd_configs"]
    addresses += [(name, str(discovered["port"])) for name in discovered["names"]]
    addresses += re.findall(r'"(\w+):(\d+)"', PROMETHEUS.read_text())
    datasource = (DEPLOY / "grafana" / "provisioning" / "datasources" / "prometheus.yaml").read_text()
    addresses += re.findall(r"http://(\w+):(\d+)", datasource)
    addresses += re.findall(r"^ *server (\w+):(\d+);$", NGINX.read_text(), re.MULTILINE)
    assert {name for name, _ in addresses} == {"redis", "head", "worker", "gpu-worker", "status", "prometheus"}
    for name, port in addresses:
        assert port in container_ports(SERVICES[name]), (name, port)


@pytest.mark.parametrize("name", ["head", "worker", "gpu-worker", "status"])
def test_who_writes_and_who_reads_have_the_same_files(name):
    assert SERVICES[name]["volumes"] == ["runs:/var/lib/tandem/runs", "registry:/var/lib/tandem/registry"]


def test_images_are_built_here_or_pinned():
    for service in SERVICES.values():
        if "build" in service:
            assert (HERE / service["build"]["context"]).resolve() == ROOT
            assert (ROOT / service["build"]["dockerfile"]).is_file()
            with_cuda = {"TORCH_INDEX": "https://pypi.org/simple"}  # whose torch is the CUDA build
            assert (service["image"], service["build"].get("args")) in {
                "tandem:cpu": None,
                "tandem:cuda": with_cuda,
            }.items()
        else:
            assert re.fullmatch(r"[\w/]+:v?\d+\.\d+[\w.-]*", service["image"])


@pytest.mark.parametrize("name", SERVICES)
def test_no_log_fills_the_disk(name):
    assert SERVICES[name]["logging"] == {"driver": "json-file", "options": {"max-size": "10m", "max-file": "3"}}


def test_redis_is_bounded_as_on_kubernetes():
    """A run that its Redis takes no more from has an alert; a machine without memory ends whatever it likes."""
    (box,) = manifest("StatefulSet", "redis")["spec"]["template"]["spec"]["containers"]
    settings = [
        re.findall(r"^ *(maxmemory.*)$", text, re.MULTILINE) for text in (*SERVICES["redis"]["command"], *box["args"])
    ]
    assert settings == [["maxmemory 768mb", "maxmemory-policy noeviction"]] * 2
