"""Builds the checker once for all tests here, or skips them."""

from __future__ import annotations

import pytest

from tests.gazebo import checker


@pytest.fixture(scope="session", autouse=True)
def built() -> None:
    """Build before the first test, so that none is timed with the compiler."""
    checker.program("check_world")
