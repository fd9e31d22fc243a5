"""Deployments on a real server with a real worker and schedule; messages when something is missing or has failed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from scan2sim.flows.engine.versions import check_version, versions
from scan2sim.pipeline.core.errors import IncompleteError, UnavailableError, exit_code
from tests.conftest import ROOT
from tests.fakes.ports import free_port
from tests.flows.prefect.conftest import API_PAUSE_S, NewDatabase, Server, kill, on, serving
from tests.flows.prefect.toy_steps import planned
from tests.flows.processes import processes
from tests.waiting import until

DEPLOYED = ["reprocess", "survey", "tile"]


@pytest.fixture(scope="module")
def worker(server: Server) -> Iterator[Path]:
    """Log of a worker of the toys, which starts before there is their pool."""
    with server.worker("toys"):
        yield server.home / "toys.log"


@pytest.fixture(scope="module")
def toys(server: Server, worker: Path) -> Server:
    """A server with a worker, the toy deployments, and those for containers."""
    commands = server.cli(
        "work-pool create toys --type process",
        "deploy --prefect-file tests/flows/prefect/toy.yaml --all",
        "work-pool create scan2sim-docker --type docker",
        "work-pool create scan2sim-kubernetes --type kubernetes --base-job-template deploy/kubernetes.json",
        "deploy -n *-docker -n *-kubernetes",
    )
    assert commands.returncode == 0, commands.stdout
    return server


@on("sqlite")
def test_missing_work_pool_is_named(server: Server, worker: Path) -> None:
    """Must be the first test: there is no pool yet. The next tests use the same worker."""
    deployed = server.cli("deploy -n tile")
    assert deployed.returncode != 0
    assert "work pool 'scan2sim-process' which does not exist" in deployed.stdout
    until(lambda: "Work pool 'toys' not found!" in worker.read_text(encoding="utf-8"), what="a warning")


@on("sqlite")
def test_server_accepts_all_deployments_and_automations(toys: Server) -> None:
    server, pools = toys, {kind: f"scan2sim-{kind}" for kind in ("process", "docker", "kubernetes")}
    setup = server.script("deploy/setup", SCAN2SIM_SOURCE="/data/drive", SCAN2SIM_OUT="/data/worlds")
    assert setup.returncode == 0, setup.stdout

    for kind, pool in pools.items():
        known = server.api("GET", f"/work_pools/{pool}")["base_job_template"]["variables"]["properties"]
        for name in DEPLOYED:
            made = server.deployment(name, name if kind == "process" else f"{name}-{kind}")
            assert made["work_pool_name"] == pool
            assert set(made["job_variables"]) <= set(known)
            assert made["job_variables"]["env"]["PREFECT_FLOWS_HEARTBEAT_FREQUENCY"] == "30"
            assert made["entrypoint"] == f"scan2sim.flows.deployed.{name}.{name}" and not made["pull_steps"]
            assert not set(made["parameters"]) - set(made["parameter_openapi_schema"]["properties"])
    nightly = server.deployment("reprocess", "reprocess")
    assert nightly["parameters"]["source"] == "/data/drive" and nightly["parameters"]["out"] == "/data/worlds"
    assert nightly["global_concurrency_limit"]["limit"] == 1
    assert nightly["concurrency_options"]["collision_strategy"] == "CANCEL_NEW"
    due = until(lambda: server.runs(nightly, "SCHEDULED"), 30, what="a run that is scheduled", max_pause=API_PAUSE_S)
    assert {datetime.fromisoformat(run["expected_start_time"]).strftime("%H:%M %z") for run in due} == {"02:00 +0000"}
    assert len(server.api("POST", "/automations/filter", {})) == 2


@on("sqlite", pytest.param("postgres", marks=pytest.mark.slow))
def test_scheduled_run_is_executed_without_overlap(toys: Server, folder: Path) -> None:
    """Overlapping scheduled runs are cancelled; a run started manually finds the folder locked and is skipped."""
    nightly, other = toys.deployment("toy", "one-at-a-time"), toys.deployment("toy", "any")
    parameters = {"folder": str(folder), "gate": str(folder / "gate")}
    with toys.scheduled(nightly, parameters, interval=5.0):
        until((folder / "started").exists, 200, what="its first step")
        (first,) = toys.runs(nightly, "RUNNING")
        state = toys.ended(toys.run(other, **parameters))
        assert state["name"] == "Skipped" and "another run is using this folder" in state["message"]
        until(lambda: toys.runs(nightly, "CANCELLED"), 200, what="a cancelled run", max_pause=API_PAUSE_S)
    (folder / "gate").touch()
    state = toys.ended(first["id"])
    assert (state["type"], state["message"]) == ("COMPLETED", "total 4")
    assert first["auto_scheduled"]
    assert len((folder / "log").read_text(encoding="utf-8").split()) == 3

    with toys.scheduled(nightly, parameters, cron="0 2 * * *", timezone="Etc/UTC"):
        # with SQLAlchemy 2.1 and PostgreSQL, this run never appeared
        until(lambda: toys.runs(nightly, "SCHEDULED"), what="a run at two", max_pause=API_PAUSE_S)


@on("sqlite")
def test_incomplete_world_ends_with_a_warning_state_and_exit_code(server: Server, tmp_path: Path) -> None:
    done = server.script(sys.executable, "-m", "tests.flows.prefect.incomplete", str(tmp_path))
    assert done.returncode == exit_code(IncompleteError("", "")), done.stdout
    cause = "the world is finished, but a side product failed: roads"
    for flow, page in (("tile", "report"), ("survey", "survey"), ("reprocess", "survey")):
        assert f"{flow}: COMPLETED CompletedWithWarnings: {cause} {tmp_path / page}.html\n" in done.stdout
    assert f"warning: {tmp_path / 'world'}: {cause}\n" in done.stdout
    assert "Run again to retry what failed" in done.stdout and "Traceback" not in done.stdout


def test_unreachable_server_is_named(tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{free_port()}/api"
    command = ["survey", "data_samples/tile", "--out", str(tmp_path / "out"), "--runner", "dask"]
    run = subprocess.run(
        [sys.executable, "-m", "scan2sim.flows.cli", *command],
        env=os.environ | {"PREFECT_API_URL": url, "PREFECT_HOME": str(tmp_path)},
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == exit_code(UnavailableError("", "", "")), run.stderr
    assert f"{url}: the Prefect server doesn't answer" in run.stderr and "prefect server start" in run.stderr


def test_other_versions_are_rejected(folder: Path) -> None:
    item = planned(folder, 1)[0]
    check_version(item, versions())
    with pytest.raises(UnavailableError, match=r"this worker has scan2sim \S+ instead of 9\.9.*versions of the flow"):
        check_version(item, {**versions(), "scan2sim": "9.9"})


@on("sqlite")
def test_worker_with_another_version_fails_the_run(toys: Server, folder: Path) -> None:
    state = toys.ended(toys.run(toys.deployment("toy", "any"), folder=str(folder), pretend="9.9"))
    assert state["type"] == "FAILED" and "instead of 9.9" in state["message"]
    assert not (folder / "log").exists()


@pytest.mark.slow
def test_run_of_a_killed_worker_is_detected_and_rescheduled(
    tmp_path: Path, folder: Path, new_database: NewDatabase
) -> None:
    text = (ROOT / "deploy" / "automations.yaml").read_text(encoding="utf-8")
    for flows in ("[reprocess, survey, tile]", "reprocess"):
        text = text.replace(f"prefect.resource.name: {flows}", "prefect.resource.name: toy")
    (tmp_path / "automations.yaml").write_text(text, encoding="utf-8")
    with serving("sqlite", tmp_path, new_database) as server:
        server.env |= {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30", "TOY_FOLDER": str(folder)}
        commands = server.cli(
            "work-pool create toys --type process",
            "deploy --prefect-file tests/flows/prefect/toy.yaml --all",
            f"automation create --from-file '{tmp_path / 'automations.yaml'}'",
        )
        assert commands.returncode == 0, commands.stdout
        deployment = server.deployment("toy", "one-at-a-time")
        with server.worker("toys") as worker:
            run = server.run(deployment, folder=str(folder), gate=str(folder / "gate"))
            until((folder / "started").exists, 200, what="its first step")
            until(lambda: server.heartbeats(run), what="its first heartbeat", max_pause=API_PAUSE_S)
            kill(worker)
        for pid in processes("PREFECT__FLOW_RUN_ID", run):
            os.kill(pid, signal.SIGKILL)
        assert server.api("GET", f"/flow_runs/{run}")["state"]["type"] == "RUNNING"
        assert server.ended(run)["type"] == "CRASHED"
        (again,) = until(
            lambda: server.runs(deployment, "SCHEDULED"), 30, what="a run in ten minutes", max_pause=API_PAUSE_S
        )
        ahead = datetime.fromisoformat(again["expected_start_time"]) - datetime.now().astimezone()
        assert timedelta(minutes=8) < ahead < timedelta(minutes=11)
