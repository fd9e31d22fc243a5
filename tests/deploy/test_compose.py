"""Services of compose.yaml that the pages refer to."""

from __future__ import annotations

from typing import Any

import yaml

from tests.conftest import ROOT

SERVICES: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))["services"]


def test_services_reach_each_other_where_docker_passes_a_proxy_on() -> None:
    for name in ("server", "setup", "worker"):
        for variable in ("NO_PROXY", "no_proxy"):
            hosts = SERVICES[name]["environment"][variable].rpartition("}")[2].split(",")
            assert {"localhost", "server", "database", "broker"} <= set(hosts), name


def listeners(text: str) -> dict[str, str]:
    """Addresses by name of the listener."""
    return dict(one.split("://") for one in text.split(","))


def test_the_broker_has_the_addresses_of_the_pages() -> None:
    broker = SERVICES["broker"]
    settings = broker["environment"]
    listens, announced = (listeners(settings[f"KAFKA_{name}LISTENERS"]) for name in ("", "ADVERTISED_"))
    page = (ROOT / "docs" / "monitoring.md").read_text(encoding="utf-8")
    quickstart = page.partition("## Try it")[2].partition("## ")[0]
    assert announced["HOST"] in quickstart, "the quickstart's commands work with it as they are"
    assert announced["CONTAINERS"] in page
    assert announced["CONTAINERS"].split(":")[0] == "broker", "its name in the network of the containers"
    for name, address in announced.items():
        assert listens[name].rpartition(":")[2] == address.rpartition(":")[2], name
    assert set(listens) == {*announced, settings["KAFKA_CONTROLLER_LISTENER_NAMES"]}
    protocols = dict(one.split(":") for one in settings["KAFKA_LISTENER_SECURITY_PROTOCOL_MAP"].split(","))
    assert set(protocols) == set(listens) and settings["KAFKA_INTER_BROKER_LISTENER_NAME"] in announced
    assert broker["ports"] == ["127.0.0.1:9092:9092"], "it has no passwords: no other machine may reach it"
    assert f"{settings['KAFKA_NODE_ID']}@{listens['CONTROLLER']}" == settings["KAFKA_CONTROLLER_QUORUM_VOTERS"]
    assert any(volume.endswith(settings["KAFKA_LOG_DIRS"]) for volume in broker["volumes"]), "records survive a restart"
