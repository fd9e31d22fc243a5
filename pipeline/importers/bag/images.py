"""Photos of `sensor_msgs/Image` and `CompressedImage`: compressed ones are written as they are, others as PNG."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

PLAIN = {
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "8UC3": ("u1", 3), "8UC4": ("u1", 4), "rgb8": ("u1", 3), "bgr8": ("u1", 3),
    "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono16": ("u2", 1), "16UC1": ("u2", 1), "rgb16": ("u2", 3),
    "bgr16": ("u2", 3), "rgba16": ("u2", 4), "bgra16": ("u2", 4), "16UC3": ("u2", 3),
}  # fmt: skip
"""Encoding to type and channels."""
BAYER = {"rggb": "BayerBG", "bggr": "BayerRG", "gbrg": "BayerGR", "grbg": "BayerGB"}
"""Colour filter of the first 2x2 pixels to OpenCV's name, which is that of the pixels from (1, 1) on."""
YUV = {
    "yuv422": "YUV2BGR_UYVY", "uyvy": "YUV2BGR_UYVY", "yuv422_yuy2": "YUV2BGR_YUY2", "yuyv": "YUV2BGR_YUY2",
    "nv12": "YUV2BGR_NV12", "nv21": "YUV2BGR_NV21",
}  # fmt: skip
JPEG, PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
JPEG_END, PNG_END = b"\xff\xd9", b"IEND"
"""Markers at the end of a file; some cameras pad files by up to `TAIL_BYTES`."""
TAIL_BYTES = 4096
DEPTH_ENCODINGS = ("32FC1", "16UC1", "64FC1")
"""Encodings of depth and disparity images."""


class InvalidImage(Exception):
    """An image that can't be decoded; the text says why."""


def is_depth(encoding: str) -> bool:
    """Whether an encoding, or a `CompressedImage.format` such as "16UC1; png compressed", is that of depths."""
    return "compressedDepth" in encoding or encoding.partition(";")[0].strip() in DEPTH_ENCODINGS


def colours(encoding: str) -> bool:
    """Whether images of an encoding, or of a `CompressedImage.format` such as "bgr8; jpeg compressed", show colours."""
    first, _, stored = encoding.lower().partition(";")
    return not first.startswith(("mono", "8uc1", "16uc1", "32fc1", "64fc1")) and "mono" not in stored


def compressed_file(image: Any) -> tuple[str, bytes]:
    """Suffix and content of the file of a `CompressedImage`: its bytes, unchanged; PNG of a compressed Bayer pattern.

    Raises:
        InvalidImage: it is empty, or neither JPEG nor PNG.
    """
    content = bytes(image.data)
    if not content:
        raise InvalidImage("has no data")
    if content.startswith((JPEG, PNG)):
        jpeg = content.startswith(JPEG)
        if (JPEG_END if jpeg else PNG_END) not in content[-TAIL_BYTES:]:
            raise InvalidImage("is truncated")
        pattern = _bayer_pattern(str(image.format))
        return (".jpg" if jpeg else ".png", content) if not pattern else _demosaiced(content, pattern)
    raise InvalidImage(f"is neither JPEG nor PNG (format {str(image.format)[:40]!r})")


def _bayer_pattern(kind: str) -> str:
    """Bayer pattern of a `CompressedImage` with the `format` `kind`; "" if its pixels aren't raw.

    compressed_image_transport doesn't convert Bayer images ("bayer_rggb8; jpeg compressed "), or to grey ("mono8").
    """
    encoding, _, stored = kind.lower().partition(";")
    raw = encoding.startswith("bayer_") and not any(name in stored for name in ("mono", "bgr", "rgb8", "rgb16"))
    return encoding[6:10] if (raw or "bayer_" in stored) and encoding[6:10] in BAYER else ""


def _demosaiced(content: bytes, pattern: str) -> tuple[str, bytes]:
    """PNG file of a compressed Bayer pattern; a file with colours is kept."""
    import cv2

    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InvalidImage("is damaged")
    if pixels.ndim == 3:
        return (".jpg" if content.startswith(JPEG) else ".png"), content
    colour = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{BAYER[pattern]}2BGR"))
    return ".png", cv2.imencode(".png", colour, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def unused_bits(image: Any) -> int:
    """Number of the highest bits that no pixel of a 16-bit `Image` uses: 4 of a 12-bit camera; 0 of other images."""
    if not str(image.encoding).lower().endswith(("16", "16uc1", "16uc3")):
        return 0
    try:
        pixels = _bgr(image)
    except InvalidImage:
        return 0
    return 16 - int(pixels.max()).bit_length() if pixels.dtype == np.uint16 else 0


def raw_file(image: Any) -> tuple[str, bytes]:
    """Suffix and content of a PNG file of an `Image`.

    Raises:
        InvalidImage: it is empty, shorter than its size requires, or its encoding is unknown.
    """
    import cv2

    encoded, png = cv2.imencode(".png", _bgr(image), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not encoded:
        raise InvalidImage("can't be encoded as PNG")
    return ".png", png.tobytes()


def _bgr(image: Any) -> npt.NDArray[Any]:
    """Pixels (H, W) or (H, W, 3 or 4) in OpenCV's order of channels."""
    import cv2

    encoding, name = str(image.encoding), str(image.encoding).lower()
    if encoding in PLAIN:
        kind, channels = PLAIN[encoding]
        pixels = _pixels(image, kind, channels)
        if encoding.startswith("rgba"):
            return cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGR)
        if encoding.startswith("bgra") or channels == 4:
            return cv2.cvtColor(pixels, cv2.COLOR_BGRA2BGR)
        return cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if encoding.startswith("rgb") else pixels
    if name.startswith("bayer_") and name[6:10] in BAYER:
        pixels = _pixels(image, "u2" if name.endswith("16") else "u1", 1)
        return cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{BAYER[name[6:10]]}2BGR"))
    if name in YUV:
        packed = not name.startswith("nv")
        pixels = _pixels(image, "u1", 2) if packed else _pixels(image, "u1", 1, int(image.height) * 3 // 2)
        return cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{YUV[name]}"))
    raise InvalidImage(f"has the unsupported encoding {encoding[:40]!r}")


def _pixels(image: Any, kind: str, channels: int, lines: int | None = None) -> npt.NDArray[Any]:
    height, width = int(image.height) if lines is None else lines, int(image.width)
    size = np.dtype(kind).itemsize * channels
    stride = int(image.step) or width * size
    data = np.frombuffer(image.data, np.uint8)
    if not height * width or not len(data):
        raise InvalidImage(f"has no data ({width}x{height} pixels, {len(data)} bytes)")
    if stride < width * size or len(data) < (height - 1) * stride + width * size:
        raise InvalidImage(
            f"has {len(data)} bytes for {width}x{height} pixels of encoding {str(image.encoding)[:40]!r}"
        )
    data = np.pad(data, (0, max(0, height * stride - len(data))))[: height * stride]
    rows = np.ascontiguousarray(data.reshape(height, stride)[:, : width * size])
    order = ">" if image.is_bigendian else "<"
    pixels = rows.view(f"{order}{kind}").astype(kind, copy=False)
    return pixels.reshape((height, width, channels) if channels > 1 else (height, width))
