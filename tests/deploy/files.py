"""What is in deploy/, parsed, and the commands and shell snippets in it and in its documents."""

import functools
import re
import shlex
import subprocess
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
DOCUMENTS = [DEPLOY / "README.md", ROOT / "docs" / "cluster.md", ROOT / "docs" / "operations.md"]
COMPOSE = DEPLOY / "compose" / "compose.yaml"
NGINX = DEPLOY / "nginx" / "nginx.conf"
PROMETHEUS = DEPLOY / "prometheus" / "prometheus.yml"
YAML = sorted([*DEPLOY.rglob("*.yaml"), *DEPLOY.rglob("*.yml")])
SCRIPTS = sorted(DEPLOY.rglob("*.sh"))


@functools.cache
def load(path):
    """The one document of a YAML file, to be read and not to be changed."""
    return yaml.safe_load(Path(path).read_text())


@functools.cache
def compose():
    """The compose file, without its extension fields."""
    return {key: value for key, value in load(COMPOSE).items() if not key.startswith("x-")}


@functools.cache
def manifests(folder="*"):
    """Every Kubernetes object under deploy/kubernetes, or in one folder of it."""
    paths = sorted(path for path in KUBERNETES.glob(f"{folder}/*.yaml") if path.name != "kustomization.yaml")
    assert paths, folder
    return [document for path in paths for document in yaml.safe_load_all(path.read_text())]


def manifest(kind, name):
    """The one object of this kind and name."""
    (found,) = [each for each in manifests() if each["kind"] == kind and each["metadata"]["name"] == name]
    return found


def pod_templates(document):
    """Every pod template in an object, wherever it stands."""
    if isinstance(document, list):
        return [found for each in document for found in pod_templates(each)]
    if not isinstance(document, dict):
        return []
    here = [document["template"]] if "containers" in document.get("template", {}).get("spec", {}) else []
    return here + [found for each in document.values() for found in pod_templates(each)]


def container(template, name):
    """The one container of this name."""
    (found,) = [each for each in template["spec"]["containers"] if each["name"] == name]
    return found


def ports(template):
    """The numbers of a pod's ports, by name."""
    return {port["name"]: port["containerPort"] for box in template["spec"]["containers"] for port in box["ports"]}


def scrape_job(name):
    """One of Prometheus' scrape configurations."""
    (found,) = [job for job in load(PROMETHEUS)["scrape_configs"] if job["job_name"] == name]
    return found


def walk(tree, path=()):
    """Every leaf of a parsed document, with the keys that lead to it."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from walk(value, (*path, key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from walk(value, (*path, index))
    else:
        yield path, tree


def snippets(document):
    """The indented or fenced blocks of a Markdown file that are commands to type."""
    blocks = re.findall(r"^```(?:sh)?\n(.*?)^```$", document.read_text(), re.MULTILINE | re.DOTALL)
    return [
        block for block in blocks if re.match(r"(docker|kubectl|ray|tandem|sh|export|curl|promtool|redis-cli)\b", block)
    ]


def check_syntax(script):
    """Let a shell parse it; nothing is run."""
    result = subprocess.run(["sh", "-n"], input=script, capture_output=True, text=True, timeout=600, check=False)
    assert result.returncode == 0, f"{result.stderr}\n{script}"


def commands(text, program):
    """Every call of a program in shell text, as its arguments: at a line's beginning or after ``--``."""
    text = re.sub(r"\\\n\s*(?:#\s+)?", " ", text)
    found = re.findall(rf"(?:^(?:#\s+)?|\s--\s+|\bexec head ){program} ([^\n`|&]*)", text, re.MULTILINE)
    return [shlex.split(each, comments=True) for each in found]
