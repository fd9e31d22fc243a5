"""Qualities of service that don't fit are told, with both profiles."""

from __future__ import annotations

import pytest

from scan2sim.services.monitoring.node.qos_check import incompatible, remarks
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
def test_what_is_offered_must_be_as_good_as_what_is_requested(
    offered: QoS, requested: QoS, policies: list[str]
) -> None:
    assert [one.split()[0] for one in incompatible(offered, requested)] == policies


def test_both_profiles_are_told() -> None:
    found = remarks("/t", [
        endpoint("PUBLISHER", QoS(reliability="BEST_EFFORT"), node="camera"),
        endpoint("SUBSCRIPTION", QoS(deadline=10**9), node="viewer"),
    ])  # fmt: skip
    assert len(found) == 1
    for text in ("camera to viewer", "offered BEST_EFFORT", "requested RELIABLE", "deadline 1 s"):
        assert text in found[0]


def test_types_that_differ_and_publishers_of_one_id_are_told() -> None:
    found = remarks("/t", [
        endpoint("PUBLISHER", QoS(), node="one"),
        endpoint("PUBLISHER", QoS(), node="two"),
        endpoint("SUBSCRIPTION", QoS(), node="viewer", gid=b"2", type_name="c/msg/D"),
    ])  # fmt: skip
    assert [text for text in found if "two publishers have one id" in text]
    assert [text for text in found if "types differ, a/msg/B and c/msg/D" in text]
