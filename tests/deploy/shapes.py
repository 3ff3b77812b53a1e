"""Which keys an object of Kubernetes or KubeRay may have: enough of their schemas to find a typo.

No package that we install has these schemas, so they are written down here as far as our files use them, from the API
references of KubeRay 1.7 and Kubernetes 1.32. A shape is a type, a list of one shape, a
dictionary of shapes (a key that ends in ``!`` has to be there; ``*`` stands for any key), or a set of allowed values.
"""

ONE_OF = (str, int)
RESOURCES = {"requests": {"*": str}, "limits": {"*": str}}
SECURITY = {
    "runAsNonRoot": bool,
    "runAsUser": int,
    "runAsGroup": int,
    "fsGroup": int,
    "seccompProfile": {"type!": {"RuntimeDefault"}},
}
CONTAINER_SECURITY = {
    "allowPrivilegeEscalation": bool,
    "readOnlyRootFilesystem": bool,
    "capabilities": {"drop": [str], "add": [str]},
}
SECRET_KEY = {"name!": str, "key!": str}
ENV = {"name!": str, "value": str, "valueFrom": {"secretKeyRef!": SECRET_KEY}}
PROBE = {
    "httpGet": {"path!": str, "port!": ONE_OF},
    "exec": {"command!": [str]},
    "initialDelaySeconds": int,
    "periodSeconds": int,
    "timeoutSeconds": int,
    "failureThreshold": int,
}
CONTAINER = {
    "name!": str,
    "image!": str,
    "command": [str],
    "args": [str],
    "env": [ENV],
    "ports": [{"name!": str, "containerPort!": int}],
    "startupProbe": PROBE,
    "livenessProbe": PROBE,
    "readinessProbe": PROBE,
    "resources!": RESOURCES,
    "securityContext!": CONTAINER_SECURITY,
    "volumeMounts": [{"name!": str, "mountPath!": str, "subPath": str, "readOnly": bool}],
}
VOLUME = {
    "name!": str,
    "emptyDir": {},
    "persistentVolumeClaim": {"claimName!": str},
    "configMap": {"name!": str},
    "secret": {"secretName!": str, "items": [{"key!": str, "path!": str}]},
}
POD_TEMPLATE = {
    "metadata!": {"labels!": {"*": str}},
    "spec!": {
        "automountServiceAccountToken": bool,
        "enableServiceLinks": bool,
        "hostAliases": [{"ip!": str, "hostnames!": [str]}],
        "terminationGracePeriodSeconds": int,
        "securityContext!": SECURITY,
        "containers!": [CONTAINER],
        "volumes": [VOLUME],
    },
}
CLAIM = {"accessModes!": [str], "resources!": {"requests!": {"storage!": str}}}
SELECTOR = {"matchLabels!": {"*": str}}
PEER = {"podSelector!": {"matchLabels": {"*": str}}, "namespaceSelector": {"matchLabels": {"*": str}}}

HEAD_GROUP = {"rayStartParams!": {"*": str}, "template!": POD_TEMPLATE, "serviceType": str}
WORKER_GROUP = {
    "groupName!": str,
    "replicas!": int,
    "minReplicas!": int,
    "maxReplicas!": int,
    "rayStartParams!": {"*": str},
    "template!": POD_TEMPLATE,
}
RAY_CLUSTER = {
    "rayVersion!": str,
    "authOptions!": {"mode!": {"token"}, "secretName!": str},
    "upgradeStrategy": {"type!": {"Recreate", "None"}},
    "headGroupSpec!": HEAD_GROUP,
    "workerGroupSpecs!": [WORKER_GROUP],
}
RAY_JOB = {
    "entrypoint!": str,
    # The CRD has no enum here, so the API server would not find a typo either.
    "submissionMode": {"K8sJobMode", "HTTPMode", "SidecarMode"},
    "backoffLimit!": int,
    "preRunningDeadlineSeconds!": int,
    "activeDeadlineSeconds!": int,
    "shutdownAfterJobFinishes!": bool,
    "ttlSecondsAfterFinished": int,
    "rayClusterSpec!": RAY_CLUSTER,
}
WORKLOAD = {"replicas!": int, "selector!": SELECTOR, "template!": POD_TEMPLATE}

SPECS = {
    ("ray.io/v1", "RayCluster"): RAY_CLUSTER,
    ("ray.io/v1", "RayJob"): RAY_JOB,
    ("apps/v1", "Deployment"): WORKLOAD,
    ("apps/v1", "StatefulSet"): WORKLOAD
    | {"serviceName!": str, "volumeClaimTemplates": [{"metadata!": {"name!": str}, "spec!": CLAIM}]},
    ("v1", "Service"): {"selector!": {"*": str}, "ports!": [{"name!": str, "port!": int, "targetPort!": ONE_OF}]},
    ("v1", "PersistentVolumeClaim"): CLAIM,
    ("networking.k8s.io/v1", "NetworkPolicy"): {
        "podSelector!": {"matchLabels": {"*": str}},
        "policyTypes!": [{"Ingress", "Egress"}],
        "ingress": [{"from!": [PEER], "ports": [{"port!": ONE_OF}]}],
        "egress": [{"to!": [PEER], "ports": [{"port!": ONE_OF, "protocol": {"UDP", "TCP"}}]}],
    },
    ("monitoring.coreos.com/v1", "PodMonitor"): {
        "selector!": SELECTOR,
        "podMetricsEndpoints!": [
            {
                "port!": str,
                "path": str,
                "interval": str,
                "authorization": {"credentials!": SECRET_KEY},
                "metricRelabelings": [{"sourceLabels": [str], "action!": {"keep", "drop"}, "regex!": str}],
            }
        ],
    },
}
METADATA = {"name!": str, "labels": {"*": str}}


def mistakes(tree, shape, path="it"):
    """What does not fit, in one sentence each."""
    if isinstance(shape, (type, tuple)):
        fits = isinstance(tree, shape) and (shape is bool or not isinstance(tree, bool))
        return [] if fits else [f"{path} is {tree!r}, which is no {shape}"]
    if isinstance(shape, set):
        return [] if tree in shape else [f"{path} is {tree!r}, not one of {sorted(shape)}"]
    if isinstance(shape, list):
        if not isinstance(tree, list):
            return [f"{path} is no list"]
        return [each for i, item in enumerate(tree) for each in mistakes(item, shape[0], f"{path}[{i}]")]
    if not isinstance(tree, dict):
        return [f"{path} has no keys"]
    if "*" in shape:
        return [each for key, value in tree.items() for each in mistakes(value, shape["*"], f"{path}.{key}")]
    known = {key.rstrip("!"): value for key, value in shape.items()}
    found = [f"{path} lacks {key[:-1]}" for key in shape if key.endswith("!") and key[:-1] not in tree]
    for key, value in tree.items():
        found += mistakes(value, known[key], f"{path}.{key}") if key in known else [f"{path} has unknown {key}"]
    return found


def manifest_mistakes(document):
    """What is wrong with one Kubernetes object."""
    kind = (document.get("apiVersion"), document.get("kind"))
    if kind == ("v1", "Namespace"):
        return mistakes(document, {"apiVersion!": str, "kind!": str, "metadata!": METADATA})
    if kind not in SPECS:
        return [f"unknown kind {kind}"]
    return mistakes(document, {"apiVersion!": str, "kind!": str, "metadata!": METADATA, "spec!": SPECS[kind]})
