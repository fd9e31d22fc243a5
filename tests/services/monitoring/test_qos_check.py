"""Warnings about incompatible QoS profiles."""

from __future__ import annotations

import pytest

from scan2sim.services.monitoring.node.qos_check import incompatible, qos_warnings
from scan2sim.services.transport import Endpoint, QoS


def endpoint(kind: str, qos: QoS, *, node: str = "node", gid: bytes = b"1", type_name: str = "a/msg/B") -> Endpoint:
    return Endpoint(node, "/", type_name, kind, gid, qos)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("offered", "requested", "policies"),
    [
        (QoS(), QoS(), []),
        (QoS(), QoS(reliability="BEST_EFFORT"), []),
        (QoS(reliability="BEST_EFFORT"), QoS(), ["reliability"]),
        (QoS(), QoS(durability="TRANSIENT_LOCAL"), ["durability"]),
        (QoS(durability="TRANSIENT_LOCAL"), QoS(), []),
        (QoS(), QoS(deadline=10**9), ["deadline"]),
        (QoS(deadline=10**8), QoS(deadline=10**9), []),
        (
            QoS(reliability="BEST_EFFORT"),
            QoS(liveliness="MANUAL_BY_TOPIC", lease=5),
            ["reliability", "liveliness", "lease"],
        ),
    ],
)
def test_offered_policies_must_be_at_least_as_strict_as_requested(
    offered: QoS, requested: QoS, policies: list[str]
) -> None:
    assert [one.split()[0] for one in incompatible(offered, requested)] == policies


def test_warning_contains_both_profiles() -> None:
    found = qos_warnings("/t", [
        endpoint("PUBLISHER", QoS(reliability="BEST_EFFORT"), node="camera"),
        endpoint("SUBSCRIPTION", QoS(deadline=10**9), node="viewer"),
    ])  # fmt: skip
    assert len(found) == 1
    for text in ("camera to viewer", "offered BEST_EFFORT", "requested RELIABLE", "deadline 1 s"):
        assert text in found[0]


def test_different_types_and_duplicate_gids_are_reported() -> None:
    found = qos_warnings("/t", [
        endpoint("PUBLISHER", QoS(), node="one"),
        endpoint("PUBLISHER", QoS(), node="two"),
        endpoint("SUBSCRIPTION", QoS(), node="viewer", gid=b"2", type_name="c/msg/D"),
    ])  # fmt: skip
    assert [text for text in found if "two publishers have the same GID" in text]
    assert [text for text in found if "types differ, a/msg/B and c/msg/D" in text]
