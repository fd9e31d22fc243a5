"""What containers ask: whether a service is ready, by an exit code."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra bus isn't installed")

from scan2sim.services.http import factory, healthcheck
from scan2sim.services.http.settings import Served


def served(states: list[bool], how: Served) -> str:
    """The address of a service that is as ready as the last of states says."""
    told: list[str] = []
    app = factory.application("a test", how, alive={}, ready={"model": lambda: states[-1]})
    threading.Thread(target=factory.run, args=(app, how, told.append), daemon=True).start()
    deadline = time.monotonic() + 10
    while not told and time.monotonic() < deadline:
        time.sleep(0.01)
    return told[0]


def ended(address: str, monkeypatch: pytest.MonkeyPatch) -> object:
    monkeypatch.setattr(sys, "argv", ["ready", address])
    try:
        healthcheck.main()
    except SystemExit as end:
        return end.code
    return None


def test_who_is_ready_ends_well_and_who_is_not_says_why(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "token").write_text("0123456789abcdef", encoding="utf-8")
    monkeypatch.setenv("http_proxy", "http://localhost:9")
    states = [True]
    address = served(states, Served(port=0, token=tmp_path / "token"))
    assert ended(address, monkeypatch) is None
    states.append(False)
    assert "503" in str(told := ended(address, monkeypatch)) and "model" in str(told)
    for other in ("http://localhost:1", "nonsense"):
        assert "is not ready" in str(ended(other, monkeypatch))


def test_a_certificate_of_another_name_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", str(key), "-out", str(certificate),
         "-days", "1", "-subj", "/CN=robot.example"], check=True, capture_output=True,
    )  # fmt: skip
    address = served([True], Served(port=0, certificate=certificate, key=key))
    assert ended(address.replace("127.0.0.1", "localhost"), monkeypatch) is None
