"""How many bytes a message takes in CDR, without writing them: fields are measured as they lie.

rclpy hands messages over, not their bytes, and to write an image of 6 MB again costs as much as sending it.
Source: OMG CDR (PLAIN_CDR, as ROS 2 writes it): values are aligned to their own size, from behind the encapsulation.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

ENCAPSULATION = 4
"""Bytes before the fields: the encoding's name and options."""
SIZES = {
    "boolean": 1, "octet": 1, "char": 1, "byte": 1, "int8": 1, "uint8": 1,
    "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float": 4,
    "int64": 8, "uint64": 8, "double": 8,
}  # fmt: skip
"""Bytes of a value, by its name in rosidl."""
SEQUENCE = re.compile(r"sequence<(.+?)(?:, *\d+)?>")
ARRAY = re.compile(r"(.+)\[\d+\]")

Measure = Callable[[Any, int], int]
"""A value and where it begins, to where it ends."""


def size(message: Any) -> int:
    """Bytes of one of rclpy's messages in CDR, with its encapsulation."""
    return ENCAPSULATION + _of_message(type(message))(message, 0)


_measures: dict[Any, Measure] = {}


def _of_message(kind: Any) -> Measure:
    if kind not in _measures:
        _measures[kind] = _of_fields(kind)
    return _measures[kind]


def _of_fields(kind: Any) -> Measure:
    fields = [(name, _of_field(type_name)) for name, type_name in kind.get_fields_and_field_types().items()]

    def measure(message: Any, at: int) -> int:
        for name, field in fields:
            at = field(getattr(message, name), at)
        return at if fields else at + 1  # what is empty holds a byte

    return measure


def _of_field(type_name: str) -> Measure:
    if sequence := SEQUENCE.fullmatch(type_name):
        items = _of_items(sequence[1])
        return lambda value, at: items(value, _aligned(at, 4) + 4)
    if array := ARRAY.fullmatch(type_name):
        return _of_items(array[1])
    return _of_value(type_name)


def _of_items(type_name: str) -> Measure:
    width = SIZES.get(type_name)
    if width is not None:
        return lambda value, at: _aligned(at, width) + width * len(value)
    item = _of_value(type_name)

    def measure(value: Any, at: int) -> int:
        for one in value:
            at = item(one, at)
        return at

    return measure


def _of_value(type_name: str) -> Measure:
    width = SIZES.get(type_name)
    if width is not None:
        return lambda value, at: _aligned(at, width) + width
    if type_name.startswith("wstring"):
        return lambda value, at: _aligned(at, 4) + 4 + 2 * len(value)
    if type_name.startswith("string"):
        return lambda value, at: _aligned(at, 4) + 5 + (len(value) if value.isascii() else len(value.encode()))
    return lambda value, at: _of_message(type(value))(value, at)


def _aligned(at: int, width: int) -> int:
    return -(-at // width) * width
