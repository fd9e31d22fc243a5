"""Choice of the topics with photos: one of each camera that has a calibration; not depth and infrared images."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.importers.bag import images
from scan2sim.pipeline.importers.bag.cameras import camera_offset
from scan2sim.pipeline.importers.bag.contents import Contents

RECTIFIED = re.compile("rect|undist")
"""Part of the name of a topic with images without distortion."""
INFRARED = re.compile(r"(^|[/_])(infra\d?|infrared|ir|thermal)([/_]|$)")
"""Part of the name of a topic with infrared images."""


@dataclass
class CameraTopics:
    """Topics of cameras.

    Attributes:
        found: contents of the bag.
        uses: receives why a topic isn't used.
    """

    found: Contents
    uses: dict[str, str] = field(default_factory=dict)

    def chosen(self, calibrated: bool) -> list[str]:
        """One topic of each camera: with most images, with colours, not rectified, not compressed.

        Topics are of the same camera if they have the same CameraInfo, or images of the same size in the same frame
        (drivers publish a camera's images several times). Grey infrared images are used if there are no others.

        Args:
            calibrated: whether cameras without CameraInfo have a calibration, too.
        """
        topics = []
        for topic in self.found.topics("image", "compressed"):
            if images.is_depth(self._encoding(topic)) or "compressedDepth" in topic:
                self.uses[topic] = "not used: depth images"
            elif self.info(topic) is None and not calibrated:
                self.uses[topic] = "not used: no CameraInfo (--intrinsics gives its camera)"
            else:
                topics.append(topic)
        topics = self._best(topics, lambda topic: self.info(topic) or topic)
        topics = self._best(topics, self._frame_and_size)
        infrared = [topic for topic in topics if INFRARED.search(topic) and not images.colours(self._encoding(topic))]
        if len(infrared) < len(topics):
            self.uses.update(dict.fromkeys(infrared, "not used: infrared images (--camera uses it)"))
            topics = [topic for topic in topics if topic not in infrared]
        return sorted(topics)

    def info(self, topic: str) -> str | None:
        """Topic of the CameraInfo of an image topic: beside it, else the only one in its frame."""
        beside = f"{base(topic).rpartition('/')[0]}/camera_info"
        infos = self.found.topics("info")
        if beside in infos:
            return beside
        own = [name for name in infos if self.found.frame(name) == self.found.frame(topic)]
        return own[0] if len(own) == 1 else None

    def size(self, topic: str) -> tuple[int, int]:
        """Width and height of a topic's images, by the first one.

        Raises:
            InputError: it can't be read.
        """
        import cv2

        first = self.found.first[topic]
        if self.found.kind(topic) == "image":
            if not (first.width and first.height and len(first.data)):
                raise self._no_image(topic, "has no data")
            return int(first.width), int(first.height)
        try:
            _, content = images.compressed_file(first)
        except images.InvalidImage as error:
            raise self._no_image(topic, str(error)) from None
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise self._no_image(topic, "is a damaged image")
        return int(pixels.shape[1]), int(pixels.shape[0])

    def _no_image(self, topic: str, cause: str) -> InputError:
        remedy = "Name other topics with --camera, or none"
        return InputError(self.found.bag.path, f"the first image of {topic} {cause}", remedy)

    def _best(self, topics: list[str], key: Callable[[str], Any]) -> list[str]:
        """Of topics of the same camera (the same `key`) the best one."""

        def rank(topic: str) -> tuple[Any, ...]:
            info = self.info(topic)
            second = info is not None and camera_offset(self.found.first[info]) != 0
            count, compressed = self.found.bag.topics[topic].count, self.found.kind(topic) == "compressed"
            return not second, count, images.colours(self._encoding(topic)), not rectified(topic), not compressed

        best: dict[Any, str] = {}
        for topic in topics:
            own = key(topic)
            old = best.setdefault(own, topic)
            if old != topic:
                loser, best[own] = (old, topic) if rank(topic) > rank(old) else (topic, old)
                self.uses[loser] = f"not used: of the same camera as {best[own]} (--camera uses it)"
        return list(best.values())

    def _encoding(self, topic: str) -> str:
        """Encoding of a topic's images, or the format of compressed ones."""
        first = self.found.first[topic]
        return str(getattr(first, "encoding", "")) or str(getattr(first, "format", ""))

    def _frame_and_size(self, topic: str) -> Any:
        """Frame and size of a topic's images; the topic itself if they are unknown."""
        frame = self.found.headers[topic].frame
        with suppress(InputError):
            return (frame, self.size(topic)) if frame else topic
        return topic


def base(topic: str) -> str:
    """Topic of the images without the suffix of its transport."""
    return topic.removesuffix("/compressed")


def rectified(topic: str) -> bool:
    """Whether images of a topic are without distortion, by its last name."""
    return RECTIFIED.search(base(topic).rpartition("/")[2]) is not None
