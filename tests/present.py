"""Values that may be None in general, and are not where a test reads them."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def present(value: T | None) -> T:
    """`value`; the test fails where it is None."""
    assert value is not None
    return value
