"""Tables of photos: separators, decimal commas, encodings, paths of other systems, extra columns, sizes of photos."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.foreign.case import Case
from bench.foreign.scan import PLACE, scan

HEAD = "file,x,y,z,qw,qx,qy,qz,model,width,height,fx,cx,cy,k1"
NAMES = ("Straße_1.jpg", "Straße_2.jpg", "Straße_3.jpg")
WIDTH, HEIGHT, FOCAL = 160, 120, 125.5


@dataclass(frozen=True)
class Habit:
    """How a table is written."""

    separator: str = ","
    comma: bool = False
    head: str = HEAD
    end: str = "\n"
    encoding: str = "utf-8"
    path: Callable[[str], str] = "photos/{}".format
    scale: float = 1.0
    orientation: int = 1
    extra: bool = False


HABITS: dict[str, Habit] = {
    "plain": Habit(),
    "byte-order-mark": Habit(end="\r\n", encoding="utf-8-sig"),
    "semicolons": Habit(";"),
    "german-excel": Habit(";", comma=True, end="\r\n", encoding="cp1252"),
    "tabs-commas": Habit("\t", comma=True),
    "utf-16": Habit("\t", end="\r\n", encoding="utf-16"),
    "capitals": Habit(head=HEAD.upper()),
    "title-case": Habit(head=HEAD.title()),
    "german-headings": Habit(head=HEAD.replace("file,x,y,z", "Dateiname,Rechtswert,Hochwert,Höhe"), encoding="cp1252"),
    "backslashes": Habit(path="photos\\{}".format),
    "drive": Habit(path="D:\\Projekt Süd\\photos\\{}".format, encoding="cp1252"),
    "other-case": Habit(path=lambda name: f"Photos/{name.upper()}"),
    "nfd": Habit(path=lambda name: unicodedata.normalize("NFD", f"photos/{name}")),
    "names-only": Habit(path="{}".format),
    "trailing-commas": Habit(end=",,\n"),
    "half-size": Habit(scale=0.5),
    "double-size": Habit(scale=2.0),
}


def cases() -> Iterator[Case]:
    """Cases of kinds 4 and 11."""
    for name, habit in HABITS.items():
        yield Case(f"photos-{name}", 11, _table(habit), check=_photos_are(habit.scale))
    yield Case("photos-extra-column", 11, _table(Habit(extra=True)), "named", "accuracy_m")
    yield Case("photos-misspelled", 11, _table(Habit(head=HEAD.replace("width", "widht"))), "rejected", "widht.*width")
    yield Case("photos-commas-in-commas", 11, _table(Habit(comma=True)), "rejected", "cells, but 15 columns")
    for turn in (3, 6, 8):
        yield Case(f"photos-exif-{turn}", 4, _table(Habit(orientation=turn)), "named", "EXIF orientation")


def _positions() -> np.ndarray:
    return PLACE + [(-2.0, 0.0, 1.5), (-1.0, 0.25, 1.5), (0.0, 0.5, 1.5)]


def _table(habit: Habit) -> Callable[[Path], Sequence[object]]:
    def make(folder: Path) -> Sequence[object]:
        _write_cloud(folder / "cloud.xyz")
        _write_photos(folder / "photos", habit)
        rows = [habit.head.split(",") + ["accuracy_m"] * habit.extra]
        for name, position in zip(NAMES, _positions(), strict=True):
            numbers = [f"{v:.3f}" for v in position]
            quaternion = ["0.5", "-0.5", "0.5", "-0.5"]  # looks along x
            camera = [str(WIDTH), str(HEIGHT), str(FOCAL), "79.5", "59.5", "-0.0625"]
            cells = [*numbers, *quaternion, "opencv", *camera] + ["0.02"] * habit.extra
            if habit.comma:
                cells = [cell.replace(".", ",") for cell in cells]
            rows.append([habit.path(name), *cells])
        text = habit.end.join(habit.separator.join(row) for row in rows) + habit.end
        (folder / "photos.csv").write_bytes(text.encode(habit.encoding))
        where = ("--crs", "EPSG:32633", "--out", folder / "tile")
        return ("import", "clouds", folder / "cloud.xyz", "--photos", folder / "photos.csv", *where)

    return make


def _write_cloud(path: Path) -> None:
    made = scan()
    rows = [
        " ".join([*(f"{v:.3f}" for v in xyz), *map(str, rgb)])
        for xyz, rgb in zip(made.xyz, made.rgb.tolist(), strict=True)
    ]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _write_photos(folder: Path, habit: Habit) -> None:
    from PIL import Image

    folder.mkdir()
    size = round(WIDTH * habit.scale), round(HEIGHT * habit.scale)
    for i, name in enumerate(NAMES):
        shades = np.random.default_rng(i).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
        image = Image.fromarray(shades)
        exif = image.getexif()
        exif[274] = habit.orientation
        image.save(folder / name, exif=exif)


def _photos_are(scale: float) -> Callable[[Path], str]:
    """A check: the tile has the photos with their poses, and a camera of their size."""

    def check(folder: Path) -> str:
        from scan2sim.pipeline.io.tile import read_tile

        tile = read_tile(folder / "tile")
        if [view.photo.name for view in tile.views] != list(NAMES):
            return f"other photos: {[view.photo.name for view in tile.views]}"
        if any(view.photo.parent != folder / "tile" / "photos" for view in tile.views):
            return f"photos in {tile.views[0].photo.parent}"
        for view, position in zip(tile.views, _positions(), strict=True):
            centre = tile.frame.to_crs(view.T_world_cam[None, :3, 3])[0]
            if np.abs(centre - position).max() > 2e-3 or abs(view.T_world_cam[0, 2] - 1) > 1e-6:
                return "other poses"
            if view.camera.width != round(WIDTH * scale) or abs(view.camera.fx - FOCAL * scale) > 1e-6:
                return "another camera"
        return ""

    return check
