"""Build the checker once for all tests of this folder, or skip them."""

from __future__ import annotations

import pytest

from tests.fakes.gazebo import checker


@pytest.fixture(scope="session", autouse=True)
def built() -> None:
    """Build before the first test, so that no test's time includes the build."""
    checker.program("check_world")
