"""Posed photos as JSON (`views.json`), the form in which steps pass on a tile's views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Camera, View
from scan2sim.pipeline.io.file_checks import symlink_or_copy

CAMERA_FIELDS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")


def to_json(view: View, *, with_paths: bool = True) -> dict[str, Any]:
    """A view as JSON values; without paths, `photo` and `mask` are bare file names."""

    def location(path: Path | None) -> str | None:
        return None if path is None else (str(path) if with_paths else path.name)

    return {
        "name": view.name,
        "camera": {name: getattr(view.camera, name) for name in CAMERA_FIELDS},
        "T_world_cam": np.asarray(view.T_world_cam, np.float64).tolist(),
        "photo": location(view.photo),
        "mask": location(view.mask),
        "time": view.time,
    }


def from_json(entry: dict[str, Any]) -> View:
    """The view that `to_json` converted."""
    camera = dict(entry["camera"], distortion=tuple(entry["camera"]["distortion"]))
    return View(
        name=entry["name"],
        camera=Camera(**camera),
        T_world_cam=np.array(entry["T_world_cam"], np.float64),
        photo=Path(entry["photo"]),
        mask=Path(entry["mask"]) if entry.get("mask") else None,
        time=entry.get("time"),
    )


def with_links(view: View, folder: Path, index: int) -> View:
    """The view with its photo and mask linked into `folder`, to which its paths are relative."""

    def link(file: Path, subfolder: str) -> Path:
        (folder / subfolder).mkdir(exist_ok=True)
        target = folder / subfolder / f"{index:05d}_{file.name}"
        symlink_or_copy(file, target)
        return target.relative_to(folder)

    return replace(view, photo=link(view.photo, "photos"), mask=link(view.mask, "masks") if view.mask else None)


def save_linked(out: Path, views: Sequence[View], held_out: Sequence[bool]) -> dict[str, Path]:
    """Write the outputs of a step that passes on views: `views`, with links to photos and masks, and `cameras`.

    Steps that need poses and lenses alone read `cameras`: it stays the same when a photo changes.

    Args:
        out: the step's output folder.
        views: photos below `out/views` stay where they are, others are linked into it.
        held_out: as in `save`.
    """
    folder = out / "views"
    folder.mkdir(exist_ok=True)
    linked = [
        replace(view, photo=view.photo.relative_to(folder))
        if view.photo.is_relative_to(folder)
        else with_links(view, folder, i)
        for i, view in enumerate(views)
    ]
    save(folder / "views.json", linked, held_out)
    save(out / "cameras.json", [replace(view, photo=Path(view.photo.name), mask=None) for view in linked], held_out)
    return {"views": folder, "cameras": out / "cameras.json"}


def save(path: Path, views: Sequence[View], held_out: Sequence[bool] = ()) -> None:
    """Write views, and which of them are held out from texturing (default: none)."""
    held = list(held_out) or [False] * len(views)
    rows = [to_json(view) | {"hold_out": bool(out)} for view, out in zip(views, held, strict=True)]
    path.write_text(json.dumps(rows, indent=1, default=np.generic.item), encoding="utf-8")


def load(path: Path) -> tuple[View, ...]:
    """Read the views that `save` or `save_linked` wrote, in order, from the file or its folder.

    Photo paths are relative to the file, links are followed.
    """
    folder = path if path.is_dir() else path.parent

    def absolute(file: Path) -> Path:
        return (folder / file).resolve()

    views = (from_json(row) for row in _rows(path))
    return tuple(replace(v, photo=absolute(v.photo), mask=absolute(v.mask) if v.mask else None) for v in views)


def load_held_out(path: Path) -> tuple[bool, ...]:
    """Whether each view is held out from texturing, in order."""
    return tuple(bool(row["hold_out"]) for row in _rows(path))


def _rows(path: Path) -> list[dict[str, Any]]:
    path = path / "views.json" if path.is_dir() else path
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(path, f"is not a list of views ({error})", "Run again with `--from views`") from None
