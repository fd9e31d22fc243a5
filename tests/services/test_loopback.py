"""Servers refuse to listen on an address that other machines can reach without a token, key or certificate."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.http.settings import ServerParams
from scan2sim.services.loopback import is_loopback, require_protection
from scan2sim.services.monitoring.settings.dashboard import PageParams as MonitorPage
from scan2sim.services.orchestration.settings import PageParams as OrchestrationPage
from scan2sim.services.teleoperation.settings import GatewayParams, StationParams
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams
from scan2sim.services.toolboxes.settings import ServeParams
from tests.conftest import ROOT
from tests.flows.command import in_process

LOOPBACK = ("127.0.0.1", "127.1.2.3", "::1", "[::1]", "localhost", "LOCALHOST")
NOT_LOOPBACK = ("0.0.0.0", "::", "", "192.0.2.1", "10.0.0.1", "::ffff:192.0.2.1", "robot.example", "127.robot.example")


@pytest.mark.parametrize("host", LOOPBACK)
def test_loopback_addresses_need_no_protection(host: str) -> None:
    assert is_loopback(host)
    require_protection(host, protected=False, options="--token FILE")
    assert ServerParams(host=host).is_local()


@pytest.mark.parametrize("host", NOT_LOOPBACK)
def test_other_addresses_need_protection(host: str) -> None:
    assert not is_loopback(host)
    require_protection(host, protected=True, options="--token FILE")
    with pytest.raises(SettingError, match=r"--host: other machines .*Give --token FILE, or .*127\.0\.0\.1"):
        require_protection(host, protected=False, options="--token FILE")


SOME_FILE = Path("file")
LISTENERS: list[tuple[type[Any], dict[str, object]]] = [
    (ServerParams, {}),
    (MonitorPage, {}),
    (OrchestrationPage, {"packages": SOME_FILE}),
    (ServeParams, {}),
    (GatewayParams, {"certificates": SOME_FILE}),
    (StationParams, {"certificates": SOME_FILE, "gateway": "gate.example"}),
]
"""Settings of every server with a web page or API, and the settings that each requires."""


@pytest.mark.parametrize(("kind", "given"), LISTENERS, ids=lambda value: getattr(value, "__name__", ""))
@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1"])
def test_no_server_listens_unprotected_beyond_loopback(kind: type[Any], given: dict[str, object], host: str) -> None:
    kind(**given, host="127.0.0.1")
    with pytest.raises(SettingError, match="--key"):
        kind(**given, host=host)
    for protection in ({"token": SOME_FILE}, {"certificate": SOME_FILE}):
        assert kind(**given, host=host, **protection).host == host
    with pytest.raises(SettingError, match="--token FILE, or --certificate and --key"):
        kind(**given, host=host, key=SOME_FILE)  # the key of TLS without its certificate


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "0.0.0.0", "192.0.2.1"])
def test_adapter_requires_its_key_everywhere(host: str) -> None:
    """On loopback as well: any program of the machine could drive the vehicle otherwise."""
    with pytest.raises(SettingError, match="--key: is missing: any program"):
        AdapterParams(host=host)
    assert AdapterParams(host=host, key=SOME_FILE).host == host


def command(*words: object) -> tuple[int, str]:
    """Run `scan2sim` in this process; returns its exit code and its errors."""
    done = in_process(*words)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("monitor", "page"),
        ("toolbox", "serve", "detect"),
        ("orchestrate", "page", "packages", "--cluster", "edge"),
        ("teleop", "gateway", "certificates"),
        ("teleop", "station", "certificates", "gate.example"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_commands_refuse_unprotected_hosts_before_starting(words: tuple[str, ...]) -> None:
    code, errors = command(*words, "--host", "0.0.0.0")
    assert code == 2, errors
    assert "other machines can reach 0.0.0.0" in errors
    assert "Give --token FILE" in errors
    assert "Traceback" not in errors


def test_adapter_command_refuses_to_start_without_key() -> None:
    code, errors = command("teleop", "adapter", "ros")
    assert code == 2 and "--key: is missing" in errors and "Traceback" not in errors


@pytest.mark.parametrize("words", [("gateway",), ("station", "gate.example")], ids=lambda words: words[0])
def test_gateway_and_station_listen_only_with_a_certificate(words: tuple[str, ...], tmp_path: Path) -> None:
    """`--listening` defaults to all addresses; TLS and DTLS there require a certificate on both ends."""
    pytest.importorskip("OpenSSL", reason="the extra teleop isn't installed")
    role, *rest = words
    code, errors = command("teleop", role, tmp_path / "none", *rest, "--port", "0")
    assert code == 3 and "certificate.pem" in errors and "Traceback" not in errors


def test_prometheus_metrics_listen_on_loopback_only() -> None:
    pytest.importorskip("prometheus_client", reason="the extra bus isn't installed")
    from scan2sim.services.monitoring.export.sinks import PrometheusSink

    sink = PrometheusSink(0)
    try:
        assert is_loopback(str(sink._server.server_address[0]))
    finally:
        sink.close()


LISTENING = """
import psutil
from scan2sim.flows.engine import workers

if __name__ == "__main__":
    with workers._dask(1, None, print):
        own = psutil.Process()
        for process in (own, *own.children(recursive=True)):
            print(*(one.laddr.ip for one in process.net_connections("tcp") if one.status == psutil.CONN_LISTEN))
"""


def test_dask_temporary_cluster_listens_on_loopback_only(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="distributed isn't installed")
    (script := tmp_path / "listening.py").write_text(LISTENING, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, timeout=120)
    addresses = done.stdout.split()
    assert len(addresses) >= 2 and all(map(is_loopback, addresses)), done.stdout + done.stderr
