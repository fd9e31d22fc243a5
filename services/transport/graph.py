"""ROS graph for cyclonedds: endpoints from DDS discovery, names of their nodes from ROS 2's discovery topic.

ROS 2 announces the endpoints of each node as `rmw_dds_common/msg/ParticipantEntitiesInfo` on `ros_discovery_info`.
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

DISCOVERY_TOPIC = "ros_discovery_info"
DISCOVERY_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
UNANNOUNCED_NODE = "_CREATED_BY_BARE_DDS_APP_"
"""Name that ROS 2 gives to the node of a participant that announces none."""
ALIVE = ViewState.Any | SampleState.Any | InstanceState.Alive
TYPE_LOOKUP_TIMEOUT_NS = 2_000_000_000
"""Time for a publisher to send the definition of its type."""
KINDS: tuple[Kind, ...] = ("PUBLISHER", "SUBSCRIPTION")
MAX_READ = 10_000
"""Samples of a discovery topic per read."""


@dataclass
class Entities:
    """GIDs of the endpoints of one node of this process."""

    namespace: str
    name: str
    readers: list[bytes] = field(default_factory=list)
    writers: list[bytes] = field(default_factory=list)


class Graph:
    """Discovery of one participant; thread-safe."""

    def __init__(self, participant: DomainParticipant) -> None:
        self._participant, self._gid = participant, participant.guid.bytes
        self._lock = threading.Lock()
        self._nodes: list[Entities] = []
        topic = Topic(participant, DISCOVERY_TOPIC, sample_type(DISCOVERY_TYPE))
        keep_last = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
        self._writer = DataWriter(participant, topic, keep_last)
        keep_all = Qos(Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepAll)
        self._reader = DataReader(participant, topic, keep_all)
        self._endpoints = {
            "PUBLISHER": _Endpoints(participant, BuiltinTopicDcpsPublication),
            "SUBSCRIPTION": _Endpoints(participant, BuiltinTopicDcpsSubscription),
        }
        self._names: dict[bytes, dict[bytes, tuple[str, str]]] = {}

    def announce(self, node: Entities) -> None:
        """Publish a new or changed node of this process on the discovery topic."""
        with self._lock:
            if node not in self._nodes:
                self._nodes.append(node)
            self._publish()

    def withdraw(self, node: Entities) -> None:
        """Publish that a node of this process is gone."""
        with self._lock:
            self._nodes = [other for other in self._nodes if other is not node]
            self._publish()

    def endpoints(self, topic: str) -> tuple[Endpoint, ...]:
        """Publishers and subscriptions of a topic, given by its full name."""
        with self._lock:
            names = self._read_names()
            wanted = dds_topic(topic)
            return tuple(
                Endpoint(
                    *names.get(found.key.bytes, (UNANNOUNCED_NODE, UNANNOUNCED_NODE)),
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
        """Type that a publisher of a topic announces (DDS-XTypes 1.3, section 7.6.3.3); None: not announced."""
        with self._lock:
            found = [one for one in self._endpoints["PUBLISHER"].alive() if one.topic_name == dds_topic(topic)]
        for one in found:
            if one.type_id is not None and ros_type(one.type_name) == type_name:
                with contextlib.suppress(DDSException):  # the publisher is gone, or doesn't reply
                    return get_types_for_typeid(self._participant, one.type_id, TYPE_LOOKUP_TIMEOUT_NS)[0]
        return None

    def topics(self) -> dict[str, tuple[str, ...]]:
        """ROS 2 topics and the names of their types."""
        found: dict[str, set[str]] = {}
        with self._lock:
            for kind in KINDS:
                for endpoint in self._endpoints[kind].alive():
                    if name := ros_topic(endpoint.topic_name):
                        found.setdefault(name, set()).add(ros_type(endpoint.type_name))
        return {name: tuple(sorted(kinds)) for name, kinds in sorted(found.items())}

    def _publish(self) -> None:
        gid, node_info = STORE.types["rmw_dds_common/msg/Gid"], STORE.types["rmw_dds_common/msg/NodeEntitiesInfo"]

        def gids(endpoints: list[bytes]) -> list[Any]:
            return [gid(_as_array(one)) for one in endpoints]

        nodes = [node_info(node.namespace, node.name, gids(node.readers), gids(node.writers)) for node in self._nodes]
        info = STORE.types[DISCOVERY_TYPE](gid(_as_array(self._gid)), nodes)
        self._writer.write(sample_type(DISCOVERY_TYPE)(bytes(STORE.serialize_cdr(info, DISCOVERY_TYPE))))

    def _read_names(self) -> dict[bytes, tuple[str, str]]:
        """Mapping from the GID of an endpoint to the name and namespace of its node."""
        for sample in self._reader.take(MAX_READ):
            if sample.sample_info.valid_data:
                info: Any = STORE.deserialize_cdr(sample.data, DISCOVERY_TYPE)
                self._names[bytes(info.gid.data)] = {
                    bytes(one.data): (node.node_name, node.node_namespace)
                    for node in info.node_entities_info_seq
                    for one in (*node.reader_gid_seq, *node.writer_gid_seq)
                }
        return {gid: name for of_participant in self._names.values() for gid, name in of_participant.items()}


class _Endpoints:
    """Discovered publishers or subscriptions, cached until one appears or disappears.

    Reading one takes 0.2 ms, and a machine with a hundred nodes has hundreds.
    """

    def __init__(self, participant: DomainParticipant, topic: Any) -> None:
        self._reader = BuiltinDataReader(participant, topic)
        self._condition = ReadCondition(self._reader, ALIVE)
        self._changed = ReadCondition(self._reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)
        self._found: list[Any] = []

    def alive(self) -> list[Any]:
        if self._changed.triggered:
            self._reader.read(MAX_READ, self._changed)  # marks all samples as read, including those of gone endpoints
            self._found = list(self._reader.read(MAX_READ, self._condition))
        return self._found


def _as_array(gid: bytes) -> Any:
    return np.frombuffer(gid, np.uint8)
