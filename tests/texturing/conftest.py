"""Fixtures of the texturing tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.texturing.corner import Street


@pytest.fixture
def street(tmp_path: Path) -> Street:
    """Synthetic street corner without photos and points; tests add them."""
    return Street(tmp_path)
