"""Any segmentation network in an ONNX file, by onnxruntime.

The file has one input, (1, 3, H, W) float RGB, and one output, (1, C, h, w) logits or probabilities. Its
`metadata_props` may tell, as JSON: "labels", names of the C channels in order (else `<name>.labels.txt` beside it, one
a line); "mean" and "std" that the input, 1 for white, is normalised with (else ImageNet's); "pixels_a_radian", the
angular resolution that photos are resampled to (else they are taken as they are); "channels", true if the input is
(1, 7, H, W), with those of `segmentation.lidar_channels` from 0 to 1 after the colours. "license" is told on.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation import onnx_session
from scan2sim.segmentation.backends import Facts, given
from scan2sim.segmentation.backends.segformer import MEAN, STD, numbers
from scan2sim.segmentation.lidar_channels import COUNT

NEEDS = ("onnxruntime",)
REMEDY = "Export the network with one input (1, 3, H, W) of floats and one output (1, C, h, w)"


def check(weights: Path | None) -> None:
    """See `segmentation.backends.Backend`."""
    given("onnx", weights)


def load(weights: Path | None, device: str) -> Network:
    """The network of an ONNX file.

    Raises:
        SettingError: onnxruntime can't use the device.
        InputError: it is missing, damaged, has other inputs or outputs, or doesn't name its labels.
    """
    return Network(given("onnx", weights), device)


class Network:
    """See `segmentation.backends.Network`; h, w are what the file gives, also where it wants photos of a fixed size."""

    def __init__(self, path: Path, device: str, backend: str = "onnx") -> None:
        self._path = path
        self._session = onnx_session.opened(path, device, "label.device")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1:
            names = ", ".join(value.name for value in [*inputs, *outputs])
            raise InputError(path, f"has {len(inputs)} inputs and {len(outputs)} outputs ({names})", REMEDY)
        (given,), (got,) = inputs, outputs
        meta = self._session.get_modelmeta().custom_metadata_map
        more = bool(onnx_session.value(meta.get("channels"), False))
        wanted, produced = _sizes(given.shape), _sizes(got.shape)
        fits = len(wanted) == 4 and wanted[0] in (1, None) and wanted[1] in (3 + COUNT * more, None)
        if given.type not in onnx_session.FLOATS or not fits:
            raise InputError(path, f"takes {given.type} of {given.shape}", REMEDY)
        if got.type not in onnx_session.FLOATS or (got.shape and len(produced) != 4):
            raise InputError(path, f"gives {got.type} of {got.shape}", REMEDY)
        self._input, self._type, self._size = given.name, onnx_session.FLOATS[given.type], wanted[2:]
        labels = onnx_session.labels(path, meta)
        if got.shape and produced[1] not in (None, len(labels)):
            raise InputError(path, f"gives {produced[1]} channels, but {len(labels)} labels are named", "Name one each")
        self._mean = numbers(onnx_session.value(meta.get("mean"), MEAN), 3, path, least=-np.inf)
        self._std = numbers(onnx_session.value(meta.get("std"), STD), 3, path)
        licence = meta.get("license") or "not told"
        density = onnx_session.value(meta.get("pixels_a_radian"), None)
        resolution = None if density is None else float(numbers([density], 1, path)[0])
        self.facts = Facts(f"{backend} ({path.name})", labels, onnx_session.digest(path), licence, resolution, more)

    def probabilities(self, seen: U8) -> F32:
        """See `segmentation.backends.Network`.

        Raises:
            InputError: the network can't take a photo of this size, or gives something else than it should.
        """
        import cv2

        height, width = (fixed or own for fixed, own in zip(self._size, seen.shape[:2], strict=True))
        if (height, width) != seen.shape[:2]:
            smaller = height * width < seen.shape[0] * seen.shape[1]
            seen = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        x = seen.astype(np.float32) / 255
        x[..., :3] = (x[..., :3] - self._mean) / self._std
        try:
            (out,) = self._session.run(None, {self._input: x.transpose(2, 0, 1)[None].astype(self._type)})
        except Exception as error:  # onnxruntime's errors have no kind in common
            raise onnx_session.failure(error, self._path, f"fails on a photo of {width} x {height}", REMEDY) from None
        if out.ndim != 4 or out.shape[:2] != (1, len(self.facts.labels)):
            cause = f"gives {out.shape} for {len(self.facts.labels)} labels"
            raise InputError(self._path, cause, "Name a label for every channel of a (1, C, h, w) output")
        logits = out[0].astype(np.float32)
        total = logits.sum(axis=0, keepdims=True)
        if logits.min() >= 0 and np.abs(total - 1).max() < 0.01:  # probabilities; rounded, if in half precision
            return np.asarray(logits / total, np.float32)
        powers = np.exp(logits - logits.max(axis=0, keepdims=True))
        return np.asarray(powers / powers.sum(axis=0, keepdims=True), np.float32)


def _sizes(shape: list[int | str | None]) -> tuple[int | None, ...]:
    """None for what is known only when it runs."""
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)
