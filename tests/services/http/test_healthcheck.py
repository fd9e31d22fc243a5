"""Health check of containers: readiness of a service as an exit code."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")

from scan2sim.services.http import factory, healthcheck
from scan2sim.services.http.settings import ServerParams
from tests.waiting import until


def start_service(states: list[bool], params: ServerParams) -> str:
    """Start a service whose readiness is the last of `states`; returns its address."""
    addresses: list[str] = []
    app = factory.application("a test", params, alive={}, ready={"model": lambda: states[-1]})
    threading.Thread(target=factory.run, args=(app, params, addresses.append), daemon=True).start()
    until(lambda: addresses)
    return addresses[0]


def exit_code(address: str, monkeypatch: pytest.MonkeyPatch) -> object:
    monkeypatch.setattr(healthcheck, "TIMEOUT_S", 60.0)  # the service of a test may be slow
    monkeypatch.setattr(sys, "argv", ["ready", address])
    try:
        healthcheck.main()
    except SystemExit as end:
        return end.code
    return None


def test_exit_code_and_cause_reflect_readiness(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "token").write_text("0123456789abcdef", encoding="utf-8")
    monkeypatch.setenv("http_proxy", "http://localhost:9")
    states = [True]
    address = start_service(states, ServerParams(port=0, token=tmp_path / "token"))
    assert exit_code(address, monkeypatch) is None
    states.append(False)
    assert "503" in str(message := exit_code(address, monkeypatch)) and "model" in str(message)
    for other in ("http://localhost:1", "nonsense"):
        assert "is not ready" in str(exit_code(other, monkeypatch))


def test_certificate_of_another_name_is_accepted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", str(key), "-out", str(certificate),
         "-days", "1", "-subj", "/CN=robot.example"], check=True, capture_output=True,
    )  # fmt: skip
    address = start_service([True], ServerParams(port=0, certificate=certificate, key=key))
    assert exit_code(address.replace("127.0.0.1", "localhost"), monkeypatch) is None
