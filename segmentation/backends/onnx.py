"""Backend "onnx": any segmentation network in an ONNX file, run by onnxruntime.

Its input is one image, (1, 3, H, W) or (1, H, W, 3): floats are normalised, bytes are grey levels 0 to 255. Its output
is one of

- logits or probabilities of each label, (1, C, h, w) or (1, h, w, C), of several outputs the one named `out` or
  `logits`;
- the index of the label, as integers (1, h, w), (1, 1, h, w) or (1, h, w, 1);
- `class_queries_logits` and `masks_queries_logits` (MaskFormer, Mask2Former, EoMT).

`metadata_props` of the file may contain, as JSON: "labels", names of the C labels in order; "mean" and "std", the
normalisation of the input in [0, 1]; "pixels_a_radian", the angular resolution to which photos are resampled (else they
are not resampled); "channels", true if the input is (1, 7, H, W), with `segmentation.lidar_channels` in [0, 1] after
the colours; "license", which is reported. Missing labels are read as `onnx_session.read_labels` describes, a missing
normalisation from the `preprocessor_config.json` of Hugging Face beside the file, else ImageNet's is assumed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, U8
from scan2sim.segmentation import onnx_session
from scan2sim.segmentation.backends import NetworkInfo, require_weights
from scan2sim.segmentation.huggingface import PREPROCESSOR, Normalisation, beside, numbers, read_normalisation
from scan2sim.segmentation.labels import IGNORED
from scan2sim.segmentation.lidar_channels import CHANNELS

NEEDS = ("onnxruntime",)
INPUTS = onnx_session.FLOATS | {"tensor(uint8)": "uint8"}
"""NumPy type by ONNX type of the supported inputs."""
SCORES = ("out", "logits")
"""Names of the labels' scores among several outputs: of torchvision, and of Hugging Face."""
QUERIES = ("class_queries_logits", "masks_queries_logits")
"""Names of the outputs of networks that predict masks, and a label of each."""
REMEDY = (
    "Export a network for semantic segmentation with one input (1, 3, H, W) and one output: (1, C, h, w), or the index "
    "of the label (1, h, w)"
)
ASSUMED = (
    "its file doesn't state how photos are normalised: RGB with ImageNet's mean and standard deviation was assumed. If "
    f'that is right, or to change it, add metadata "mean" and "std" to the file, or a {PREPROCESSOR} beside it'
)


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
        meta = self._session.get_modelmeta().custom_metadata_map
        takes_channels = bool(onnx_session.metadata_value(meta.get("channels"), False))
        self._set_input(3 + CHANNELS * takes_channels)
        self._outputs = _chosen(self._session.get_outputs(), path)
        labels = onnx_session.read_labels(path, meta)
        self._check_labels(len(labels))
        self._normalise, assumed = _normalisation(path, meta)
        licence = meta.get("license") or "not stated"
        density = onnx_session.metadata_value(meta.get("pixels_a_radian"), None)
        resolution = None if density is None else float(numbers([density], 1, path)[0])
        height, width = self._size
        self.info = NetworkInfo(
            f"{backend} ({path.name})", labels, onnx_session.digest(path), licence, resolution, takes_channels,
            size=(height, width) if height and width else None,
            assumed=ASSUMED if assumed and self._type != "uint8" else "",
        )  # fmt: skip

    def probabilities(self, seen: U8) -> F32:
        """See `segmentation.backends.Network`; all are 0 where the file's output is the index of no label.

        Raises:
            InputError: the network fails on photos of this size, or its output has another shape than it states.
        """
        import cv2

        height, width = (fixed or own for fixed, own in zip(self._size, seen.shape[:2], strict=True))
        if (height, width) != seen.shape[:2]:
            smaller = height * width < seen.shape[0] * seen.shape[1]
            seen = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
        x: npt.NDArray[Any] = seen
        if self._type != "uint8":
            x = np.concatenate([self._normalise(seen[..., :3]), seen[..., 3:].astype(np.float32) / 255], axis=2)
        x = x.astype(self._type) if self._channels_last else x.transpose(2, 0, 1).astype(self._type)
        try:
            found = self._session.run(self._outputs, {self._input: x[None]})
        except Exception as error:  # onnxruntime's errors have no common base class
            cause = f"fails on a photo of {width} x {height} pixels"
            raise onnx_session.session_error(error, self._path, cause, REMEDY) from None
        probabilities = _probabilities(found, len(self.info.labels))
        if probabilities is None:
            outputs = ", ".join(f"{one.dtype} {one.shape} up to {one.max(initial=0):g}" for one in found)
            cause = f"output of {outputs} for {len(self.info.labels)} labels"
            raise InputError(self._path, cause, f"{REMEDY}, and name each of the C labels")
        return probabilities

    def _check_labels(self, labels: int) -> None:
        """Raise an InputError if the file states that its output has the scores of another number of labels."""
        (output, *more) = (one for one in self._session.get_outputs() if one.name in self._outputs)
        shape = _sizes(output.shape)
        if more or output.type not in onnx_session.FLOATS or len(shape) != 4:
            return
        if shape[1] is not None and labels not in (shape[1], shape[3]):
            remedy = f"{REMEDY}, and name each of the C labels"
            raise InputError(self._path, f"output {output.name} {output.shape} for {labels} labels", remedy)

    def _set_input(self, channels: int) -> None:
        """Name, type, layout and size of the input, of images with this number of channels."""
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            names = ", ".join(one.name for one in inputs)
            raise InputError(self._path, f"{len(inputs)} inputs ({names}), not one", REMEDY)
        (source,) = inputs
        shape = _sizes(source.shape)
        self._channels_last = len(shape) == 4 and shape[3] == channels and shape[1] != channels
        at = 3 if self._channels_last else 1
        if (
            source.type not in INPUTS
            or len(shape) != 4
            or shape[0] not in (1, None)
            or shape[at] not in (channels, None)
        ):
            raise InputError(self._path, f"unsupported input: {source.type} of shape {source.shape}", REMEDY)
        self._input, self._type = source.name, INPUTS[source.type]
        self._size = shape[1:3] if self._channels_last else shape[2:]


def _normalisation(path: Path, meta: dict[str, str]) -> tuple[Normalisation, bool]:
    """Normalisation of photos by a file's metadata or the file beside it, and whether neither states it."""
    file = beside(path, PREPROCESSOR)
    found = read_normalisation(file) if file else Normalisation()
    if not {"mean", "std"} & set(meta):
        return found, file is None
    mean = numbers(onnx_session.metadata_value(meta.get("mean"), found.mean.tolist()), 3, path, minimum=-np.inf)
    std = numbers(onnx_session.metadata_value(meta.get("std"), found.std.tolist()), 3, path)
    return replace(found, mean=mean, std=std), False


def _chosen(outputs: list[Any], path: Path) -> list[str]:
    """Names of the outputs that are read.

    Raises:
        InputError: there are several, with other names than the known ones, or it has no value for each pixel.
    """
    names = [one.name for one in outputs]
    if set(QUERIES) <= set(names):
        return list(QUERIES)
    known = names if len(names) == 1 else [name for name in names if name in SCORES]
    ranks = {len(one.shape) for one in outputs if one.name in known and one.shape}
    if len(known) != 1 or not ranks <= {3, 4}:
        shapes = ", ".join(f"{one.name} {one.shape}" for one in outputs)
        cause = f"unsupported outputs: {shapes}"
        raise InputError(path, cause, f"{REMEDY}; of several outputs, name it {' or '.join(SCORES)}")
    return known


def _probabilities(found: list[npt.NDArray[Any]], labels: int) -> F32 | None:
    """Probabilities (C, h, w) of the labels from the outputs for one photo; None if they are none of these labels'."""
    out = found[0]
    if len(found) == 2:
        masks = found[1]
        if out.ndim != 3 or out.shape[2] != labels + 1 or masks.ndim != 4 or masks.shape[1] != out.shape[1]:
            return None
        classes = _softmax(out[0].astype(np.float32), axis=1)[:, :-1]  # the last one is "no object"
        shares = 1 / (1 + np.exp(-masks[0].astype(np.float32)))
        return _scaled(np.einsum("qc,qhw->chw", classes, shares, optimize=True))
    if out.dtype.kind in "iu":
        single = 1 if out.ndim == 4 and out.shape[1] == 1 else 3 if out.ndim == 4 and out.shape[3] == 1 else None
        index = out if single is None else out.squeeze(single)
        fits = index.ndim == 3 and ((index < labels) | (index == IGNORED)).all()
        return (np.arange(labels)[:, None, None] == index[0]).astype(np.float32) if fits else None
    if out.ndim == 4 and out.shape[1] != labels:
        out = out.transpose(0, 3, 1, 2)
    if out.ndim != 4 or out.shape[:2] != (1, labels):
        return None
    scores = out[0].astype(np.float32)
    if scores.min() >= 0 and scores.max() <= 1.01:  # after a softmax, possibly in half precision, or a sigmoid
        return _scaled(scores)
    return _softmax(scores, axis=0)


def _scaled(scores: F32) -> F32:
    """Scores (C, h, w) of at least 0, scaled to a sum of 1 for each pixel."""
    return np.asarray(scores / np.maximum(scores.sum(axis=0, keepdims=True), 1e-6), np.float32)


def _softmax(logits: F32, axis: int) -> F32:
    powers = np.exp(logits - logits.max(axis=axis, keepdims=True))
    return np.asarray(powers / powers.sum(axis=axis, keepdims=True), np.float32)


def _sizes(shape: list[int | str | None]) -> tuple[int | None, ...]:
    """Shape with None for dynamic dimensions."""
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape)
