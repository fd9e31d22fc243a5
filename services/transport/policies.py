"""Qualities of service as cyclonedds has them."""

from __future__ import annotations

from cyclonedds.qos import Policy, Qos

from scan2sim.services.transport.types import INFINITE, Durability, QoS

BLOCKED = 100_000_000
"""Nanoseconds that a reliable publisher waits for a full queue, as ROS 2's middleware does."""


def policies(qos: QoS, userdata: bytes = b"") -> Qos:
    """A profile in DDS's terms."""
    liveliness = Policy.Liveliness.ManualByTopic if qos.liveliness == "MANUAL_BY_TOPIC" else Policy.Liveliness.Automatic
    chosen = [
        Policy.Reliability.Reliable(BLOCKED) if qos.reliability == "RELIABLE" else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.durability == "TRANSIENT_LOCAL" else Policy.Durability.Volatile,
        Policy.History.KeepLast(qos.depth) if qos.depth else Policy.History.KeepAll,
        Policy.Deadline(qos.deadline),
        liveliness(qos.lease),
    ]
    if userdata:  # subscriptions have neither
        chosen += [Policy.Lifespan(qos.lifespan), Policy.Userdata(userdata)]
    return Qos(*chosen)


def qos_of(found: Qos) -> QoS:
    """A profile of DDS's terms, as discovery has them; what it leaves out has its default."""
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
