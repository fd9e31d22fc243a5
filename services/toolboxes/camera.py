"""Camera node: publishes the images of a folder, a video or a camera on a ROS 2 topic; instrumented."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import U8
from scan2sim.services.monitoring.node.monitor import Monitor, ros
from scan2sim.services.qos.encoding import jpeg
from scan2sim.services.toolboxes import sources
from scan2sim.services.toolboxes.settings import COMPRESSED, IMAGE, CameraParams
from scan2sim.services.transport import QoS

HEADER, TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
DEFAULT_RATE_HZ = 10.0
"""Images per second if neither the video nor the user gives a rate."""
IMAGES_QOS = QoS(depth=5)
"""Reliable, which is compatible with both reliable and best-effort subscriptions."""


class CameraNode(Monitor):
    """Publishes images at a fixed rate, stamped with the time of publication.

    Attributes:
        finished: whether all images of a folder or video were sent.
    """

    def __init__(self, params: CameraParams) -> None:
        live = sources.is_camera(params.images)
        rate = params.rate or (None if live else sources.rate_of(Path(params.images))) or DEFAULT_RATE_HZ
        super().__init__(params.name, **params.monitor_settings())
        self._params, self._begun, self.finished = params, False, False
        kind = COMPRESSED if params.compressed else IMAGE
        self._publisher = self.create_publisher(ros.message_type(kind), params.topic, IMAGES_QOS)
        self._latest: U8 | None = None
        self._reader = sources.CameraReader(params.images, self._set_latest) if live else None
        rounds = itertools.count() if params.loop else range(1)
        self._images = (image for _ in rounds for image in sources.decoded_images(Path(params.images)))
        if self._reader:
            self._reader.start()
        self.create_timer(1 / rate, self._send_next)

    def _set_latest(self, image: U8) -> None:
        self._latest = image

    def _send_next(self) -> None:
        """Publish the next image of a file, or the latest of a camera, once the expected subscribers are matched."""
        self._begun = self._begun or self._publisher.get_subscription_count() >= self._params.subscribers
        if not self._begun:
            return
        if self._reader:
            image, self._latest = self._latest, None
        else:
            image = next(self._images, None)
            self.finished = image is None
        if image is not None:
            self._publisher.publish(self._message(image))

    def _message(self, image: U8) -> Any:
        seconds, rest = divmod(time.time_ns(), 10**9)
        stamp = ros.message(TIME, sec=seconds, nanosec=rest)
        header = ros.message(HEADER, stamp=stamp, frame_id=self._params.name)
        if self._params.compressed:
            data = np.frombuffer(jpeg(image, self._params.quality), np.uint8)
            return ros.message(COMPRESSED, header=header, format="jpeg", data=data)
        height, width, _ = image.shape
        size: dict[str, Any] = {"height": height, "width": width, "step": 3 * width}
        return ros.message(IMAGE, header=header, encoding="rgb8", **size, data=image.reshape(-1))

    def destroy_node(self) -> Any:
        """Stop reading and destroy the node."""
        if self._reader:
            self._reader.stop()
        return super().destroy_node()
