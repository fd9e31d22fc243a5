"""Conversion of QoS profiles to and from cyclonedds."""

from __future__ import annotations

from cyclonedds.qos import Policy, Qos

from scan2sim.services.transport.types import INFINITE, Durability, QoS

MAX_BLOCKING_NS = 100_000_000
"""Time that a reliable publisher waits when its queue is full (max_blocking_time), as in ROS 2's middleware."""


def policies(qos: QoS, userdata: bytes = b"") -> Qos:
    """Convert a QoS profile to DDS policies."""
    liveliness = Policy.Liveliness.ManualByTopic if qos.liveliness == "MANUAL_BY_TOPIC" else Policy.Liveliness.Automatic
    chosen = [
        Policy.Reliability.Reliable(MAX_BLOCKING_NS)
        if qos.reliability == "RELIABLE"
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.durability == "TRANSIENT_LOCAL" else Policy.Durability.Volatile,
        Policy.History.KeepLast(qos.depth) if qos.depth else Policy.History.KeepAll,
        Policy.Deadline(qos.deadline),
        liveliness(qos.lease),
    ]
    if userdata:  # publishers only
        chosen += [Policy.Lifespan(qos.lifespan), Policy.Userdata(userdata)]
    return Qos(*chosen)


def qos_of(found: Qos) -> QoS:
    """Convert discovered DDS policies to a QoS profile; missing policies have their defaults."""
    scopes = {policy.__scope__: policy for policy in found}
    reliability, history = scopes.get("Reliability"), scopes.get("History")
    liveliness = scopes.get("Liveliness")
    durability: Durability = "VOLATILE" if scopes.get("Durability") == Policy.Durability.Volatile else "TRANSIENT_LOCAL"
    return QoS(
        reliability="BEST_EFFORT" if reliability == Policy.Reliability.BestEffort else "RELIABLE",
        durability=durability if "Durability" in scopes else "VOLATILE",
        depth=getattr(history, "depth", 0),
        lifespan=getattr(scopes.get("Lifespan"), "lifespan", INFINITE),
        deadline=getattr(scopes.get("Deadline"), "deadline", INFINITE),
        liveliness="MANUAL_BY_TOPIC" if isinstance(liveliness, Policy.Liveliness.ManualByTopic) else "AUTOMATIC",
        lease=getattr(liveliness, "lease_duration", INFINITE),
    )
