"""Clouds of all formats, whole, and the damage that only they know."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from tests.fuzz.damage import REAL, WHOLE
from tests.pipeline.io.test_cloud_formats import Format, e57_changed
from tests.pipeline.io.test_clouds import FRAME, made

HEADER = (
    (24, "<B"), (25, "<B"), (94, "<H"), (96, "<I"), (100, "<I"), (104, "<B"), (105, "<H"), (107, "<I"), (131, "<d"),
    (155, "<d"), (179, "<d"), (187, "<d"), (211, "<d"), (227, "<Q"), (235, "<Q"), (243, "<I"), (247, "<Q"),
)  # fmt: skip
"""Fields of a LAS header: version, sizes, counts, offsets, scales, bounds."""


def whole(form: Format) -> Callable[[Path], list[Path]]:
    """Makes a cloud of a format, and names its files."""

    def make(folder: Path) -> list[Path]:
        form.write(folder / form.file, made(1000))
        return sorted(path for path in folder.rglob("*") if path.is_file())

    return make


def read(form: Format) -> Callable[[Path], None]:
    """Reads it in all ways there are."""

    def read(folder: Path) -> None:
        path = folder / form.file
        inspect_path(path)
        for part in clouds.chunks(path, Frame(FRAME.crs), 300):
            assert len(part)
        out = folder / "tile"
        import_las([path], out, crs=FRAME.crs, overwrite=out.exists())

    return read


def e57_content(data: bytes, rng: Random) -> bytes:
    """Bytes of what is behind the checksums, which are right again."""

    def change(plain: bytes) -> bytes:
        body, xml = bytearray(plain), plain.find(b"<?xml")
        for _ in range(rng.choice((1, 3, 10))):
            body[rng.randrange(xml if rng.random() < 0.5 else 0, len(body))] = rng.randrange(256)
        return bytes(body)

    return e57_changed(data, change) if b"<?xml" in data and len(data) % 1024 == 0 else data


def las_field(data: bytes, rng: Random) -> bytes:
    """A field of the header that says something else."""
    at, form = rng.choice(HEADER)
    value: float = rng.choice(REAL) if form == "<d" else rng.choice(WHOLE) % 2 ** (8 * struct.calcsize(form))
    body = struct.pack(form, value)
    return data[:at] + body + data[at + len(body) :]
