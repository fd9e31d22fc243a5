"""IDL types of ROS 2 messages for cyclonedds, from their definitions; samples are serialized bytes.

A DDS implementation of another vendor accepts data only if the announced type matches its own field by field.
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
"""Definitions of ROS 2's standard message types, and of `ackermann_msgs` (drive commands of cars)."""
_ANGLES = "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk"
_STAMPED = "std_msgs/Header header\nackermann_msgs/AckermannDrive drive"
STORE.register(
    get_types_from_msg(_ANGLES, "ackermann_msgs/msg/AckermannDrive")
    | get_types_from_msg(_STAMPED, "ackermann_msgs/msg/AckermannDriveStamped")
)
types: Any = _types  # its generics aren't recognized by type checkers
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
    """Check that the definition of a type is known and return its name.

    Raises:
        SettingError: it is unknown.
    """
    if checked_type(name) not in STORE.types:
        remedy = "Without rclpy only ROS 2's standard types are known: install it and source the workspace of this type"
        raise SettingError(f"type {name}", "its definition is unknown", remedy)
    return name


@cache
def sample_type(name: str) -> Any:
    """Sample class of a type; its `data` are bytes of CDR with the encapsulation header."""
    return _sample_class(_struct(known(name)))


@dataclass(frozen=True)
class OpaqueType:
    """A message type whose definition is unknown: its messages can only be received raw.

    Attributes:
        __msgtype__: name of the type.
        sample: its sample class.
    """

    __msgtype__: str
    sample: Any


def opaque_type(name: str, announced: Any | None) -> OpaqueType:
    """Create an opaque type; `announced`: type announced by its publisher, None if it announces none (Fast DDS)."""
    plain = {"bytes": types.sequence[types.byte]}
    struct = announced or make_idl_struct("Foreign", dds_type(name).replace("::", "."), plain)
    return OpaqueType(name, _sample_class(struct))


def _sample_class(struct: Any) -> Any:
    class Sample(struct):  # type: ignore[misc]
        """Sample that holds serialized bytes of CDR."""

        __slots__ = ("data", "sample_info")

        def __init__(self, data: bytes) -> None:
            self.data = data

        def serialize(self, *_: Any, **__: Any) -> bytes:
            return self.data

        @classmethod
        def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Sample:
            return cls(data)

    Sample.__idl__ = struct.__idl__
    return Sample


@cache
def _struct(name: str) -> Any:
    fields = {field: _type(*definition) for field, definition in STORE.get_msgdef(name).fields}
    # IDL doesn't allow an empty struct; ROS 2 adds this dummy field
    return make_idl_struct(
        name.rpartition("/")[2] + "_",
        dds_type(name).replace("::", "."),
        fields or {"structure_needs_at_least_one_member": types.uint8},
    )


@cache
def unbounded(name: str) -> bool:
    """Whether a type has unbounded size; for others, readers allocate no more than the largest message."""
    return any(_is_unbounded(*definition) for _, definition in STORE.get_msgdef(name).fields)


def _is_unbounded(node: Any, definition: Any) -> bool:
    if node.name == "BASE":
        return bool(definition[0] == "string" and not definition[1])
    if node.name == "NAME":
        return unbounded(definition)
    item, count = definition
    return _is_unbounded(*item) or (node.name == "SEQUENCE" and not count)


def _type(node: Any, definition: Any) -> Any:
    """IDL type of a field from its definition as rosbags parses it: (kind, name or (item, count))."""
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
    """Create a message with all fields zero or empty."""
    fields = {field: _default(*definition) for field, definition in STORE.get_msgdef(name).fields}
    return STORE.types[name](**fields)


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
