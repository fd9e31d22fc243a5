"""RTSP camera with H.264: reading, detection of its loss, reconnection."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from scan2sim.services.toolboxes import offline
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.settings import ToolboxParams
from scan2sim.services.toolboxes.sources import Cameras
from tests.fakes.ports import free_port
from tests.services.toolboxes import shaky
from tests.waiting import until

PYTHON = "/usr/bin/python3"
"""Debian's Python, for which GStreamer's bindings are packaged."""
CAMERA = Path(__file__).with_name("rtsp_camera.py")
IMPORT_TEST = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"


@contextmanager
def camera(port: int, grey: int) -> Iterator[None]:
    with subprocess.Popen([PYTHON, CAMERA, str(port), str(grey)], stdout=subprocess.PIPE) as served:
        assert served.stdout and served.stdout.readline() == b"serves\n"
        try:
            yield
        finally:
            served.kill()


def test_rtsp_camera_is_read_and_reconnected() -> None:
    if not Path(PYTHON).is_file() or subprocess.run([PYTHON, "-c", IMPORT_TEST], capture_output=True).returncode:
        pytest.skip("GStreamer's RTSP server isn't installed (gir1.2-gst-rtsp-server-1.0)")
    port = free_port()
    address = f"rtsp://127.0.0.1:{port}/camera"
    engine = Engine(shaky.__name__, ToolboxParams(deadline=offline.OFFLINE_DEADLINE_S))
    cameras = Cameras(engine, [address])

    def grey() -> int:
        return shaky.level_of(cameras.last()[0].body) if cameras.last() else -1

    try:
        with camera(port, 120):
            cameras.start()
            until(lambda: abs(grey() - 120) < 5)
            assert cameras.states()[address]["connected"]
        until(lambda: not cameras.states()[address]["connected"])
        with camera(port, 60):
            until(lambda: abs(grey() - 60) < 5)
            assert cameras.states()[address]["connected"]
    finally:
        cameras.stop()
        engine.close()
