"""Valid point clouds in all formats, and damage specific to their formats."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
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
