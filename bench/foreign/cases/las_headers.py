"""LAS files: georeference in GeoTIFF keys and WKT, units, axes, areas of use, flags of points."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import laspy
import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, points_are, scan
from scan2sim.pipeline.core.types import F64, Bools

FOOT = 1200 / 3937
TACOMA = np.array([1_160_000.0, 700_000.0, 300.0])
"""US survey feet in EPSG:2927; metres after scaling in EPSG:32149 (Washington South)."""
Make = Callable[[Path], Sequence[object]]


def cases() -> Iterator[Case]:
    """Cases of kinds 2 and 4."""
    made = scan()
    here, feet = made.xyz, made.xyz - PLACE + TACOMA
    right, right_feet = points_are(here), points_are(here - PLACE + TACOMA, place=TACOMA)
    projected = {1024: 1, 3072: 32633}
    yield Case("las-keys", 2, _las(here, projected), check=right)
    yield Case("las-feet-keys", 2, _las(feet, {1024: 1, 3072: 32149, 3076: 9003, 4099: 9003}), check=right_feet)
    yield Case("las-feet-no-keys", 2, _las(feet, {1024: 1, 3072: 32149}), "rejected", "--units us-ft")
    yield Case("las-feet-given", 2, _las(feet, {1024: 1, 3072: 32149}, "--units", "us-ft"), check=right_feet)
    yield Case("las-height-feet", 2, _las(here, projected | {4099: 9003}), "rejected", "heights in units of")
    yield Case("las-degrees-over-metres", 2, _las(here, {1024: 2, 2048: 4326}), "rejected", "has degrees")
    given = ("--crs", "EPSG:32633")
    yield Case("las-degrees-given", 2, _las(here, {1024: 2, 2048: 4326}, *given), "named", "EPSG:32633 is used")
    for name, wkt in (
        ("quotes", b"''\0"),
        ("cut", b'PROJCS["unfinished'),
        ("text", b"see the readme"),
        ("bytes", b"\xff\xfe\0"),
    ):
        yield Case(f"las-wkt-{name}", 2, _las(here, wkt=wkt), "rejected", "--crs")
        yield Case(f"las-wkt-{name}-given", 2, _las(here, None, *given, wkt=wkt), check=right)
    yield Case("las-north-first", 2, _las(here[:, [1, 0, 2]], projected), "rejected", "--axes neh")
    yield Case("las-north-first-given", 2, _las(here[:, [1, 0, 2]], projected, "--axes", "neh"), check=right)
    yield Case("las-zone-prefix", 2, _las(here + [33e6, 0, 0], projected), "rejected", "zone number 33")
    zone_4 = here - PLACE + (4_589_000.0, 5_820_000.0, 35.0)
    yield Case("las-zone-off", 2, _las(zone_4, {1024: 1, 3072: 31467}), "rejected", "area of use|zone")
    yield Case("las-local", 2, _las(here - PLACE, projected), "rejected", "--crs local")
    yield Case("las-no-crs", 2, _las(here), "rejected", "has no CRS")
    yield Case("las-no-crs-local", 2, _las(here, None, "--crs", "local"), check=right)
    for version, suffix in ((3, ".las"), (3, ".laz"), (7, ".las"), (7, ".laz")):
        withheld = np.arange(len(here)) % 10 == 0
        noise = here - withheld[:, None] * (0, 0, 100.0)
        make = _las(noise, projected, withheld=withheld, point_format=version, suffix=suffix)
        check = points_are(here[~withheld], among=True)
        yield Case(f"las-withheld-{version}{suffix}", 4, make, "named", "withheld points are not used", check)
    every = np.ones(len(here), bool)
    yield Case("las-all-withheld", 4, _las(here, projected, withheld=every), "rejected", "withheld")


def _las(
    xyz: F64, keys: Mapping[int, int] | None = None, *options: str, wkt: bytes | None = None,
    withheld: Bools | None = None, point_format: int = 3, suffix: str = ".las",
) -> Make:  # fmt: skip
    """A LAS file with GeoTIFF keys or the content of a WKT record."""

    def make(folder: Path) -> Sequence[object]:
        later = wkt is not None or point_format > 5
        header = laspy.LasHeader(version="1.4" if later else "1.2", point_format=max(point_format, 6 if wkt else 0))
        header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.mean(axis=0))
        if keys:
            directory = struct.pack("<4H", 1, 1, 0, len(keys))
            directory += b"".join(struct.pack("<4H", key, 0, 1, value) for key, value in sorted(keys.items()))
            header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", directory))
        if wkt is not None:
            header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt))
        data = laspy.LasData(header)
        data.x, data.y, data.z = xyz.T
        if withheld is not None:
            data.withheld = withheld
        data.write(folder / f"cloud{suffix}")
        return ("import", "clouds", folder / f"cloud{suffix}", "--out", folder / "tile", *options)

    return make
