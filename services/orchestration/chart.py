"""Helm chart of a service: Deployment, ConfigMap with its variables, Secret with its token, Service if it has a port.

Templates are written as JSON, a subset of YAML that needs no quoting rules, around Helm's template expressions.
"""

from __future__ import annotations

import json
import re
from pathlib import PurePosixPath
from typing import Any

from scan2sim.services.orchestration.description import Description
from scan2sim.services.qos.requirements import Requirements

REPLICA_COUNT_KEY = "replicaCount"
"""Helm value with the number of replicas."""
RELEASE_NAME = "{{ .Release.Name }}"
TOKEN_TEMPLATE = (
    "{{ dig `data` `token` (randAlphaNum 32 | b64enc) (lookup `v1` `Secret` .Release.Namespace .Release.Name) }}"
)
"""Helm expression for a random token (base64); upgrades keep the token of the installed release."""


IMAGE_TEMPLATE = "{{ with .Values.registry }}{{ . }}/{{ end }}{{ .Values.image }}"


def files(service: Description, needs: Requirements, version: str) -> dict[str, str]:
    """Files of the chart by path."""
    about = {"apiVersion": "v2", "name": service.name, "description": service.title, "version": version}
    labels = {"app.kubernetes.io/name": service.name, "app.kubernetes.io/instance": RELEASE_NAME}
    made = {
        "Chart.yaml": about,
        "values.yaml": _values(service, needs),
        "templates/deployment.yaml": _deployment(service, labels),
        "templates/variables.yaml": {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": RELEASE_NAME, "labels": labels},
            "data": _placeholder(".Values.variables"),
        },
    }
    if service.port:
        made["templates/service.yaml"] = {
            "apiVersion": "v1",
            "kind": "Service",
            "metadata": {"name": RELEASE_NAME, "labels": labels},
            "spec": {"selector": labels, "ports": [{"name": "http", "port": service.port, "targetPort": "http"}]},
        }
    if service.token:
        made["templates/token.yaml"] = {
            "apiVersion": "v1",
            "kind": "Secret",
            "metadata": {"name": RELEASE_NAME, "labels": labels},
            "data": {"token": TOKEN_TEMPLATE},
        }
    return {path: _text(content) for path, content in made.items()}


def _values(service: Description, needs: Requirements) -> dict[str, Any]:
    """Default values, documented in docs/orchestration.md; GPUs are requested with `resources.limits`."""
    requests = {"cpu": f"{needs.cpu_cores.value:g}"} if needs.cpu_cores else {}
    limits = {"memory": f"{needs.memory.value:g}Mi"} if needs.memory else {}
    return {
        REPLICA_COUNT_KEY: 1,
        "registry": "",
        "image": service.image,
        "imagePullSecrets": [],
        "nodeSelector": {},
        "tolerations": [],
        "volumes": [],
        "volumeMounts": [],
        "hostNetwork": service.host_network,
        "variables": service.variables,
        "resources": {"requests": requests, "limits": limits},
    }


def _deployment(service: Description, labels: dict[str, str]) -> dict[str, Any]:
    container: dict[str, Any] = {
        "name": service.name,
        "image": IMAGE_TEMPLATE,
        "envFrom": [{"configMapRef": {"name": RELEASE_NAME}}],
        "resources": _placeholder(".Values.resources"),
    }
    if service.command:
        container["command"] = list(service.command)
    if service.arguments:
        container["args"] = list(service.arguments)
    if service.port:
        container["ports"] = [{"name": "http", "containerPort": service.port}]
    if service.port and service.ready:
        probe = {"httpGet": {"path": service.ready, "port": "http"}}
        container |= {"readinessProbe": probe, "startupProbe": probe | {"failureThreshold": 60, "periodSeconds": 5}}
    volumes: Any = _placeholder(".Values.volumes")
    container["volumeMounts"] = _placeholder(".Values.volumeMounts")
    if service.token:
        path = PurePosixPath(service.token)
        secret = {"secretName": RELEASE_NAME, "items": [{"key": "token", "path": path.name}]}
        mount = {"name": "token", "mountPath": str(path.parent), "readOnly": True}
        volumes = [{"name": "token", "secret": secret}, _further(".Values.volumes")]
        container["volumeMounts"] = [mount, _further(".Values.volumeMounts")]
    # the checksum restarts pods when variables change
    annotations = {"scan2sim/variables": "{{ toJson .Values.variables | sha256sum }}"}
    pod = {
        "metadata": {"labels": labels, "annotations": annotations},
        "spec": {
            "hostNetwork": _placeholder(".Values.hostNetwork"),
            "imagePullSecrets": _placeholder(".Values.imagePullSecrets"),
            "nodeSelector": _placeholder(".Values.nodeSelector"),
            "tolerations": _placeholder(".Values.tolerations"),
            "containers": [container],
            "volumes": volumes,
        },
    }
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": RELEASE_NAME, "labels": labels},
        "spec": {
            "replicas": _placeholder(f".Values.{REPLICA_COUNT_KEY}"),
            "selector": {"matchLabels": labels},
            "template": pod,
        },
    }


def _placeholder(value: str) -> str:
    """Placeholder that `_text` replaces by `{{ toJson VALUE }}`, without quotes."""
    return f"@{value}@"


def _further(value: str) -> str:
    """Placeholder at the end of a list that `_text` replaces by the items of another list."""
    return f"@+{value}+@"


def _text(content: dict[str, Any]) -> str:
    text = json.dumps(content, indent=1) + "\n"
    text = re.sub(r',\s*"@\+(.*?)\+@"', r"{{ range \1 }}, {{ toJson . }}{{ end }}", text)
    return text.replace('"@', "{{ toJson ").replace('@"', " }}")
