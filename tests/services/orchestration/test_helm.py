"""The charts of all services are linted and rendered by Helm itself (its SDK, package `helm-python-sdk`)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from scan2sim.services.orchestration import chart, description
from scan2sim.services.qos.requirements import Environment

helm = pytest.importorskip("helm_python", reason="helm-python-sdk, which has Helm without its program, isn't installed")

OWN_VALUES: dict[str, Any] = {
    "replicaCount": 3,
    "registry": "registry.example.org:5000",
    "imagePullSecrets": [{"name": "private"}],
    "nodeSelector": {"gpu": "true"},
    "tolerations": [{"key": "nvidia.com/gpu", "operator": "Exists"}],
    "volumes": [{"name": "data", "persistentVolumeClaim": {"claimName": "data"}}],
    "volumeMounts": [{"name": "data", "mountPath": "/data"}],
    "resources": {"limits": {"nvidia.com/gpu": 1}},
    "variables": {"LEVEL": 'a "quoted"\nline'},
}


@pytest.fixture(params=description.names())
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Folder of a service's chart."""
    service = description.read(request.param)
    for path, text in chart.files(service, service.requirements_in(Environment.EDGE), "1.0.0").items():
        file = tmp_path / service.name / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    return tmp_path / service.name


def render(folder: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Objects by their kinds, as Helm renders them: JSON after its expressions are replaced."""
    with helm.Chart.load(str(folder)) as loaded:
        texts = loaded.render(values, name="one", namespace="default").values()
    return {made["kind"]: made for made in map(json.loads, filter(str.strip, texts))}


def test_helm_accepts_the_chart(folder: Path) -> None:
    found = helm.lint(str(folder))
    assert found["errors"] == [] and all(one["severity"] <= 1 for one in found["messages"]), found  # 1: information
    made = render(folder, {})
    pod = made["Deployment"]["spec"]["template"]["spec"]
    assert made["Deployment"]["metadata"]["name"] == "one" and pod["tolerations"] == []
    assert pod["containers"][0]["image"] == description.read(folder.name).image


def test_values_of_a_site_reach_the_pod(folder: Path) -> None:
    made = render(folder, OWN_VALUES)
    spec = made["Deployment"]["spec"]
    pod, (container,) = spec["template"]["spec"], spec["template"]["spec"]["containers"]
    assert spec["replicas"] == 3
    assert container["image"] == f"registry.example.org:5000/{description.read(folder.name).image}"
    assert container["resources"]["limits"]["nvidia.com/gpu"] == 1
    assert made["ConfigMap"]["data"]["LEVEL"] == OWN_VALUES["variables"]["LEVEL"]
    for name in ("imagePullSecrets", "nodeSelector", "tolerations"):
        assert pod[name] == OWN_VALUES[name]
    assert pod["volumes"][-1:] == OWN_VALUES["volumes"]
    assert container["volumeMounts"][-1:] == OWN_VALUES["volumeMounts"]
    token = description.read(folder.name).token
    assert len(pod["volumes"]) == len(container["volumeMounts"]) == (2 if token else 1)
