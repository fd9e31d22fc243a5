"""The temporary Prefect server on machines that reach the Internet through a proxy."""

from __future__ import annotations

import urllib.request

import pytest

pytest.importorskip("prefect", reason="Prefect isn't installed")

from scan2sim.flows.deployed.prefect_server import LOOPBACK, bypass_proxy


def test_the_temporary_server_is_reached_without_the_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://proxy.example.com:3128")
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.setenv(name, "intranet.example.com")
    bypass_proxy(LOOPBACK)
    found = [urllib.request.proxy_bypass(host) for host in (f"{LOOPBACK}:4200", "intranet.example.com", "example.com")]
    assert [bool(one) for one in found] == [True, True, False]
