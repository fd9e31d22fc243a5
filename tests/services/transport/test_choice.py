"""Choice of the transport where ROS 2 of another Python is sourced, as on Ubuntu 22.04."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import UnavailableError
from scan2sim.services import transport

pytest.importorskip("cyclonedds", reason="the extra bus isn't installed")
BROKEN = """
raise ImportError('''No module named 'rclpy._rclpy_pybind11'
The C extension '/opt/ros/humble/_rclpy_pybind11.cpython-311-x86_64-linux-gnu.so' isn't present on the system.''')
"""


@pytest.fixture(autouse=True)
def sourced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ROS 2 whose rclpy was compiled for another Python."""
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text(BROKEN, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "rclpy", raising=False)
    monkeypatch.delenv(transport.TRANSPORT_VARIABLE, raising=False)


def test_cyclone_dds_is_used_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert transport.load().__name__.endswith("transport.cyclone")
    (record,) = caplog.records
    assert "doesn't work with this Python" in record.message and "pybind11" in record.message
    assert "\n" not in record.message


def test_a_transport_that_was_named_is_not_replaced() -> None:
    with pytest.raises((ImportError, UnavailableError)):
        transport.load("rclpy")
