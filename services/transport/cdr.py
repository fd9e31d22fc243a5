"""Serialized size of a message in CDR, computed without serializing it.

rclpy's callbacks receive messages, not bytes, and serializing an image of 6 MB again costs as much as sending it.
Source: OMG CDR (PLAIN_CDR, as ROS 2 uses it): values are aligned to their own size, counted from after the
encapsulation header.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

ENCAPSULATION_BYTES = 4
"""Size of the header before the fields: representation identifier and options."""
PRIMITIVE_BYTES = {
    "boolean": 1, "octet": 1, "char": 1, "byte": 1, "int8": 1, "uint8": 1,
    "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float": 4,
    "int64": 8, "uint64": 8, "double": 8,
}  # fmt: skip
"""Size of a value by its type name in rosidl."""
SEQUENCE = re.compile(r"sequence<(.+?)(?:, *\d+)?>")
ARRAY = re.compile(r"(.+)\[\d+\]")

Measure = Callable[[Any, int], int]
"""Function from a value and its start offset to its end offset."""


def serialized_size(message: Any) -> int:
    """Size of an rclpy message in CDR, bytes, with the encapsulation header."""
    return ENCAPSULATION_BYTES + _message_measure(type(message))(message, 0)


_measures: dict[Any, Measure] = {}


def _message_measure(kind: Any) -> Measure:
    if kind not in _measures:
        _measures[kind] = _fields_measure(kind)
    return _measures[kind]


def _fields_measure(kind: Any) -> Measure:
    fields = [(name, _field_measure(type_name)) for name, type_name in kind.get_fields_and_field_types().items()]

    def measure(message: Any, at: int) -> int:
        for name, field in fields:
            at = field(getattr(message, name), at)
        return at if fields else at + 1  # an empty struct has a dummy byte

    return measure


def _field_measure(type_name: str) -> Measure:
    if sequence := SEQUENCE.fullmatch(type_name):
        items = _items_measure(sequence[1])
        return lambda value, at: items(value, _aligned(at, 4) + 4)
    if array := ARRAY.fullmatch(type_name):
        return _items_measure(array[1])
    return _value_measure(type_name)


def _items_measure(type_name: str) -> Measure:
    width = PRIMITIVE_BYTES.get(type_name)
    if width is not None:
        return lambda value, at: _aligned(at, width) + width * len(value)
    item = _value_measure(type_name)

    def measure(value: Any, at: int) -> int:
        for one in value:
            at = item(one, at)
        return at

    return measure


def _value_measure(type_name: str) -> Measure:
    width = PRIMITIVE_BYTES.get(type_name)
    if width is not None:
        return lambda value, at: _aligned(at, width) + width
    if type_name.startswith("wstring"):
        return lambda value, at: _aligned(at, 4) + 4 + 2 * len(value)
    if type_name.startswith("string"):
        return lambda value, at: _aligned(at, 4) + 5 + (len(value) if value.isascii() else len(value.encode()))
    return lambda value, at: _message_measure(type(value))(value, at)


def _aligned(at: int, width: int) -> int:
    return -(-at // width) * width
