"""Valid point clouds in all formats, and damage specific to their formats."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

import cv2
import numpy as np

from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.images.e57 import CYLINDRICAL, PINHOLE, SPHERICAL
from tests.fakes import e57_files
from tests.fakes.e57_files import Image2D
from tests.fuzz.damage import FLOATS, INTEGERS
from tests.pipeline.io.test_cloud_formats import Format, e57_changed
from tests.pipeline.io.test_clouds import FRAME, made

LAS_HEADER_FIELDS = (
    (24, "<B"), (25, "<B"), (94, "<H"), (96, "<I"), (100, "<I"), (104, "<B"), (105, "<H"), (107, "<I"), (131, "<d"),
    (155, "<d"), (179, "<d"), (187, "<d"), (211, "<d"), (227, "<Q"), (235, "<Q"), (243, "<I"), (247, "<Q"),
)  # fmt: skip
"""Byte offset and type of fields of a LAS header: version, sizes, counts, offsets, scales, bounds."""


def writer(form: Format) -> Callable[[Path], list[Path]]:
    """Function that writes a cloud in a format and returns its files."""

    def make(folder: Path) -> list[Path]:
        form.write(folder / form.file, made(1000))
        return sorted(path for path in folder.rglob("*") if path.is_file())

    return make


def reader(form: Format) -> Callable[[Path], None]:
    """Function that reads a cloud in all available ways: inspection, chunks, import."""

    def read(folder: Path) -> None:
        path = folder / form.file
        inspect_path(path)
        for part in clouds.chunks(path, Frame(FRAME.crs), 300):
            assert len(part)
        out = folder / "tile"
        import_las([path], out, crs=FRAME.crs, overwrite=out.exists())

    return read


def e57_images(folder: Path) -> list[Path]:
    """Write an E57 file with images of all representations, one with a mask."""
    blobs = {"jpegImage": cv2.imencode(".jpg", np.full((40, 80, 3), 90, np.uint8))[1].tobytes()}
    mask = {"imageMask": cv2.imencode(".png", np.full((40, 80), 255, np.uint8))[1].tobytes()}
    lens = {"focalLength": 0.02, "pixelWidth": 5e-4, "pixelHeight": 5e-4, "principalPointX": 40, "principalPointY": 20}
    ball, part = {"pixelWidth": np.pi / 40, "pixelHeight": np.pi / 40}, {"pixelWidth": 0.05, "pixelHeight": 0.05}
    images = [
        Image2D(PINHOLE, lens, blobs | mask, (80, 40), name="pinhole"),
        Image2D(SPHERICAL, ball, blobs, (80, 40), rotation=None, associated=True),
        Image2D(SPHERICAL, part, blobs | mask, (80, 40), time=9.0),
        Image2D(CYLINDRICAL, part | {"radius": 1.0, "principalPointY": 15}, blobs, (80, 40)),
    ]
    cloud = made(1000)
    return [e57_files.write(folder / "images.e57", cloud.frame.to_crs(cloud.xyz), images)]


def read_e57_images(folder: Path) -> None:
    """Import an E57 file with its images."""
    out = folder / "tile"
    import_las([folder / "images.e57"], out, crs=FRAME.crs, overwrite=out.exists())


def e57_content(data: bytes, rng: Random) -> bytes:
    """Change bytes of the content of an E57 file, and update its checksums."""

    def change(plain: bytes) -> bytes:
        body, xml = bytearray(plain), plain.find(b"<?xml")
        for _ in range(rng.choice((1, 3, 10))):
            body[rng.randrange(xml if rng.random() < 0.5 else 0, len(body))] = rng.randrange(256)
        return bytes(body)

    return e57_changed(data, change) if b"<?xml" in data and len(data) % 1024 == 0 else data


def las_field(data: bytes, rng: Random) -> bytes:
    """Replace a field of the header with another value."""
    at, form = rng.choice(LAS_HEADER_FIELDS)
    value: float = rng.choice(FLOATS) if form == "<d" else rng.choice(INTEGERS) % 2 ** (8 * struct.calcsize(form))
    body = struct.pack(form, value)
    return data[:at] + body + data[at + len(body) :]
