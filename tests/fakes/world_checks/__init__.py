"""Checks of exported worlds against the point cloud and the photos that they were made from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class Fault(Exception):
    """A consumer rejects an export, or behaves wrongly with it.

    Args:
        text: description.
        metrics: metrics measured nevertheless.
    """

    def __init__(self, text: str, metrics: Mapping[str, Any] | None = None) -> None:
        super().__init__(text)
        self.metrics = dict(metrics or {})
