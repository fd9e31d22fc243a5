"""Who is on the network, for cyclonedds: endpoints from DDS's own discovery, names of their nodes from ROS 2's.

ROS 2 announces nodes as `rmw_dds_common/msg/ParticipantEntitiesInfo` on `ros_discovery_info`: which endpoints each has.
"""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import DDSException, InstanceState, ReadCondition, SampleState, ViewState
from cyclonedds.domain import DomainParticipant
from cyclonedds.dynamic import get_types_for_typeid
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from scan2sim.services.transport.idl import STORE, sample_type
from scan2sim.services.transport.names import dds_topic, ros_topic, ros_type
from scan2sim.services.transport.policies import qos_of
from scan2sim.services.transport.types import Endpoint, Kind

ANNOUNCED = "ros_discovery_info"
INFO = "rmw_dds_common/msg/ParticipantEntitiesInfo"
BARE = "_CREATED_BY_BARE_DDS_APP_"
"""What ROS 2 calls a node whose participant announces none."""
ALIVE = ViewState.Any | SampleState.Any | InstanceState.Alive
ANNOUNCED_WITHIN = 2_000_000_000
"""Nanoseconds that a publisher has to say what its type is."""
KINDS: tuple[Kind, ...] = ("PUBLISHER", "SUBSCRIPTION")
MOST = 10_000
"""Endpoints read at once."""


@dataclass
class Entities:
    """Endpoints of one node of this process: their GIDs."""

    namespace: str
    name: str
    readers: list[bytes] = field(default_factory=list)
    writers: list[bytes] = field(default_factory=list)


class Graph:
    """Discovery of one participant; may be used from any thread."""

    def __init__(self, participant: DomainParticipant) -> None:
        self._participant, self._gid = participant, participant.guid.bytes
        self._lock = threading.Lock()
        self._nodes: list[Entities] = []
        topic = Topic(participant, ANNOUNCED, sample_type(INFO))
        kept = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
        self._writer = DataWriter(participant, topic, kept)
        all_of_them = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepAll)
        self._reader = DataReader(participant, topic, all_of_them)
        self._endpoints = {
            "PUBLISHER": _Endpoints(participant, BuiltinTopicDcpsPublication),
            "SUBSCRIPTION": _Endpoints(participant, BuiltinTopicDcpsSubscription),
        }
        self._names: dict[bytes, dict[bytes, tuple[str, str]]] = {}

    def announce(self, node: Entities) -> None:
        """Tell all others of a node of this process, or of what it has now."""
        with self._lock:
            if node not in self._nodes:
                self._nodes.append(node)
            self._publish()

    def withdraw(self, node: Entities) -> None:
        """Tell all others that a node is gone."""
        with self._lock:
            self._nodes = [other for other in self._nodes if other is not node]
            self._publish()

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """Publishers and subscriptions of a topic, by its full name."""
        with self._lock:
            names = self._read_names()
            wanted = dds_topic(topic)
            return tuple(
                Endpoint(
                    *names.get(found.key.bytes, (BARE, BARE)),
                    type_name=ros_type(found.type_name),
                    kind=kind,
                    gid=found.key.bytes,
                    qos=qos_of(found.qos),
                )
                for kind in KINDS
                for found in self._endpoints[kind].alive()
                if found.topic_name == wanted
            )

    def announced_type(self, topic: str, type_name: str) -> Any | None:
        """A type as a publisher of a topic announces it (DDS-XTypes 1.3, section 7.6.3.3); None: none does."""
        with self._lock:
            found = [one for one in self._endpoints["PUBLISHER"].alive() if one.topic_name == dds_topic(topic)]
        for one in found:
            if one.type_id is not None and ros_type(one.type_name) == type_name:
                with contextlib.suppress(DDSException):  # it has gone, or says nothing
                    return get_types_for_typeid(self._participant, one.type_id, ANNOUNCED_WITHIN)[0]
        return None

    def topics(self) -> dict[str, tuple[str, ...]]:
        """ROS 2's topics, and the names of their types."""
        found: dict[str, set[str]] = {}
        with self._lock:
            for kind in KINDS:
                for endpoint in self._endpoints[kind].alive():
                    if name := ros_topic(endpoint.topic_name):
                        found.setdefault(name, set()).add(ros_type(endpoint.type_name))
        return {name: tuple(sorted(kinds)) for name, kinds in sorted(found.items())}

    def _publish(self) -> None:
        gid, node_info = STORE.types["rmw_dds_common/msg/Gid"], STORE.types["rmw_dds_common/msg/NodeEntitiesInfo"]

        def gids(of: list[bytes]) -> list[Any]:
            return [gid(_numbers(one)) for one in of]

        nodes = [node_info(node.namespace, node.name, gids(node.readers), gids(node.writers)) for node in self._nodes]
        info = STORE.types[INFO](gid(_numbers(self._gid)), nodes)
        self._writer.write(sample_type(INFO)(bytes(STORE.serialize_cdr(info, INFO))))

    def _read_names(self) -> dict[bytes, tuple[str, str]]:
        """GIDs of endpoints to the name and namespace of their node."""
        for sample in self._reader.take(MOST):
            if sample.sample_info.valid_data:
                info: Any = STORE.deserialize_cdr(sample.data, INFO)
                self._names[bytes(info.gid.data)] = {
                    bytes(one.data): (node.node_name, node.node_namespace)
                    for node in info.node_entities_info_seq
                    for one in (*node.reader_gid_seq, *node.writer_gid_seq)
                }
        return {gid: name for of_participant in self._names.values() for gid, name in of_participant.items()}


class _Endpoints:
    """Publishers or subscriptions that are on the network; read anew only when some have come or gone.

    To read one takes a fifth of a millisecond, and a machine of a hundred nodes has hundreds.
    """

    def __init__(self, participant: DomainParticipant, topic: Any) -> None:
        self._reader = BuiltinDataReader(participant, topic)
        self._condition = ReadCondition(self._reader, ALIVE)
        self._news = ReadCondition(self._reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)
        self._found: list[Any] = []

    def alive(self) -> list[Any]:
        if self._news.triggered:
            self._reader.read(MOST, self._news)  # who has gone counts as read, too
            self._found = list(self._reader.read(MOST, self._condition))
        return self._found


def _numbers(gid: bytes) -> Any:
    return np.frombuffer(gid, np.uint8)
