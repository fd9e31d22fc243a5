"""Deployments, automations and the template of Kubernetes jobs: what a cluster requires, checked without one."""

from __future__ import annotations

import json
import os
import re
import subprocess
from typing import Any

import pytest
import yaml

from scan2sim.flows.engine.memory import parse_memory
from tests.conftest import ROOT
from tests.present import present

DEPLOYMENTS: list[dict[str, Any]] = yaml.safe_load((ROOT / "prefect.yaml").read_text(encoding="utf-8"))["deployments"]
TEMPLATE: dict[str, Any] = json.loads((ROOT / "deploy" / "kubernetes.json").read_text(encoding="utf-8"))
AUTOMATIONS = yaml.safe_load((ROOT / "deploy" / "automations.yaml").read_text(encoding="utf-8"))["automations"]
GIB = 1.024**3
"""GB in a gibibyte, as Docker and Kubernetes count."""


def test_automations_leave_other_flows_of_the_server_alone() -> None:
    """Heartbeats of others come every 180 s, Prefect's default: a run of theirs would be marked as crashed."""
    ours = {one["entrypoint"].rpartition(".")[2] for one in DEPLOYMENTS}
    for one in AUTOMATIONS:
        related = one["trigger"]["match_related"]
        names = related["prefect.resource.name"]
        assert related["prefect.resource.role"] == "flow"
        assert {names} <= ours if isinstance(names, str) else set(names) <= ours
    silent = next(one["trigger"] for one in AUTOMATIONS if one["trigger"]["posture"] == "Proactive")
    assert set(silent["match_related"]["prefect.resource.name"]) == ours
    quiet = {"Completed", "CompletedWithWarnings", "Skipped", "Failed", "Cancelled", "Crashed", "AwaitingRetry"}
    assert {f"prefect.flow-run.{name}" for name in quiet} <= set(silent["expect"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "SCAN2SIM_SOURCE: is not set"),
        ({"SCAN2SIM_SOURCE": "/data/drive"}, "SCAN2SIM_OUT: is not set"),
        ({"SCAN2SIM_SOURCE": "s3://bucket/tiles", "SCAN2SIM_OUT": "town"}, "town: is a relative path"),
    ],
)
def test_setup_names_paths_that_nightly_runs_would_not_find(given: dict[str, str], message: str) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SCAN2SIM_")}
    done = subprocess.run(["sh", "deploy/setup"], cwd=ROOT, env=environment | given, capture_output=True, text=True)
    assert done.returncode != 0 and message in done.stderr, done.stderr


def test_memory_of_steps_is_less_than_that_of_their_container() -> None:
    """Kubernetes kills all processes of a container that exceeds its memory, not only the largest one."""
    limits = {"scan2sim-docker": "mem_limit", "scan2sim-kubernetes": "memory_limit"}
    for one in DEPLOYMENTS:
        pool = one["work_pool"]
        if pool["name"] in limits:
            limit = int(re.sub(r"(?i)gi?$", "", pool["job_variables"][limits[pool["name"]]])) * GIB
            assert present(parse_memory(one["parameters"]["memory"])) < 0.8 * limit, one["name"]


def test_containers_of_the_docker_pool_reach_the_server_of_compose() -> None:
    """It listens on the host's loopback, and so isn't `host.docker.internal`, Prefect's default."""
    services = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
    for pool in (one["work_pool"] for one in DEPLOYMENTS if one["work_pool"]["name"] == "scan2sim-docker"):
        variables = pool["job_variables"]
        assert variables["networks"] == [services["networks"]["default"]["name"]]
        assert variables["env"]["PREFECT_API_URL"] == services["x-scan2sim"]["environment"]["PREFECT_API_URL"]


def test_pods_are_admitted_where_root_is_forbidden_and_start_without_a_walk_over_the_volume() -> None:
    pod = TEMPLATE["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert pod["securityContext"]["runAsNonRoot"] and pod["securityContext"]["fsGroupChangePolicy"] == "OnRootMismatch"
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    users = re.findall(r"^USER (.*)$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    assert users and all(user.isdecimal() and user != "0" for user in users), "a name can't be checked"


def test_template_has_a_variable_for_every_placeholder() -> None:
    known = TEMPLATE["variables"]["properties"]
    for name in re.findall(r"\{\{ (\w+) \}\}", json.dumps(TEMPLATE["job_configuration"])):
        assert name in known
    for one in DEPLOYMENTS:
        if one["work_pool"]["name"] == "scan2sim-kubernetes":
            assert set(one["work_pool"]["job_variables"]) <= set(known)
