"""Photo files with known pixels, written by OpenImageIO; ICC profiles, and conversions to and from sRGB."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio

from scan2sim.pipeline.core.types import F64

Pixels = npt.NDArray[Any]
SRGB, P3, ADOBE = (
    ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
    ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    ((0.640, 0.330), (0.210, 0.710), (0.150, 0.060)),
)
"""Chromaticities of primaries (IEC 61966-2-1, SMPTE EG 432-1, Adobe RGB 1998); the white point of all is D65."""
D65, D50 = (0.3127, 0.3290), (0.3457, 0.3585)
BRADFORD = np.array([(0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296)])


def decoded(rgb: Pixels) -> F64:
    """Linear light of sRGB values in 0 to 1 (IEC 61966-2-1)."""
    x = np.asarray(rgb, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def encoded(light: Pixels) -> F64:
    """SRGB values of linear light, clipped to 0 to 1."""
    x = np.clip(np.asarray(light, np.float64), 0, 1)
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055)


def to_xyz(primaries: tuple[tuple[float, float], ...], white: tuple[float, float] = D65) -> F64:
    """(3, 3) matrix from linear RGB to CIE XYZ."""
    corners = np.array([(x / y, 1.0, (1 - x - y) / y) for x, y in primaries]).T
    return np.asarray(corners * np.linalg.solve(corners, _xyz(white)))


def _xyz(white: tuple[float, float]) -> F64:
    return np.array([white[0] / white[1], 1.0, (1 - white[0] - white[1]) / white[1]])


def profile(primaries: tuple[tuple[float, float], ...], gamma: float | None) -> bytes:
    """ICC profile (version 2, matrix and curves) with a power law, or with sRGB's curve if `gamma` is None."""
    cones = BRADFORD @ np.stack([_xyz(D50), _xyz(D65)], axis=1)
    adapted = np.linalg.inv(BRADFORD) @ np.diag(cones[:, 0] / cones[:, 1]) @ BRADFORD @ to_xyz(primaries)
    table = decoded(np.arange(1024) / 1023) if gamma is None else None
    counts = [round(gamma * 256)] if gamma else np.rint(np.asarray(table) * 65535).astype(int).tolist()
    curve = b"curv" + struct.pack(f">4xI{len(counts)}H", len(counts), *counts)
    tags = {b"desc": b"desc" + struct.pack(">4xI", 5) + b"made\0" + bytes(78), b"cprt": b"text" + bytes(4) + b"none\0"}
    for name, xyz in zip((b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ"), (_xyz(D50), *adapted.T), strict=True):
        tags[name] = b"XYZ " + struct.pack(">4x3i", *np.rint(xyz * 65536).astype(int))
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    index, body, start = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for name, tag in tags.items():
        index += name + struct.pack(">II", start + len(body), len(tag))
        body += tag + bytes(-len(tag) % 4)
    white = np.rint(_xyz(D50) * 65536).astype(int)
    head = struct.pack(
        ">I4xI4s4s4s12x4s28x3i", start + len(body), 0x02400000, b"mntr", b"RGB ", b"XYZ ", b"acsp", *white
    )
    return head.ljust(128, b"\0") + index + body


def write(path: Path, pixels: Pixels, kind: str, tile: int = 0, **attributes: str | int) -> None:
    """Write a file with OpenImageIO; attributes are named like "png__compressionLevel"."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.tile_width = spec.tile_height = tile
    if "channelnames" in attributes:
        spec.channelnames = tuple(str(attributes.pop("channelnames")).split())
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out: Any = oiio.ImageOutput.create(str(path))
    if not out.open(str(path), spec) or not out.write_image(pixels):
        raise SystemExit(f"{path}: {out.geterror()}")
    out.close()
