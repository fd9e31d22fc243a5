"""PLY, PCD, sweeps and E57: fields in other orders, types and scales, labels of data sets, missing attributes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, points_are, scan
from scan2sim.pipeline.core.types import U8, UNCOLOURED

Make = Callable[[Path], Sequence[object]]
TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u2": "ushort"}
TORONTO = {0: 1, 1: 11, 4: 6, 6: 65, 7: 66}
"""LAS classes of labels of Toronto-3D (unclassified, road, building, pole, car)."""
PARIS = {0: 1, 1: 2, 2: 6, 8: 66, 9: 5}
"""The same of Paris-Lille-3D."""


def cases() -> Iterator[Case]:
    """Cases of kinds 3, 4, 5 and 11."""
    made = scan()
    local = np.round(made.xyz - PLACE, 3)
    columns = {"x": local[:, 0], "y": local[:, 1], "z": local[:, 2]}
    colours = dict(zip(("red", "green", "blue"), made.rgb.T, strict=True))
    for kind in ("f4", "f8"):
        for order in (("x", "y", "z"), ("z", "y", "x")):
            for text in (False, True):
                name = f"ply-{kind}-{''.join(order)}{'-ascii' * text}"
                fields = [(key, kind, columns[key]) for key in order] + [(key, "u1", colours[key]) for key in colours]
                yield Case(name, 3, _ply(fields, text=text), check=points_are(local, made.rgb))
    short = [(key, "f4", columns[key]) for key in columns] + [(key[0], "u1", colours[key]) for key in colours]
    yield Case("ply-r-g-b", 3, _ply(short), check=points_are(local, made.rgb))
    for name, label, extra, mapped in (
        ("toronto", "scalar_Label", ("scalar_Intensity", "scalar_GPSTime", "scalar_ScanAngleRank"), TORONTO),
        ("paris", "class", ("x_origin", "y_origin", "z_origin", "reflectance"), PARIS),
    ):
        labels = np.resize([*mapped], len(local))
        fields = [(key, "f4", columns[key]) for key in columns] + [(key, "f4", columns["x"]) for key in extra]
        codes = np.array([mapped[one] for one in labels.tolist()], np.uint8)
        check = points_are(local, code=codes)
        yield Case(f"ply-labels-{name}", 3, _ply([*fields, (label, "i4", labels)]), check=check)
    strange = np.resize([2, 6, -1, 300], len(local))
    fields = [(key, "f4", columns[key]) for key in columns]
    says = "no LAS codes"
    yield Case("ply-labels-strange", 3, _ply([*fields, ("label", "i4", strange)]), "named", says, points_are(local))
    for data in ("ascii", "binary", "stored"):
        for names in (("x", "y", "z"), ("X", "Y", "Z")):
            for padded in (False, True):
                name = f"pcd-{data}-{names[0]}{'-padded' * padded}"
                yield Case(name, 11, _pcd(local.astype("<f4"), names, data, padded), check=points_are(local))
    some_grey = made.rgb.copy()
    some_grey[len(some_grey) // 2 :] = UNCOLOURED
    for grey_first in (True, False):
        name = f"e57-mixed-{'grey' if grey_first else 'colour'}-first"
        yield Case(name, 5, _e57(local, made.rgb, grey_first), "named", "have no colour", points_are(local, some_grey))


def _import(path: Path) -> Sequence[object]:
    return ("import", "clouds", path, "--crs", "local", "--out", path.parent / "tile")


def _ply(fields: Sequence[tuple[str, str, Any]], *, text: bool = False) -> Make:
    def make(folder: Path) -> Sequence[object]:
        rows = np.zeros(len(fields[0][2]), [(name, f"<{kind}") for name, kind, _ in fields])
        for name, _, values in fields:
            rows[name] = values
        head = "".join(f"property {TYPES[kind]} {name}\n" for name, kind, _ in fields)
        form = "ascii" if text else "binary_little_endian"
        head = f"ply\nformat {form} 1.0\nelement vertex {len(rows)}\n{head}end_header\n"
        lines = "".join(
            " ".join(f"{value:g}" if value == int(value) else f"{value:.4f}" for value in row) + "\n"
            for row in rows.tolist()
        )
        (folder / "cloud.ply").write_bytes(head.encode() + (lines.encode() if text else rows.tobytes()))
        return _import(folder / "cloud.ply")

    return make


def _pcd(xyz: Any, names: Sequence[str], data: str, padded: bool) -> Make:
    """`data`: "stored" is binary_compressed with a block that wasn't compressed; padded with fields of COUNT 0."""

    def make(folder: Path) -> Sequence[object]:
        fields, sizes, types, counts = [*names], ["4"] * 3, ["F"] * 3, ["1"] * 3
        if padded:
            for row, value in ((fields, "_"), (sizes, "1"), (types, "U"), (counts, "0")):
                row.insert(1, value)
        kind = {"ascii": "ascii", "binary": "binary", "stored": "binary_compressed"}[data]
        head = "".join(
            f"{key} {' '.join(row)}\n"
            for key, row in (("FIELDS", fields), ("SIZE", sizes), ("TYPE", types), ("COUNT", counts))
        )
        head += f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA {kind}\n"
        head = f"# .PCD v0.7\nVERSION 0.7\n{head}"
        body = xyz.tobytes()
        if data == "ascii":
            body = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in xyz.tolist()).encode()
        elif data == "stored":
            body = struct.pack("<II", len(body), len(body)) + xyz.T.tobytes()
        (folder / "cloud.pcd").write_bytes(head.encode() + body)
        return _import(folder / "cloud.pcd")

    return make


def _e57(xyz: Any, rgb: U8, grey_first: bool) -> Make:
    """Two scans, one coloured, one with intensities only."""

    def make(folder: Path) -> Sequence[object]:
        import pye57

        half = len(xyz) // 2
        coloured = {f"color{name}": column[:half] for name, column in zip(("Red", "Green", "Blue"), rgb.T, strict=True)}
        scans = [
            (xyz[:half], coloured),
            (xyz[half:], {"intensity": np.linspace(0, 1, len(xyz) - half).astype(np.float32)}),
        ]
        file = pye57.E57(str(folder / "cloud.e57"), mode="w")
        for points, fields in reversed(scans) if grey_first else scans:
            data = {f"cartesian{axis}": points[:, k] for k, axis in enumerate("XYZ")} | fields
            file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3))
        file.close()
        return _import(folder / "cloud.e57")

    return make
