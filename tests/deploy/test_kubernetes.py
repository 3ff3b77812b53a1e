"""The manifests: their keys exist, what they refer to is there, and a job that fails goes on where it was."""

import copy
import re
import shlex
import shutil
import subprocess

import pytest
import yaml

from tests.deploy.files import (
    DEPLOY,
    KUBERNETES,
    NGINX,
    ROOT,
    container,
    load,
    manifest,
    manifests,
    pod_templates,
    ports,
    scrape_job,
    walk,
)
from tests.deploy.shapes import manifest_mistakes

ALL = [pytest.param(each, id=f"{each['kind']}-{each['metadata']['name']}") for each in manifests()]
FOLDERS = ("base", "cluster", "job", "monitoring")
SECRET = "tandem"
SECRET_KEYS = {"auth_token", "redis_password", "token"}
"""What the command in deploy/README.md puts into the secret."""


def ray_specs():
    return {
        "cluster": manifest("RayCluster", "tandem")["spec"],
        "job": manifest("RayJob", "cube")["spec"]["rayClusterSpec"],
    }


def labels(template):
    return template["metadata"]["labels"]


def selects(selector, template):
    return selector.get("matchLabels", {}).items() <= labels(template).items()


@pytest.mark.parametrize("document", ALL)
def test_every_key_exists(document):
    assert manifest_mistakes(document) == []


def test_what_is_unknown_missing_or_of_the_wrong_kind_is_found():
    document = copy.deepcopy(manifest("RayJob", "cube"))
    spec = document["spec"]["rayClusterSpec"]
    spec["workerGroupSpecs"][0]["template"]["spec"]["containers"][0]["resource"] = "x"
    spec["headGroupSpec"]["rayStartParams"]["num-cpus"] = 0
    document["spec"]["submissionMode"] = "HttpMode"
    del document["spec"]["backoffLimit"]
    lacks, mode, number, unknown = manifest_mistakes(document)
    assert lacks == "it.spec lacks backoffLimit"
    assert "HttpMode" in mode
    assert "num-cpus" in number
    assert unknown.endswith("containers[0] has unknown resource")


@pytest.mark.parametrize("document", ALL)
def test_secrets_claims_and_volumes_are_there(document):
    for path, value in walk(document):
        if path[-2:] == ("secretKeyRef", "name") or path[-1] == "secretName":
            assert value == SECRET, path
        if path[-2:] in (("secretKeyRef", "key"), ("credentials", "key")):
            assert value in SECRET_KEYS, path
        if path[-1] == "claimName":
            assert manifest("PersistentVolumeClaim", value)
        if path[-2:] == ("configMap", "name"):
            assert value in {each["name"] for each in load(NGINX.parent / "kustomization.yaml")["configMapGenerator"]}
    own_claims = [each["metadata"]["name"] for each in document.get("spec", {}).get("volumeClaimTemplates", [])]
    for template in pod_templates(document):
        volumes = [each["name"] for each in template["spec"].get("volumes", [])] + own_claims
        mounted = [each["name"] for box in template["spec"]["containers"] for each in box.get("volumeMounts", [])]
        assert set(mounted) == set(volumes)


def test_the_documented_secret_has_every_key():
    text = (DEPLOY / "README.md").read_text()
    (command,) = re.findall(rf"create secret generic {SECRET} ((?:.|\\\n)*?)\n```", text)
    assert set(re.findall(r"--from-literal=(\w+)=", command)) == SECRET_KEYS


def test_services_lead_to_pods_and_ports():
    templates = pod_templates(manifests("base"))
    services = [each for each in manifests("base") if each["kind"] == "Service"]
    assert {each["metadata"]["name"] for each in services} == {"redis", "status"}
    for service in services:
        (template,) = [each for each in templates if service["spec"]["selector"].items() <= labels(each).items()]
        assert {each["targetPort"] for each in service["spec"]["ports"]} <= set(ports(template))


@pytest.mark.parametrize("document", [each for each in manifests() if each["kind"] in ("Deployment", "StatefulSet")])
def test_workloads_select_their_own_pods(document):
    assert selects(document["spec"]["selector"], document["spec"]["template"])


def test_nginx_is_before_the_status_service():
    template = manifest("Deployment", "status")["spec"]["template"]
    ((name, port),) = re.findall(r"^ *server (\w+):(\d+);$", NGINX.read_text(), re.MULTILINE)
    assert template["spec"]["hostAliases"] == [{"ip": "127.0.0.1", "hostnames": [name]}]
    assert ports(template) == {
        "rest": int(port),
        "http": int(re.findall(r"^ *listen (\d+)\b", NGINX.read_text(), re.M)[0]),
    }
    assert f"--port={port}" in container(template, "status")["args"]
    assert {each["targetPort"] for each in manifest("Service", "status")["spec"]["ports"]} == {"http"}


def test_redis_is_where_it_is_looked_for():
    (port,) = manifest("Service", "redis")["spec"]["ports"]
    address = f"redis:{port['port']}"
    urls = [str(value) for _, value in walk(manifests()) if "redis://" in str(value)]
    assert {url.rsplit("@")[1] for url in urls} == {f"{address}/0"}
    templates = [manifest("Deployment", "status")["spec"]["template"]]
    for spec in ray_specs().values():  # a study's runs report from the workers
        templates += [group["template"] for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"])]
    assert len(templates) == len(urls) == 7
    for template in templates:
        names = [variable["name"] for variable in template["spec"]["containers"][0]["env"]]
        assert names[:2] == ["REDIS_PASSWORD", "TANDEM_REDIS_URL"]  # the second is made of the first


@pytest.mark.parametrize("template", pod_templates(manifests()), ids=lambda each: each["spec"]["containers"][0]["name"])
def test_pods_meet_the_restricted_standard(template):
    spec = template["spec"]
    assert spec["automountServiceAccountToken"] is False
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["runAsUser"] > 0
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    for box in spec["containers"]:
        assert box["securityContext"]["allowPrivilegeEscalation"] is False
        assert box["securityContext"]["capabilities"]["drop"] == ["ALL"]
        assert {"cpu", "memory"} <= set(box["resources"]["requests"])
        assert "memory" in box["resources"]["limits"]


@pytest.mark.parametrize("name", ["cluster", "job"])
def test_ray(name):
    spec = ray_specs()[name]
    assert f"ray=={spec['rayVersion']}" in (ROOT / "constraints.txt").read_text().splitlines()
    assert spec["authOptions"] == {"mode": "token", "secretName": SECRET}
    assert spec["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    groups = spec["workerGroupSpecs"]
    assert len({group["groupName"] for group in groups}) == len(groups)
    for group in groups:
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
        # Ray takes the number of cores from the limit, and what is offered has to be there.
        (box,) = group["template"]["spec"]["containers"]
        assert box["resources"]["limits"]["cpu"] == box["resources"]["requests"]["cpu"]
    boxes = [box for group in groups for box in group["template"]["spec"]["containers"]]
    with_gpu = [box["image"] for box in boxes if "nvidia.com/gpu" in box["resources"]["limits"]]
    assert with_gpu == ["tandem-cuda"]


def test_the_job_runs_on_a_cluster_like_the_one_that_stays():
    specs = ray_specs()
    assert specs["cluster"] == {**specs["job"], "upgradeStrategy": {"type": "Recreate"}}  # a job's cluster is new


def working_directory():
    """Of a container of our image: where Ray starts, and with it the driver."""
    text = (DEPLOY / "docker" / "Dockerfile").read_text()
    return re.findall(r"^WORKDIR (\S+)$", text, re.MULTILINE)[-1]


def test_a_retried_job_goes_on_with_the_same_run():
    job = manifest("RayJob", "cube")["spec"]
    assert job["backoffLimit"] > 0
    assert job["shutdownAfterJobFinishes"] is True
    assert 0 < job["preRunningDeadlineSeconds"] < job["activeDeadlineSeconds"]
    arguments = shlex.split(job["entrypoint"])
    options = dict(zip(arguments[2::2], arguments[3::2], strict=True))
    # Written down, not made up at every start; and on the volume, which outlives the cluster.
    assert re.fullmatch(r"[a-z0-9-]+", options["--run-id"])
    (head,) = job["rayClusterSpec"]["headGroupSpec"]["template"]["spec"]["containers"]
    mounts = [each["mountPath"] for each in head["volumeMounts"]]
    assert "workingDir" not in head
    assert f"{working_directory()}/runs" == mounts[0]
    assert options["--registry"] == mounts[1]


def test_the_status_service_reads_where_runs_are_written():
    def mounts(template):
        box = template["spec"]["containers"][0]
        claims = {each["name"]: each.get("persistentVolumeClaim") for each in template["spec"]["volumes"]}
        return {
            (each["mountPath"], each["subPath"], claims[each["name"]]["claimName"])
            for each in box["volumeMounts"]
            if claims[each["name"]] is not None
        }

    assert manifest("Deployment", "status")["spec"]["template"]["spec"]["containers"][0]["name"] == "status"
    status = mounts(manifest("Deployment", "status")["spec"]["template"])
    assert len(status) == 2
    for spec in ray_specs().values():
        for group in (spec["headGroupSpec"], *spec["workerGroupSpecs"]):  # a study's runs are trained on workers
            assert mounts(group["template"]) == status
    (claim,) = {claim for *_, claim in status}
    assert manifest("PersistentVolumeClaim", claim)["spec"]["accessModes"] == ["ReadWriteMany"]


def test_nobody_may_talk_to_a_pod_unless_a_policy_says_so():
    policies = {each["metadata"]["name"]: each["spec"] for each in manifests("base") if each["kind"] == "NetworkPolicy"}
    assert policies.pop("nobody") == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    templates = pod_templates(manifests())
    for name, spec in policies.items():
        assert spec["policyTypes"] == [kind for kind in ("Ingress", "Egress") if kind.lower() in spec], name
        chosen = [each for each in templates if selects(spec["podSelector"], each)]
        assert chosen, name
        for direction, rules in (("from", spec.get("ingress", [])), ("to", spec.get("egress", []))):
            for rule in rules:
                check_rule(name, rule, rule[direction], templates, chosen if direction == "from" else None)


def check_rule(name, rule, peers, templates, chosen):
    """Peers in our own namespace are our pods; others are in a namespace with a label, and meet some ports only.

    ``chosen``: the pods whose ports are opened; None for those of the peers.
    """
    for peer in peers:
        assert peer["podSelector"]["matchLabels"], name
        if "namespaceSelector" in peer:
            assert peer["namespaceSelector"]["matchLabels"], name  # labels of pods alone are anybody's there
            assert rule["ports"], name
        else:
            ours = [each for each in templates if selects(peer["podSelector"], each)]
            assert ours, name
            opened = {name: number for each in chosen or ours for name, number in ports(each).items()}
            for port in rule.get("ports", []):
                assert port["port"] in opened or port["port"] in opened.values(), name


def test_whoever_is_asked_may_be_asked():
    """What one side may send, the other lets in, and the other way round."""
    policies = [each["spec"] for each in manifests("base") if each["kind"] == "NetworkPolicy"]
    components = ("ray", "redis", "status")
    sent, received = set(), set()
    for spec in policies:
        own = spec["podSelector"].get("matchLabels", {}).get("app.kubernetes.io/component")
        for kind, direction, found in (("egress", "to", sent), ("ingress", "from", received)):
            for rule in spec.get(kind, []):
                for peer in rule[direction]:
                    other = peer["podSelector"]["matchLabels"].get("app.kubernetes.io/component")
                    if other in components:
                        found.add((own, other) if kind == "egress" else (other, own))
    assert sent == received == {("ray", "ray"), ("ray", "redis"), ("status", "redis")}


def test_pod_monitors_find_pods_and_ports():
    monitors = [each["spec"] for each in manifests("monitoring")]
    assert len(monitors) == 2
    for spec in monitors:
        chosen = [each for each in pod_templates(manifests()) if selects(spec["selector"], each)]
        assert chosen
        for endpoint in spec["podMetricsEndpoints"]:
            for template in chosen:
                assert endpoint["port"] in ports(template)


def test_what_is_kept_of_rays_metrics_is_the_same_everywhere():
    (ray,) = [each["spec"] for each in manifests("monitoring") if each["metadata"]["name"] == "ray"]
    (here,) = ray["podMetricsEndpoints"][0]["metricRelabelings"]
    (there,) = scrape_job("ray")["metric_relabel_configs"]
    assert here["regex"] == there["regex"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_kustomizations_name_every_file(folder):
    kustomization = load(KUBERNETES / folder / "kustomization.yaml")
    assert kustomization["namespace"] == manifest("Namespace", "tandem")["metadata"]["name"]
    files = {path.name for path in (KUBERNETES / folder).glob("*.yaml")} - {"kustomization.yaml"}
    assert set(kustomization["resources"]) == files
    assert all(
        (KUBERNETES / folder / each / "kustomization.yaml").is_file() for each in kustomization.get("components", [])
    )


def test_images_are_ours_by_one_name_or_pinned():
    ours = {each["name"] for each in load(KUBERNETES / "image" / "kustomization.yaml")["images"]}
    images = {box["image"] for each in pod_templates(manifests()) for box in each["spec"]["containers"]}
    assert ours < images
    assert all(re.fullmatch(r"[\w/-]+:\d+\.\d+[\w.-]*", image) for image in images - ours)


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl, which renders kustomizations, is not on PATH")
@pytest.mark.parametrize("folder", FOLDERS)
def test_kustomize_builds_it(folder):
    result = subprocess.run(
        ["kubectl", "kustomize", KUBERNETES / folder], capture_output=True, text=True, timeout=600, check=False
    )
    assert result.returncode == 0, result.stderr
    built = list(yaml.safe_load_all(result.stdout))
    assert len(built) == len(manifests(folder)) + (folder == "base")  # nginx.conf
    for document in built:
        assert document["kind"] != "ConfigMap" or document["data"] == {NGINX.name: NGINX.read_text()}
    for document in built:
        assert document["kind"] == "Namespace" or document["metadata"]["namespace"] == "tandem"
    for template in pod_templates(built):
        for box in template["spec"]["containers"]:
            assert ":" in box["image"], "the component has not replaced it"


def test_the_alerts_go_in_as_they_are():
    script = KUBERNETES / "monitoring" / "apply-alerts.sh"
    result = subprocess.run(["sh", script], capture_output=True, text=True, timeout=600, check=True)
    rule = yaml.safe_load(result.stdout)
    assert (rule["apiVersion"], rule["kind"]) == ("monitoring.coreos.com/v1", "PrometheusRule")
    assert rule["spec"] == load(DEPLOY / "prometheus" / "alerts.yml")
