"""Assertion that an optional value is present."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def present(value: T | None) -> T:
    """Return `value`; fails the test if it is None."""
    assert value is not None
    return value
