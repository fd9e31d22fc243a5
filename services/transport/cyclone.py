"""The transport over cyclonedds: nodes without ROS 2 that speak its names, types and hashes on DDS.

cyclonedds hands its readers neither the number that a publisher gave a message nor who it is, so both follow behind the
message's own bytes (`envelope`), with the time of sending; who doesn't know of them reads past them. Messages of fixed
size have no room for that in Fast DDS's readers: they go without, and their losses can't be counted.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from typing import Any

from cyclonedds.core import GuardCondition, ReadCondition, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from scan2sim.services.transport import envelope, idl
from scan2sim.services.transport.graph import ALIVE, Entities, Graph
from scan2sim.services.transport.names import dds_topic, qualified
from scan2sim.services.transport.policies import policies
from scan2sim.services.transport.types import Arrival, Endpoint, QoS, as_qos

SETTINGS = """
<CycloneDDS><Domain>
  <General><MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize></General>
  <Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>
"""
"""Large fragments: images cross in tenths of the time. Fast DDS (vendor 1.15) describes arrays in a way that cyclonedds
refuses, so its types are compared by name. What CYCLONEDDS_URI says goes before these."""
TAKEN, QUANTUM = 64, 2**20
"""Messages of a topic taken at once, and about how many bytes: a large topic's don't keep small ones waiting (deficit
round robin: Shreedhar and Varghese, 1995)."""


class _Context:
    """The process's participant on the network, which its nodes share."""

    def __init__(self, domain: int) -> None:
        self._domain = Domain(domain, ",".join(filter(None, [SETTINGS.strip(), os.environ.get("CYCLONEDDS_URI")])))
        self.participant = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))
        self.graph = Graph(self.participant)


_joined: list[_Context] = []


class Publisher:
    """Sends messages of one type (`services.transport.Publisher`); may be used from any thread."""

    def __init__(self, node: Node, msg_type: Any, topic: str, qos: QoS) -> None:
        self._node, self.topic_name = node, qualified(topic, node.get_namespace())
        self._type = type_name(msg_type)
        hashed = f"typehash={idl.STORE.hash_rihs01(self._type)};".encode()
        self._sample = idl.sample_type(self._type)
        self._wraps = idl.unbounded(self._type)
        participant = _context().participant
        self._writer = DataWriter(
            participant, Topic(participant, dds_topic(self.topic_name), self._sample), policies(qos, hashed)
        )
        self.gid = self._writer.guid.bytes
        self._number = 0
        self._lock = threading.Lock()

    def publish(self, message: Any) -> None:
        """Send a message, or bytes of CDR."""
        data = message if isinstance(message, bytes) else idl.STORE.serialize_cdr(message, self._type)
        with self._lock:
            self._number += 1
            self._writer.write(self._sample(self._wrapped(data)))
        self._node.published(self.topic_name, len(data))

    def _wrapped(self, data: bytes | memoryview) -> bytes:
        return envelope.wrapped(data, self._number, self.gid, time.time_ns()) if self._wraps else bytes(data)

    def get_subscription_count(self) -> int:
        """Subscriptions that are matched now."""
        return len(self._writer.get_matched_subscriptions())


class Subscription:
    """Hands messages of one topic on."""

    def __init__(
        self, node: Node, msg_type: Any, topic: str, callback: Callable[..., None], qos: QoS, raw: bool
    ) -> None:
        self._node, self.topic_name = node, qualified(topic, node.get_namespace())
        self._type, self._callback, self._raw, self._most = type_name(msg_type), callback, raw, 1
        sample = msg_type.sample if isinstance(msg_type, idl.Foreign) else idl.sample_type(self._type)
        participant = _context().participant
        self.reader: DataReader[Any] = DataReader(
            participant, Topic(participant, dds_topic(self.topic_name), sample), policies(qos)
        )
        self.gid = self.reader.guid.bytes
        self.condition = ReadCondition(self.reader, ALIVE)

    def take(self) -> None:
        """Hand on what has come."""
        for sample in self.reader.take(self._most):
            if not sample.sample_info.valid_data:
                continue
            data, header = envelope.opened(sample.data)
            number, publisher, sent = header or (None, None, sample.sample_info.source_timestamp)
            size = len(data)
            self._most = max(1, min(TAKEN, QUANTUM // (size + 1)))
            self._node.received(Arrival(self.topic_name, size, time.time_ns(), sent, publisher, number))
            try:
                message = bytes(data) if self._raw else idl.STORE.deserialize_cdr(data, self._type)
            except Exception:  # of many kinds: what comes from the network may be anything
                self._node.unreadable(self.topic_name)
                continue
            self._callback(message)


class Timer:
    """Calls something every so many seconds, when its node is spun."""

    def __init__(self, period: float, callback: Callable[[], None]) -> None:
        self.period, self._callback, self.due = period, callback, time.monotonic() + period

    def cancel(self) -> None:
        """Call no more."""
        self.due = float("inf")

    def call(self) -> None:
        """Call; a timer that was missed isn't called twice."""
        self.due = max(self.due + self.period, time.monotonic())
        self._callback()


class Node:
    """A node of ROS 2 without ROS 2 (`services.transport.Node`)."""

    def __init__(self, node_name: str, *, namespace: str = "/", hidden: bool = False) -> None:
        """As `services.transport.Node`'s; the name alone says whether it is hidden."""
        self._name, self._namespace = node_name, namespace if namespace.startswith("/") else f"/{namespace}"
        self._entities = Entities(self._namespace, node_name)
        self._subscriptions: list[Subscription] = []
        self._timers: list[Timer] = []
        self._waiting = WaitSet(_context().participant)
        self._wake = GuardCondition(_context().participant)
        self._waiting.attach(self._wake)
        _context().graph.announce(self._entities)

    def get_name(self) -> str:
        """Its name."""
        return self._name

    def get_namespace(self) -> str:
        """Its namespace."""
        return self._namespace

    def get_logger(self) -> logging.Logger:
        """Where it logs to."""
        return logging.getLogger(self._name)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: QoS | int) -> Publisher:
        """A publisher."""
        made = Publisher(self, msg_type, topic, as_qos(qos_profile))
        self._entities.writers.append(made.gid)
        _context().graph.announce(self._entities)
        return made

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: QoS | int, *, raw: bool = False
    ) -> Subscription:
        """A subscription."""
        made = Subscription(self, msg_type, topic, callback, as_qos(qos_profile), raw)
        self._subscriptions.append(made)
        self._waiting.attach(made.condition)
        self._entities.readers.append(made.gid)
        _context().graph.announce(self._entities)
        return made

    def raw_type(self, topic: str, type_name: str) -> Any:
        """Of a topic; its definition need not be known."""
        if type_name in idl.STORE.types:
            return idl.STORE.types[type_name]
        return idl.foreign(type_name, _context().graph.announced_type(qualified(topic, self._namespace), type_name))

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> Timer:
        """A timer."""
        self._timers.append(Timer(timer_period_sec, callback))
        return self._timers[-1]

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """Publishers and subscriptions of a topic."""
        return _context().graph.endpoints(qualified(topic, self._namespace))

    def topics(self) -> dict[str, tuple[str, ...]]:
        """Topics and the names of their types."""
        return _context().graph.topics()

    def destroy_node(self) -> None:
        """Leave the network."""
        if _joined:
            _context().graph.withdraw(self._entities)
        self._subscriptions, self._timers = [], []

    def published(self, topic: str, size: int) -> None:
        """To be overridden: a message was sent."""

    def received(self, arrival: Arrival) -> None:
        """To be overridden: a message has come."""

    def unreadable(self, topic: str) -> None:
        """To be overridden: what has come is no message of the topic's type."""

    def spin_once(self, timeout_sec: float) -> None:
        """Handle what comes, and is due, within so long."""
        due = min((timer.due for timer in self._timers), default=float("inf")) - time.monotonic()
        self._waiting.wait(int(max(0.0, min(timeout_sec, due)) * 1e9))
        for subscription in self._subscriptions:
            subscription.take()
        now = time.monotonic()
        for timer in self._timers:
            if timer.due <= now:
                timer.call()


def init(domain: int | None = None) -> None:
    """Join the network."""
    if not _joined:
        _joined.append(_Context(int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain is None else domain))


def message_type(name: str) -> Any:
    """The class of messages of that name; SettingError where its definition isn't known."""
    return idl.STORE.types[idl.known(name)]


def message(name: str, **fields: Any) -> Any:
    """A message of that type."""
    made = idl.default(idl.known(name))
    for field, value in fields.items():
        object.__setattr__(made, field, value)
    return made


def type_name(msg_type: Any) -> str:
    """The name of a class of messages."""
    return str(msg_type.__msgtype__)


def spin_once(node: Node, timeout_sec: float) -> None:
    """Handle what comes within so long."""
    node.spin_once(timeout_sec)


def shutdown() -> None:
    """Leave the network."""
    with contextlib.suppress(IndexError):
        _joined.pop()


def _context() -> _Context:
    init()
    return _joined[0]
