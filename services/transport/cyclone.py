"""Transport over cyclonedds: nodes without a ROS 2 installation that use its names, types and type hashes on DDS.

cyclonedds gives its readers neither the sequence number of a message nor its publisher. Both are appended to the
message's bytes with the source timestamp (`envelope`); other readers ignore trailing bytes. Readers of Fast DDS have
no room for trailing bytes in messages of fixed size: these are sent without, so their losses can't be counted.
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

DOMAIN_CONFIG = """
<CycloneDDS><Domain>
  <General><MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize></General>
  <Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>
"""
"""Large fragments: images are transferred ten times as fast. Fast DDS (vendor 1.15) describes arrays in a way that
cyclonedds rejects, so its types are compared by name. CYCLONEDDS_URI takes precedence over these settings."""
MAX_TAKE_MESSAGES, TAKE_QUANTUM_BYTES = 64, 2**20
"""Limits of one `take` from a topic, so that a large topic doesn't delay small ones (deficit round robin: Shreedhar and
Varghese, 1995)."""


class _Context:
    """DDS participant of this process, shared by its nodes."""

    def __init__(self, domain: int) -> None:
        config = ",".join(filter(None, [DOMAIN_CONFIG.strip(), os.environ.get("CYCLONEDDS_URI")]))
        self._domain = Domain(domain, config)
        self.participant = DomainParticipant(domain, Qos(Policy.Userdata(b"enclave=/;")))
        self.graph = Graph(self.participant)


_contexts: list[_Context] = []


class Publisher:
    """Publisher of messages of one type (`services.transport.Publisher`); thread-safe."""

    def __init__(self, node: Node, msg_type: Any, topic: str, qos: QoS) -> None:
        self._node, self.topic_name = node, qualified(topic, node.get_namespace())
        self._type = type_name(msg_type)
        type_hash = f"typehash={idl.STORE.hash_rihs01(self._type)};".encode()
        self._sample = idl.sample_type(self._type)
        self._has_envelope = idl.unbounded(self._type)
        participant = _context().participant
        self._writer = DataWriter(
            participant, Topic(participant, dds_topic(self.topic_name), self._sample), policies(qos, type_hash)
        )
        self.gid = self._writer.guid.bytes
        self._number = 0
        self._lock = threading.Lock()

    def publish(self, message: Any) -> None:
        """Publish a message, or bytes of CDR."""
        data = message if isinstance(message, bytes) else idl.STORE.serialize_cdr(message, self._type)
        with self._lock:
            self._number += 1
            self._writer.write(self._sample(self._wrapped(data)))
        self._node.published(self.topic_name, len(data))

    def _wrapped(self, data: bytes | memoryview) -> bytes:
        return envelope.wrap(data, self._number, self.gid, time.time_ns()) if self._has_envelope else bytes(data)

    def get_subscription_count(self) -> int:
        """Number of currently matched subscriptions."""
        return len(self._writer.get_matched_subscriptions())

    def wait_for_all_acked(self, timeout_sec: float) -> bool:
        """Whether all matched reliable subscriptions have acknowledged all messages within `timeout_sec`."""
        return self._writer.wait_for_acks(int(timeout_sec * 1e9))


class Subscription:
    """Passes the messages of one topic to a callback."""

    def __init__(
        self, node: Node, msg_type: Any, topic: str, callback: Callable[..., None], qos: QoS, raw: bool
    ) -> None:
        self._node, self.topic_name = node, qualified(topic, node.get_namespace())
        self._type, self._callback, self._raw, self._max_take = type_name(msg_type), callback, raw, 1
        sample = msg_type.sample if isinstance(msg_type, idl.OpaqueType) else idl.sample_type(self._type)
        participant = _context().participant
        self.reader: DataReader[Any] = DataReader(
            participant, Topic(participant, dds_topic(self.topic_name), sample), policies(qos)
        )
        self.gid = self.reader.guid.bytes
        self.condition = ReadCondition(self.reader, ALIVE)

    def take(self) -> None:
        """Take received messages and call the callback for each."""
        for sample in self.reader.take(self._max_take):
            if not sample.sample_info.valid_data:
                continue
            data, header = envelope.unwrap(sample.data)
            number, publisher, sent = header or (None, None, sample.sample_info.source_timestamp)
            size = len(data)
            self._max_take = max(1, min(MAX_TAKE_MESSAGES, TAKE_QUANTUM_BYTES // (size + 1)))
            self._node.received(Arrival(self.topic_name, size, time.time_ns(), sent, publisher, number))
            try:
                message = bytes(data) if self._raw else idl.STORE.deserialize_cdr(data, self._type)
            except Exception:  # malformed data from the network raise errors of many types
                self._node.unreadable(self.topic_name)
                continue
            self._callback(message)


class Timer:
    """Periodic timer, executed when its node is spun."""

    def __init__(self, period: float, callback: Callable[[], None]) -> None:
        self.period, self._callback, self.due = period, callback, time.monotonic() + period

    def cancel(self) -> None:
        """Cancel the timer."""
        self.due = float("inf")

    def call(self) -> None:
        """Call the callback; missed periods are skipped."""
        self.due = max(self.due + self.period, time.monotonic())
        self._callback()


class Node:
    """A ROS 2 node without a ROS 2 installation (`services.transport.Node`)."""

    def __init__(self, node_name: str, *, namespace: str = "/", hidden: bool = False) -> None:
        """See `services.transport.Node`; `hidden` has no effect, the name alone makes a node hidden."""
        self._name, self._namespace = node_name, namespace if namespace.startswith("/") else f"/{namespace}"
        self._entities = Entities(self._namespace, node_name)
        self._subscriptions: list[Subscription] = []
        self._timers: list[Timer] = []
        self._wait_set = WaitSet(_context().participant)
        self._wake = GuardCondition(_context().participant)
        self._wait_set.attach(self._wake)
        _context().graph.announce(self._entities)

    def get_name(self) -> str:
        """Name without namespace."""
        return self._name

    def get_namespace(self) -> str:
        """Namespace, beginning with a slash."""
        return self._namespace

    def get_logger(self) -> logging.Logger:
        """Logger of the node."""
        return logging.getLogger(self._name)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: QoS | int) -> Publisher:
        """Create a publisher."""
        publisher = Publisher(self, msg_type, topic, as_qos(qos_profile))
        self._entities.writers.append(publisher.gid)
        _context().graph.announce(self._entities)
        return publisher

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], qos_profile: QoS | int, *, raw: bool = False
    ) -> Subscription:
        """Create a subscription."""
        subscription = Subscription(self, msg_type, topic, callback, as_qos(qos_profile), raw)
        self._subscriptions.append(subscription)
        self._wait_set.attach(subscription.condition)
        self._entities.readers.append(subscription.gid)
        _context().graph.announce(self._entities)
        return subscription

    def raw_type(self, topic: str, type_name: str) -> Any:
        """Message type for a raw subscription; its definition may be unknown."""
        if type_name in idl.STORE.types:
            return idl.STORE.types[type_name]
        announced = _context().graph.announced_type(qualified(topic, self._namespace), type_name)
        return idl.opaque_type(type_name, announced)

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> Timer:
        """Create a timer."""
        self._timers.append(Timer(timer_period_sec, callback))
        return self._timers[-1]

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """Discovered publishers and subscriptions of a topic."""
        return _context().graph.endpoints(qualified(topic, self._namespace))

    def topics(self) -> dict[str, tuple[str, ...]]:
        """Discovered topics and the names of their types."""
        return _context().graph.topics()

    def destroy_node(self) -> None:
        """Destroy the node."""
        if _contexts:
            _context().graph.withdraw(self._entities)
        self._subscriptions, self._timers = [], []

    def published(self, topic: str, size: int) -> None:
        """Hook: a message was published."""

    def received(self, arrival: Arrival) -> None:
        """Hook: a message was received."""

    def unreadable(self, topic: str) -> None:
        """Hook: a received message could not be deserialized."""

    def spin_once(self, timeout_sec: float) -> None:
        """Process messages and due timers, waiting up to `timeout_sec`."""
        due = min((timer.due for timer in self._timers), default=float("inf")) - time.monotonic()
        self._wait_set.wait(int(max(0.0, min(timeout_sec, due)) * 1e9))
        for subscription in self._subscriptions:
            subscription.take()
        now = time.monotonic()
        for timer in self._timers:
            if timer.due <= now:
                timer.call()


def init(domain: int | None = None) -> None:
    """Create the participant of this process."""
    if not _contexts:
        _contexts.append(_Context(int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain is None else domain))


def message_type(name: str) -> Any:
    """Message class by its name; SettingError if its definition is unknown."""
    return idl.STORE.types[idl.known(name)]


def message(name: str, **fields: Any) -> Any:
    """Create a message with the given fields."""
    result = idl.default(idl.known(name))
    for field, value in fields.items():
        object.__setattr__(result, field, value)
    return result


def type_name(msg_type: Any) -> str:
    """Name of a message class."""
    return str(msg_type.__msgtype__)


def spin_once(node: Node, timeout_sec: float) -> None:
    """Process messages and due timers of a node, waiting up to `timeout_sec`."""
    node.spin_once(timeout_sec)


def shutdown() -> None:
    """Destroy the participant."""
    with contextlib.suppress(IndexError):
        _contexts.pop()


def _context() -> _Context:
    init()
    return _contexts[0]
