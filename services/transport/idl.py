"""Types of ROS 2's messages for cyclonedds, made of their definitions; samples are bytes, which others read and write.

A peer of another vendor takes data only where the type that is announced is its own, field for field.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as _types
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport.names import checked_type, dds_type

STORE: Typestore = get_typestore(Stores.ROS2_KILTED)
"""Definitions of the types that ROS 2 brings, and of `ackermann_msgs`, which cars are driven by."""
_ANGLES = "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk"
_STAMPED = "std_msgs/Header header\nackermann_msgs/AckermannDrive drive"
STORE.register(
    get_types_from_msg(_ANGLES, "ackermann_msgs/msg/AckermannDrive")
    | get_types_from_msg(_STAMPED, "ackermann_msgs/msg/AckermannDriveStamped")
)
types: Any = _types  # its generics are no generics to type checkers
_VALUES = {
    "bool": bool,
    "byte": types.byte,
    "octet": types.byte,
    "char": types.uint8,
    "string": str,
    "int8": types.int8,
    "uint8": types.uint8,
    "int16": types.int16,
    "uint16": types.uint16,
    "int32": types.int32,
    "uint32": types.uint32,
    "int64": types.int64,
    "uint64": types.uint64,
    "float32": types.float32,
    "float64": types.float64,
}
_ZERO: dict[str, Any] = {"bool": False, "string": "", "float32": 0.0, "float64": 0.0}


def known(name: str) -> str:
    """The name of a type whose definition is known.

    Raises:
        SettingError: it isn't.
    """
    if checked_type(name) not in STORE.types:
        raise SettingError(
            f"type {name}",
            "its definition isn't known here",
            "Without rclpy only ROS 2's own messages are; install rclpy and source the workspace that defines it",
        )
    return name


@cache
def sample_type(name: str) -> Any:
    """The class of samples of a type, whose `data` are bytes of CDR with their encapsulation."""
    return _samples(_struct(known(name)))


@dataclass(frozen=True)
class Foreign:
    """Stands for a type whose definition isn't known here: its messages can be received raw.

    Attributes:
        __msgtype__: its name.
        sample: the class of its samples.
    """

    __msgtype__: str
    sample: Any


def foreign(name: str, announced: Any | None) -> Foreign:
    """Of a name, and of what its publisher announces it to be; None: it announces nothing, as Fast DDS doesn't."""
    plain = {"bytes": types.sequence[types.byte]}
    return Foreign(name, _samples(announced or make_idl_struct("Foreign", dds_type(name).replace("::", "."), plain)))


def _samples(made: Any) -> Any:
    class Sample(made):  # type: ignore[misc]
        """Bytes of CDR."""

        __slots__ = ("data", "sample_info")

        def __init__(self, data: bytes) -> None:
            self.data = data

        def serialize(self, *_: Any, **__: Any) -> bytes:
            return self.data

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Sample:
            return cls(data)

    Sample.__idl__ = made.__idl__
    return Sample


@cache
def _struct(name: str) -> Any:
    fields = {field: _type(*definition) for field, definition in STORE.get_msgdef(name).fields}
    # a struct without fields isn't allowed: what ROS 2 puts there instead
    return make_idl_struct(
        name.rpartition("/")[2] + "_",
        dds_type(name).replace("::", "."),
        fields or {"structure_needs_at_least_one_member": types.uint8},
    )


@cache
def unbounded(name: str) -> bool:
    """Whether messages of a type can be of any length: a reader keeps room for no more than the longest."""
    return any(_grows(*definition) for _, definition in STORE.get_msgdef(name).fields)


def _grows(node: Any, definition: Any) -> bool:
    if node.name == "BASE":
        return bool(definition[0] == "string" and not definition[1])
    if node.name == "NAME":
        return unbounded(definition)
    item, count = definition
    return _grows(*item) or (node.name == "SEQUENCE" and not count)


def _type(node: Any, definition: Any) -> Any:
    """Of a field, as rosbags parses definitions: (kind, name or (item, count))."""
    if node.name == "BASE":
        base, bound = definition
        return types.bounded_str[bound] if base == "string" and bound else _VALUES[base]
    if node.name == "NAME":
        return _struct(definition)
    item, count = definition
    if node.name == "ARRAY":
        return types.array[_type(*item), count]
    return types.sequence[_type(*item), count] if count else types.sequence[_type(*item)]


def default(name: str) -> Any:
    """A message with all fields zero or empty."""
    made = {field: _default(*definition) for field, definition in STORE.get_msgdef(name).fields}
    return STORE.types[name](**made)


def _default(node: Any, definition: Any) -> Any:
    if node.name == "BASE":
        return _ZERO.get(definition[0], 0)
    if node.name == "NAME":
        return default(definition)
    (item_node, item), count = definition
    size = count if node.name == "ARRAY" else 0
    if item_node.name == "BASE" and item[0] != "string":
        return np.zeros(size, {"bool": bool, "byte": "u1", "octet": "u1", "char": "u1"}.get(item[0], item[0]))
    return [_default(item_node, item) for _ in range(size)]
