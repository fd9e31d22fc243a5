"""Clouds as text: orders of columns, separators, decimal commas, encodings, languages, count lines, point numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import Scan, points_are, scan

ORDERS = (
    "xyz", "xyzrgb", "xyzirgb", "xyzrgbi", "xyzjrgb", "xyzrgbj", "nxyz", "nxyzrgb", "nxyzirgb", "xyzN", "xyzrgbN",
    "xyzNrgb", "xyzirgbN", "xyzrgbjc", "xyzjrgbc",
)  # fmt: skip
"""Columns: x y z, r g b, i (intensity -2048 to 2047), j (0 to 255), n (point number), N (normal), c (class)."""
HEADINGS = {
    "english": "x;y;z;r;g;b", "german": "Rechtswert;Hochwert;Höhe;Rot;Grün;Blau", "letters": "E;N;H;R;G;B",
    "units": "X [m];Y [m];Z [m];Red;Green;Blue", "french": "Est;Nord;Hauteur;Rouge;Vert;Bleu",
    "spanish": "ESTE;NORTE;ALTURA;ROJO;VERDE;AZUL",
}  # fmt: skip
ENCODINGS = ("utf-8", "utf-8-sig", "cp1252", "utf-16")


def cases() -> Iterator[Case]:
    """Cases of kinds 3 and 11."""
    made = scan()
    for order in ORDERS:
        for counted in (False, True):
            rgb = made.rgb if "r" in order else None
            check = points_are(made.xyz, rgb, coloured="r" in order)
            yield Case(f"text-{order}{'-count' * counted}", 3, _writer(made, order, counted), check=check)
    for language, heading in HEADINGS.items():
        for encoding in ENCODINGS:
            for comma in (False, True):
                name = f"text-{language}-{encoding}{'-comma' * comma}"
                write = _headed(made, heading, encoding, comma)
                yield Case(name, 11, write, check=points_are(made.xyz, made.rgb))
    north = made.xyz[:, [1, 0, 2]]
    says = "northing"
    yield Case("text-north-first", 2, _plain(north), "rejected", f"{says} comes before easting")
    yield Case("text-north-first-axes", 2, _plain(north, "--axes", "neh"), check=points_are(made.xyz))
    yield Case("text-north-first-local", 2, _plain(north, crs="local"), "named", f"{says} before easting")
    words = ["see the report"] * 3 + ["1 2"] * 3
    yield Case("text-no-cloud", 10, _lines(words), "rejected", "column|number|header")


def _writer(made: Scan, order: str, counted: bool) -> Callable[[Path], Sequence[object]]:
    texts = {key: [f"{v:.3f}" for v in values] for key, values in zip("xyz", made.xyz.T, strict=True)}
    texts |= {key: [str(v) for v in values] for key, values in zip("rgb", made.rgb.T, strict=True)}
    texts["i"] = [str(16 * int(v) - 2048) for v in made.intensity]
    texts["j"] = [str(v) for v in made.intensity]
    texts["n"] = [str(i) for i in range(1, len(made.xyz) + 1)]
    texts["c"] = [str(v) for v in made.code]
    random = np.random.default_rng(2)
    normal = made.normal + random.normal(0, 0.05, made.normal.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    texts["N"] = [" ".join(f"{v:.5f}" for v in row) for row in normal]
    rows = [" ".join(cells) for cells in zip(*(texts[key] for key in order), strict=True)]
    return _lines([str(len(rows)), *rows] if counted else rows)


def _headed(made: Scan, heading: str, encoding: str, comma: bool) -> Callable[[Path], Sequence[object]]:
    rows = [
        ";".join([*(f"{v:.3f}" for v in xyz), *(str(v) for v in rgb)])
        for xyz, rgb in zip(made.xyz, made.rgb, strict=True)
    ]
    rows = [row.replace(".", ",") for row in rows] if comma else rows
    return _lines([heading, *rows], "cloud.csv", encoding, "\r\n")


def _plain(xyz: np.ndarray, *options: str, crs: str = "EPSG:32633") -> Callable[[Path], Sequence[object]]:
    return _lines([" ".join(f"{v:.3f}" for v in row) for row in xyz], "cloud.xyz", options=options, crs=crs)


def _lines(
    rows: Sequence[str], name: str = "cloud.txt", encoding: str = "utf-8", end: str = "\n",
    options: Sequence[str] = (), crs: str = "EPSG:32633",
) -> Callable[[Path], Sequence[object]]:  # fmt: skip
    def make(folder: Path) -> Sequence[object]:
        (folder / name).write_bytes((end.join(rows) + end).encode(encoding))
        return ("import", "clouds", folder / name, "--crs", crs, "--out", folder / "tile", *options)

    return make
