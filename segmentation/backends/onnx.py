"""Backend "onnx": any segmentation network in an ONNX file, run by onnxruntime.

The file has one input, (1, 3, H, W) float RGB, and one output, (1, C, h, w) logits or probabilities. Its
`metadata_props` may contain, as JSON: "labels", names of the C channels in order (else they are read from
`<name>.labels.txt`, one per line); "mean" and "std", the normalisation of the input in [0, 1] (else ImageNet's);
"pixels_a_radian", the angular resolution to which photos are resampled (else they are not resampled); "channels", true
if the input is (1, 7, H, W), with `segmentation.lidar_channels` in [0, 1] after the colours; "license", which is
reported.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation import onnx_session
from scan2sim.segmentation.backends import NetworkInfo, require_weights
from scan2sim.segmentation.backends.segformer import MEAN, STD, normalisation
from scan2sim.segmentation.lidar_channels import CHANNELS

NEEDS = ("onnxruntime",)
REMEDY = "Export the network with one float input (1, 3, H, W) and one output (1, C, h, w)"


def check(weights: Path | None) -> None:
    """See `segmentation.backends.Backend`."""
    require_weights("onnx", weights)


def load(weights: Path | None, device: str) -> Network:
    """The network of an ONNX file.

    Raises:
        SettingError: onnxruntime can't use the device.
        InputError: the file is missing or damaged, has other inputs or outputs, or has no labels.
    """
    return Network(require_weights("onnx", weights), device)


class Network:
    """See `segmentation.backends.Network`; h, w are the size of the file's output, also if its input size is fixed."""

    def __init__(self, path: Path, device: str, backend: str = "onnx") -> None:
        self._path = path
        self._session = onnx_session.open_session(path, device, "label.device")
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        if len(inputs) != 1 or len(outputs) != 1:
            names = ", ".join(value.name for value in [*inputs, *outputs])
            raise InputError(path, f"{len(inputs)} inputs and {len(outputs)} outputs ({names}), not one each", REMEDY)
        (source,), (output,) = inputs, outputs
        meta = self._session.get_modelmeta().custom_metadata_map
        takes_channels = bool(onnx_session.metadata_value(meta.get("channels"), False))
        wanted, produced = _sizes(source.shape), _sizes(output.shape)
        fits = len(wanted) == 4 and wanted[0] in (1, None) and wanted[1] in (3 + CHANNELS * takes_channels, None)
        if source.type not in onnx_session.FLOATS or not fits:
            raise InputError(path, f"unsupported input: {source.type} of shape {source.shape}", REMEDY)
        if output.type not in onnx_session.FLOATS or (output.shape and len(produced) != 4):
            raise InputError(path, f"unsupported output: {output.type} of shape {output.shape}", REMEDY)
        self._input, self._type, self._size = source.name, onnx_session.FLOATS[source.type], wanted[2:]
        labels = onnx_session.read_labels(path, meta)
        if output.shape and produced[1] not in (None, len(labels)):
            raise InputError(
                path, f"{produced[1]} output channels, but {len(labels)} labels", "Name one label per channel"
            )
        self._mean = normalisation(onnx_session.metadata_value(meta.get("mean"), MEAN), 3, path, minimum=-np.inf)
        self._std = normalisation(onnx_session.metadata_value(meta.get("std"), STD), 3, path)
        licence = meta.get("license") or "not stated"
        density = onnx_session.metadata_value(meta.get("pixels_a_radian"), None)
        resolution = None if density is None else float(normalisation([density], 1, path)[0])
        name = f"{backend} ({path.name})"
        self.info = NetworkInfo(name, labels, onnx_session.digest(path), licence, resolution, takes_channels)

    def probabilities(self, seen: U8) -> F32:
        """See `segmentation.backends.Network`.

        Raises:
            InputError: the network fails on photos of this size, or its output has another shape than it states.
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
        except Exception as error:  # onnxruntime's errors have no common base class
            cause = f"fails on a photo of {width} x {height} pixels"
            raise onnx_session.session_error(error, self._path, cause, REMEDY) from None
        if out.ndim != 4 or out.shape[:2] != (1, len(self.info.labels)):
            cause = f"output of shape {out.shape} for {len(self.info.labels)} labels"
            raise InputError(self._path, cause, "Name one label per channel of the output (1, C, h, w)")
        logits = out[0].astype(np.float32)
        total = logits.sum(axis=0, keepdims=True)
        if logits.min() >= 0 and np.abs(total - 1).max() < 0.01:  # already probabilities, possibly in half precision
            return np.asarray(logits / total, np.float32)
        powers = np.exp(logits - logits.max(axis=0, keepdims=True))
        return np.asarray(powers / powers.sum(axis=0, keepdims=True), np.float32)


def _sizes(shape: list[int | str | None]) -> tuple[int | None, ...]:
    """Shape with None for dynamic dimensions."""
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)
