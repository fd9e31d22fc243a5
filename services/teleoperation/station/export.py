"""Export of recorded drives as a bag whose video Foxglove and RViz show: JPEG images, as they decode no VP8."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from scan2sim.pipeline.core.errors import SettingError, from_os_error
from scan2sim.services.teleoperation.encoders import Decoder
from scan2sim.services.teleoperation.settings import ExportParams
from scan2sim.services.teleoperation.station.recorder import (
    COMMAND,
    STRING,
    RecordedFrame,
    command_message,
    read,
    typestore,
)

IMAGE = "sensor_msgs/msg/CompressedImage"
JPEG_QUALITY = 80


def export(params: ExportParams) -> int:
    """Export drives to a bag (MCAP); returns the number of images.

    Raises:
        InputError: the recording can't be read. SettingError: the folder exists. SpaceError: it can't be written.
        UnavailableError: PyAV isn't installed.
    """
    if params.out.exists():
        raise SettingError(str(params.out), "exists", "Give the name of a new folder")
    next(read(params.recording))  # a missing recording leaves nothing behind
    try:
        with Writer(params.out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            return _Exporter(writer, params.rate).run(params.recording)
    except OSError as error:
        raise from_os_error(error, params.out) from None


class _Exporter:
    """Writes the messages of a recording."""

    def __init__(self, writer: Writer, rate: float) -> None:
        self._writer, self._interval, self._store = writer, 1e9 / rate, typestore()
        self._connections: dict[str, Any] = {}
        self._decoders: dict[str, Decoder] = {}
        self._due: dict[str, float] = {}

    def run(self, recording: Path) -> int:
        """Export a recording; returns the number of images."""
        images = 0
        for topic, at, content in read(recording):
            if isinstance(content, RecordedFrame):
                images += self._image(at, content)
            elif topic == "/command":
                self._write(topic, COMMAND, at, command_message(self._store, content))
            else:
                self._write(topic, STRING, at, self._store.types[STRING](json.dumps(content)))
        return images

    def _image(self, at: int, frame: RecordedFrame) -> bool:
        """Decode a frame, each since they depend on those before, and write it if one is due."""
        import cv2

        decoder = self._decoders.get(frame.camera) or self._decoders.setdefault(frame.camera, Decoder())
        image, due = decoder.decode(frame.data), self._due.get(frame.camera, 0.0)
        if image is None or frame.captured < due:
            return False
        self._due[frame.camera] = max(due, frame.captured - self._interval) + self._interval
        types = self._store.types
        stamp = types["builtin_interfaces/msg/Time"](frame.captured // 10**9, frame.captured % 10**9)
        header = types["std_msgs/msg/Header"](stamp, frame.camera)
        _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        topic = f"/video/{re.sub(r'[^A-Za-z0-9_]', '_', frame.camera)}/compressed"
        self._write(topic, IMAGE, at, types[IMAGE](header, "jpeg", np.asarray(data).ravel()))
        return True

    def _write(self, topic: str, kind: str, at: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._connections[topic], at, self._store.serialize_cdr(message, kind))
