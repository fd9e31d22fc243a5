"""A Helm chart of a service: a Deployment, its variables, a Secret with its token, a Service where it listens.

Templates are JSON, which is YAML that needs no quoting, around what Helm puts in when a chart is installed.
"""

from __future__ import annotations

import json
from pathlib import PurePosixPath
from typing import Any

from scan2sim.services.orchestration.description import Description
from scan2sim.services.qos.requirements import Requirements

REPLICAS = "replicaCount"
"""The value that says how many there are."""
NAME = "{{ .Release.Name }}"
TOKEN = "{{ dig `data` `token` (randAlphaNum 32 | b64enc) (lookup `v1` `Secret` .Release.Namespace .Release.Name) }}"
"""A random token, base64; that of the installed release where there is one, so that an upgrade keeps it."""


def files(service: Description, needs: Requirements, version: str) -> dict[str, str]:
    """A chart's files by their paths."""
    about = {"apiVersion": "v2", "name": service.name, "description": service.title, "version": version}
    labels = {"app.kubernetes.io/name": service.name, "app.kubernetes.io/instance": NAME}
    made = {
        "Chart.yaml": about,
        "values.yaml": _values(service, needs),
        "templates/deployment.yaml": _deployment(service, labels),
        "templates/variables.yaml": {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": NAME, "labels": labels},
            "data": _put(".Values.variables"),
        },
    }
    if service.port:
        made["templates/service.yaml"] = {
            "apiVersion": "v1",
            "kind": "Service",
            "metadata": {"name": NAME, "labels": labels},
            "spec": {"selector": labels, "ports": [{"name": "http", "port": service.port, "targetPort": "http"}]},
        }
    if service.token:
        made["templates/token.yaml"] = {
            "apiVersion": "v1",
            "kind": "Secret",
            "metadata": {"name": NAME, "labels": labels},
            "data": {"token": TOKEN},
        }
    return {path: _text(content) for path, content in made.items()}


def _values(service: Description, needs: Requirements) -> dict[str, Any]:
    """What may be set; graphics processors are asked for by `resources.limits`, as `nvidia.com/gpu`."""
    requests = {"cpu": f"{needs.cpu_cores.value:g}"} if needs.cpu_cores else {}
    limits = {"memory": f"{needs.memory.value:g}Mi"} if needs.memory else {}
    return {
        REPLICAS: 1,
        "image": service.image,
        "hostNetwork": service.host_network,
        "variables": service.variables,
        "resources": {"requests": requests, "limits": limits},
    }


def _deployment(service: Description, labels: dict[str, str]) -> dict[str, Any]:
    container: dict[str, Any] = {
        "name": service.name,
        "image": "{{ .Values.image }}",
        "envFrom": [{"configMapRef": {"name": NAME}}],
        "resources": _put(".Values.resources"),
    }
    if service.command:
        container["command"] = list(service.command)
    if service.arguments:
        container["args"] = list(service.arguments)
    if service.port:
        container["ports"] = [{"name": "http", "containerPort": service.port}]
    if service.port and service.ready:
        asked = {"httpGet": {"path": service.ready, "port": "http"}}
        container |= {"readinessProbe": asked, "startupProbe": asked | {"failureThreshold": 60, "periodSeconds": 5}}
    volumes = []
    if service.token:
        path = PurePosixPath(service.token)
        container["volumeMounts"] = [{"name": "token", "mountPath": str(path.parent), "readOnly": True}]
        volumes = [{"name": "token", "secret": {"secretName": NAME, "items": [{"key": "token", "path": path.name}]}}]
    changed = {"scan2sim/variables": "{{ toJson .Values.variables | sha256sum }}"}  # starts pods anew when they change
    pod = {
        "metadata": {"labels": labels, "annotations": changed},
        "spec": {"hostNetwork": _put(".Values.hostNetwork"), "containers": [container], "volumes": volumes},
    }
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": NAME, "labels": labels},
        "spec": {"replicas": _put(f".Values.{REPLICAS}"), "selector": {"matchLabels": labels}, "template": pod},
    }


def _put(value: str) -> str:
    """What `_text` writes as `{{ toJson VALUE }}`, without quotes."""
    return f"@{value}@"


def _text(content: dict[str, Any]) -> str:
    text = json.dumps(content, indent=1) + "\n"
    return text.replace('"@', "{{ toJson ").replace('@"', " }}")
