"""What tests of texturing share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.texturing.corner import Street


@pytest.fixture
def street(tmp_path: Path) -> Street:
    """A made-up street corner without photos and points; tests add theirs."""
    return Street(tmp_path)
