"""Images of all encodings, and cameras of all distortion models."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.importers.bag.cameras import has_only_projection, looks_rectified
from scan2sim.pipeline.importers.bag.images import InvalidImage, compressed_file, raw_file
from scan2sim.pipeline.io.camera_info import camera_of
from tests.pipeline.io.test_camera_info import info

RGB = np.zeros((16, 24, 3), np.uint8)
RGB[:8, :, 0], RGB[8:, :, 1], RGB[:, 12:, 2] = 200, 120, 90


def image(pixels: Any, encoding: str, pad: int = 0, **more: Any) -> Any:
    """An Image of pixels (H, W[, C]), with `pad` bytes after each row."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, pad)), constant_values=77).ravel()
    message = {"height": height, "width": width, "encoding": encoding, "step": rows.shape[1] + pad, "data": data}
    return SimpleNamespace(**({"is_bigendian": 0} | message | more))


def pixels_of(message: Any) -> Any:
    """The pixels of the file of an image, BGR."""
    suffix, content = raw_file(message)
    assert suffix == ".png"
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("pad", [0, 8])
def test_colours_are_read_in_any_channel_order(pad: int) -> None:
    bgr, alpha = RGB[..., ::-1], np.full((16, 24, 1), 255, np.uint8)
    for encoding, pixels in (
        ("rgb8", RGB), ("bgr8", bgr), ("8UC3", bgr), ("rgba8", np.dstack([RGB, alpha])),
        ("bgra8", np.dstack([bgr, alpha])),
    ):  # fmt: skip
        assert np.array_equal(pixels_of(image(pixels, encoding, pad)), bgr), encoding


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_demosaiced(pattern: str) -> None:
    channels = ["rgb".index(c) for c in pattern]
    mosaic = np.zeros((16, 24), np.uint8)
    for k, channel in enumerate(channels):
        mosaic[k // 2 :: 2, k % 2 :: 2] = RGB[k // 2 :: 2, k % 2 :: 2, channel]
    found = pixels_of(image(mosaic, f"bayer_{pattern}8"))[..., ::-1]
    assert np.array_equal(found[3, 4], RGB[3, 4]) and np.array_equal(found[12, 20], RGB[12, 20])


def test_grey_16_bit_and_yuv_images_are_converted() -> None:
    grey = np.arange(16 * 24, dtype=np.uint16).reshape(16, 24)
    assert np.array_equal(pixels_of(image(grey.astype(np.uint8), "mono8")), grey.astype(np.uint8))
    assert np.array_equal(pixels_of(image(grey * 100, "mono16")), grey * 100)
    swapped = (grey * 100).astype(">u2")
    assert np.array_equal(pixels_of(image(swapped, "16UC1", is_bigendian=1)), grey * 100)
    yuyv = np.zeros((16, 24, 2), np.uint8)
    yuyv[..., 0], yuyv[..., 1] = 120, 128
    assert np.ptp(pixels_of(image(yuyv, "yuv422_yuy2"))) <= 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": np.zeros(0, np.uint8)}, "has no data"),
        ({"data": np.zeros(100, np.uint8)}, "has 100 bytes for 24x16"),
        ({"encoding": "32FC1"}, "unsupported encoding '32FC1'"), ({"height": 0}, "has no data"),
    ],
)  # fmt: skip
def test_damaged_images_are_rejected(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidImage, match=message):
        raw_file(image(RGB, **({"encoding": "rgb8"} | change)))


def test_compressed_images_are_copied_unchanged() -> None:
    for suffix in (".jpg", ".png"):
        content = cv2.imencode(suffix, RGB)[1].tobytes()
        assert compressed_file(SimpleNamespace(data=content, format="")) == (suffix, content)
        with pytest.raises(InvalidImage, match="truncated"):
            compressed_file(SimpleNamespace(data=content[:-20], format=""))
    for content, message in ((b"", "has no data"), (b"GIF89a", "neither JPEG nor PNG")):
        with pytest.raises(InvalidImage, match=message):
            compressed_file(SimpleNamespace(data=content, format="gif"))


@pytest.mark.parametrize(("suffix", "codec"), [(".png", "png"), (".jpg", "jpeg")])
def test_compressed_bayer_patterns_are_demosaiced(suffix: str, codec: str) -> None:
    mosaic = np.full((16, 24), 40, np.uint8)
    mosaic[::2, ::2] = 200  # red pixels of rggb
    quality = [cv2.IMWRITE_JPEG_QUALITY, 100] if codec == "jpeg" else []
    content = cv2.imencode(suffix, mosaic, quality)[1].tobytes()
    made, file = compressed_file(SimpleNamespace(data=content, format=f"bayer_rggb8; {codec} compressed "))
    blue, green, red = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)[8, 8].astype(int)
    assert made == ".png" and abs(red - 200) < 20 and abs(blue - 40) < 20 and abs(green - 40) < 20
    for converted in (f"bayer_rggb8; {codec} compressed mono8", f"bayer_rggb8; {codec} compressed bgr8"):
        assert compressed_file(SimpleNamespace(data=content, format=converted)) == (suffix, content)


def test_camera_without_k_has_that_of_p() -> None:
    without = info("", [], k=[0.0] * 9)
    assert has_only_projection(without) and not has_only_projection(info("", []))
    camera = camera_of(without, rectified=True)
    assert (camera.model, camera.fx, camera.cx, camera.distortion) == ("pinhole", 350, 330, ())


def test_rectified_images_with_raw_intrinsics_are_recognized() -> None:
    D, size = [-0.37, 0.2, 1e-3, 2e-3, -0.07], {"width": 1242, "height": 375}
    K = [959.8, 0, 695.6, 0, 956.9, 224.2, 0, 0, 1]
    P = [721.5, 0, 609.6, 44.9, 0, 721.5, 172.9, 0.2, 0, 0, 1, 0]
    assert looks_rectified(info("plumb_bob", D, k=K, p=P, **size))
    assert not looks_rectified(info("plumb_bob", D, k=K, p=P, width=1392, height=512))
    assert not looks_rectified(info("plumb_bob", [0.0] * 5, k=P[:3] + P[4:7] + P[8:11], p=P, **size))
