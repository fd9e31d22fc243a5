"""QoS compatibility of publishers and subscriptions: DDS silently doesn't match an incompatible pair.

Source: OMG DDS 1.4, section 2.2.3 (requested vs. offered): the offered value must be at least as strict as the
requested one.
"""

from __future__ import annotations

from collections.abc import Sequence

from scan2sim.services.transport.types import INFINITE, Endpoint, QoS

POLICY_ORDER = {
    "reliability": ("BEST_EFFORT", "RELIABLE"),
    "durability": ("VOLATILE", "TRANSIENT_LOCAL"),
    "liveliness": ("AUTOMATIC", "MANUAL_BY_TOPIC"),
}
"""Values of each policy, from the weakest to the strictest."""


def incompatible(offered: QoS, requested: QoS) -> list[str]:
    """Incompatible policies, as "reliability is BEST_EFFORT but RELIABLE is requested"."""
    found = []
    for policy, order in POLICY_ORDER.items():
        has, wants = getattr(offered, policy), getattr(requested, policy)
        if has in order and wants in order and order.index(has) < order.index(wants):
            found.append(f"{policy} is {has} but {wants} is requested")
    for policy in ("deadline", "lease"):
        has, wants = getattr(offered, policy), getattr(requested, policy)
        if has > wants:
            found.append(f"{policy} is {_duration(has)} but {_duration(wants)} is requested")
    return found


def qos_warnings(topic: str, endpoints: Sequence[Endpoint]) -> list[str]:
    """Warnings about publishers and subscriptions of a topic that don't match, with both QoS profiles."""
    publishers = [one for one in endpoints if one.kind == "PUBLISHER"]
    subscriptions = [one for one in endpoints if one.kind == "SUBSCRIPTION"]
    found = []
    for publisher in publishers:
        for subscription in subscriptions:
            between = f"{topic}: {publisher.node_name} to {subscription.node_name}"
            if publisher.type_name != subscription.type_name:
                found.append(f"{between}: types differ, {publisher.type_name} and {subscription.type_name}")
            elif mismatches := incompatible(publisher.qos, subscription.qos):
                found.append(
                    f"{between}: no messages, the QoS is incompatible: {', '.join(mismatches)} "
                    f"(offered {_profile(publisher.qos)}; requested {_profile(subscription.qos)})"
                )
    duplicates = {one.gid for one in publishers if sum(other.gid == one.gid for other in publishers) > 1}
    found += [
        f"{topic}: two publishers have the same GID, {gid.hex()}: losses can't be counted by publisher"
        for gid in duplicates
    ]
    return sorted(set(found))


def _profile(qos: QoS) -> str:
    limits = {"deadline": qos.deadline, "lease": qos.lease}
    finite = [f"{name} {_duration(value)}" for name, value in limits.items() if value < INFINITE]
    return ", ".join([qos.reliability, qos.durability, qos.liveliness, *finite])


def _duration(nanoseconds: int) -> str:
    return "infinite" if nanoseconds >= INFINITE else f"{nanoseconds / 1e9:g} s"
