"""Whether a publisher's and a subscription's quality of service fit: DDS connects no pair that doesn't, without a word.

Source: OMG DDS 1.4, section 2.2.3 (requested against offered): what is offered must be as good as what is requested.
"""

from __future__ import annotations

from collections.abc import Sequence

from scan2sim.services.transport.types import INFINITE, Endpoint, QoS

STRICTER = {
    "reliability": ("BEST_EFFORT", "RELIABLE"),
    "durability": ("VOLATILE", "TRANSIENT_LOCAL"),
    "liveliness": ("AUTOMATIC", "MANUAL_BY_TOPIC"),
}
"""Values of a policy, each stricter than those before."""


def incompatible(offered: QoS, requested: QoS) -> list[str]:
    """Policies that don't fit, each as "reliability BEST_EFFORT for RELIABLE"."""
    found = []
    for policy, order in STRICTER.items():
        has, wants = getattr(offered, policy), getattr(requested, policy)
        if has in order and wants in order and order.index(has) < order.index(wants):
            found.append(f"{policy} {has} for {wants}")
    for policy in ("deadline", "lease"):
        has, wants = getattr(offered, policy), getattr(requested, policy)
        if has > wants:
            found.append(f"{policy} {_duration(has)} for {_duration(wants)}")
    return found


def remarks(topic: str, endpoints: Sequence[Endpoint]) -> list[str]:
    """What keeps a topic's publishers and subscriptions apart, in words, with both profiles."""
    publishers = [one for one in endpoints if one.kind == "PUBLISHER"]
    subscriptions = [one for one in endpoints if one.kind == "SUBSCRIPTION"]
    found = []
    for publisher in publishers:
        for subscription in subscriptions:
            between = f"{topic}: {publisher.node_name} to {subscription.node_name}"
            if publisher.type_name != subscription.type_name:
                found.append(f"{between}: types differ, {publisher.type_name} and {subscription.type_name}")
            elif misfits := incompatible(publisher.qos, subscription.qos):
                found.append(
                    f"{between}: nothing goes, {', '.join(misfits)} "
                    f"(offered {_profile(publisher.qos)}; requested {_profile(subscription.qos)})"
                )
    doubles = {one.gid for one in publishers if sum(other.gid == one.gid for other in publishers) > 1}
    found += [
        f"{topic}: two publishers have one id, {gid.hex()}: their messages can't be told apart" for gid in doubles
    ]
    return sorted(set(found))


def _profile(qos: QoS) -> str:
    limits = {"deadline": qos.deadline, "lease": qos.lease}
    told = [f"{name} {_duration(value)}" for name, value in limits.items() if value < INFINITE]
    return ", ".join([qos.reliability, qos.durability, qos.liveliness, *told])


def _duration(nanoseconds: int) -> str:
    return "never" if nanoseconds >= INFINITE else f"{nanoseconds / 1e9:g} s"
