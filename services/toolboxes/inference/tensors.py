"""Tensors of the Open Inference Protocol: the images of a request, and the results of a response.

An input of datatype BYTES holds encoded images (JPEG, PNG, WebP), one of UINT8 RGB images of shape [N, height, width,
3] or [height, width, 3]. Values are JSON, flat or nested by shape (BYTES in base64), or binary: each element of BYTES
behind its length in four bytes, little-endian (Triton's extension for binary tensor data, and gRPC's
`raw_input_contents`).
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Sequence
from itertools import chain, dropwhile
from math import prod
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from scan2sim.pipeline.core.errors import InputError, SettingError, printable
from scan2sim.pipeline.core.types import U8
from scan2sim.services.toolboxes import frames
from scan2sim.services.toolboxes.results import Result

MAX_REQUEST_BYTES = 2**25
"""Limit of the size of a request, equal to the number of pixels of the largest image."""
MAX_IMAGES = 64
"""Limit of images per request."""
MAX_JSON_VALUES = 2**21
"""Limit of values in a request's JSON, which other clients wait for while it is parsed."""
ENCODED_INPUT, PIXELS_INPUT, OUTPUT = "images", "pixels", "results"
"""Names of the tensors in the model's metadata; inputs of other names are accepted, too."""
PROTOCOL = "See the Open Inference Protocol, version 2"
REMEDY = "BYTES: encoded images (base64 in JSON), shape [N]; UINT8: RGB, shape [N, height, width, 3]"

Text = Annotated[str, Field(max_length=200)]
Image = bytes | U8


class InputTensor(BaseModel):
    """Input tensor in JSON; binary data is in the body if `parameters` has its `binary_data_size`."""

    name: Text
    shape: Annotated[list[Annotated[int, Field(ge=1, le=MAX_REQUEST_BYTES)]], Field(min_length=1, max_length=4)]
    datatype: Text
    parameters: dict[str, Any] = {}
    data: list[Any] | str | None = None
    """A text alone is the only element, as KServe's clients send it."""


class RequestedOutput(BaseModel):
    """Output that a request asks for."""

    name: Text
    parameters: dict[str, Any] = {}


class InferRequest(BaseModel):
    """Inference request in JSON; further fields are ignored."""

    id: Text | None = None
    parameters: dict[str, Any] = {}
    inputs: Annotated[list[InputTensor], Field(min_length=1, max_length=MAX_IMAGES)]
    outputs: list[RequestedOutput] = []

    def wants_binary(self) -> bool:
        """Whether the output is requested as binary data."""
        default = bool(self.parameters.get("binary_data_output", False))
        requested = [one.parameters.get("binary_data", default) for one in self.outputs] or [default]
        return any(requested)


def parse(body: bytes, json_bytes: int | None) -> tuple[InferRequest, list[Image]]:
    """Parse the body of an inference request over HTTP.

    Args:
        body: JSON, followed by the binary data of its inputs.
        json_bytes: size of the JSON (header `Inference-Header-Content-Length`); None: all of the body.

    Raises:
        SettingError: the request isn't one of the protocol.
        InputError: a tensor holds no valid images.
    """
    if json_bytes is not None and not 0 < json_bytes <= len(body):
        cause = f"is {json_bytes}, the body has {len(body)} bytes"
        raise SettingError("Inference-Header-Content-Length", cause, PROTOCOL)
    text, binary = body[:json_bytes], memoryview(body)[json_bytes or len(body) :]
    if (values := text.count(b",")) > MAX_JSON_VALUES:
        cause = f"has {values:,} values in JSON, more than {MAX_JSON_VALUES:,}"
        raise SettingError("inputs", cause, "Send binary tensor data or encoded images")
    try:
        request = InferRequest.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = printable(".".join(map(str, first["loc"]))) or "body"
        raise SettingError(where[:200], first["msg"], PROTOCOL) from None
    check_outputs([one.name for one in request.outputs])
    found: list[Image] = []
    for tensor in request.inputs:
        size = tensor.parameters.get("binary_data_size")
        if size is not None and (not isinstance(size, int) or not 0 <= size <= len(binary)):
            cause = f"binary_data_size is {printable(str(size))[:40]}, {len(binary)} bytes are left in the body"
            raise InputError(printable(tensor.name), cause, PROTOCOL)
        raw = None if size is None else binary[:size]
        found += images(tensor.name, tensor.datatype, tensor.shape, tensor.data, raw)
        binary = binary[size or 0 :]
        check_count(len(found))
    if binary:
        cause = f"has {len(binary)} bytes more than the binary_data_size of its inputs"
        raise SettingError("body", cause, PROTOCOL)
    return request, found


def check_outputs(names: Sequence[str]) -> None:
    """Check the names of requested outputs.

    Raises:
        SettingError: the model has no such output.
    """
    if unknown := [name for name in names if name != OUTPUT]:
        raise SettingError(
            "outputs", f"{printable(unknown[0])[:100]!r} is unknown", f"The model's output is {OUTPUT!r}"
        )


def images(
    name: str, datatype: str, shape: Sequence[int], values: Sequence[Any] | str | None, raw: memoryview | None
) -> list[Image]:
    """Images of an input tensor.

    Args:
        name, datatype, shape: as in the request.
        values: its values, flat or nested by shape: of BYTES bytes, text in base64, or {"b64": TEXT} as TensorFlow
            Serving's clients write it; of UINT8 integers. A text alone is the only value.
        raw: its binary data instead.

    Raises:
        InputError: the tensor holds no valid images.
    """
    try:
        if min(shape, default=0) < 1:
            raise ValueError(f"shape {list(shape)}")
        if datatype == "BYTES":
            encoded = _elements(raw) if raw is not None else [_decoded(one) for one in _flat(values, shape)]
            if len(encoded) != prod(shape):
                raise ValueError(f"{len(encoded)} values for shape {list(shape)}")
            check_count(len(encoded))
            return list(encoded)
        if datatype != "UINT8":
            raise ValueError(f"datatype {printable(datatype)[:40]!r}, which the model doesn't take")
        count, height, width, channels = shape if len(shape) == 4 else (1, *shape)
        check_count(count)
        frames.check_size(printable(name), width, height)
        if channels != 3:
            raise ValueError(f"shape {list(shape)} has {channels} channels instead of 3 as its last dimension")
        pixels = np.frombuffer(raw if raw is not None else bytes(_flat(values, shape)), np.uint8)
        return list(pixels.reshape(count, height, width, 3))
    except (ValueError, TypeError, OverflowError, binascii.Error) as error:
        raise InputError(printable(name), f"not an image ({error})", REMEDY) from None


def check_count(count: int) -> None:
    """Check the number of images of a request.

    Raises:
        SettingError: there are too many.
    """
    if count > MAX_IMAGES:
        raise SettingError("inputs", f"contains {count} images", f"Send at most {MAX_IMAGES} per request")


def _decoded(value: Any) -> bytes:
    if isinstance(value, bytes):
        return value
    text = value.get("b64") if isinstance(value, dict) else value
    if not isinstance(text, str):
        raise ValueError(f"a value is {type(text).__name__} instead of text in base64")
    return base64.b64decode(text, validate=True)


def _flat(values: Sequence[Any] | str | None, shape: Sequence[int]) -> Sequence[Any]:
    """Values in one sequence; nested ones must have the shape, apart from leading dimensions of 1.

    Raises:
        ValueError: they have another shape.
    """
    flat: Sequence[Any] = [values] if isinstance(values, str) else values or ()
    sizes = [len(flat)]
    while flat and isinstance(flat[0], list):
        lengths = {len(one) if isinstance(one, list) else None for one in flat}
        if len(lengths) > 1:
            raise ValueError("nested lists of different lengths")
        sizes.append(len(flat[0]))
        flat = list(chain.from_iterable(flat))
    if len(sizes) > 1 and _without_leading_ones(sizes) != _without_leading_ones(shape):
        raise ValueError(f"nested lists of shape {sizes} for shape {list(shape)}")
    return flat


def _without_leading_ones(shape: Sequence[int]) -> list[int]:
    return list(dropwhile(lambda size: size == 1, shape))


def _elements(raw: memoryview) -> list[bytes]:
    """Elements of a BYTES tensor in binary."""
    found = []
    while raw:
        if len(raw) < 4:
            raise ValueError("truncated binary data")
        (size,) = struct.unpack("<I", raw[:4])
        if size > len(raw) - 4:
            raise ValueError(f"an element has {size} bytes, {len(raw) - 4} are left")
        found.append(bytes(raw[4 : 4 + size]))
        raw = raw[4 + size :]
        check_count(len(found))
    return found


def binary(results: Sequence[Result]) -> bytes:
    """Results as the binary data of a BYTES tensor."""
    lines = [one.json_line().encode() for one in results]
    return b"".join(struct.pack("<I", len(line)) + line for line in lines)
