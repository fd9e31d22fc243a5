"""Posed photos as JSON (`views.json`): what steps hand on of a tile's views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import Camera, View

CAMERA_FIELDS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")


def to_json(view: View, *, with_paths: bool = True) -> dict[str, Any]:
    """A view as JSON-able values; without paths, `photo` and `mask` are file names alone."""

    def place(path: Path | None) -> str | None:
        return None if path is None else (str(path) if with_paths else path.name)

    return {
        "name": view.name,
        "camera": {name: getattr(view.camera, name) for name in CAMERA_FIELDS},
        "T_world_cam": np.asarray(view.T_world_cam, np.float64).tolist(),
        "photo": place(view.photo),
        "mask": place(view.mask),
        "time": view.time,
    }


def from_json(entry: dict[str, Any]) -> View:
    """What `to_json` made of a view."""
    camera = dict(entry["camera"], distortion=tuple(entry["camera"]["distortion"]))
    return View(
        name=entry["name"],
        camera=Camera(**camera),
        T_world_cam=np.array(entry["T_world_cam"], np.float64),
        photo=Path(entry["photo"]),
        mask=Path(entry["mask"]) if entry.get("mask") else None,
        time=entry.get("time"),
    )


def linked(view: View, folder: Path, index: int) -> View:
    """The view with links in `folder`, for its photo and mask: relative ones, as a file beside them names them."""

    def link(file: Path, where: str) -> Path:
        (folder / where).mkdir(exist_ok=True)
        at = folder / where / f"{index:05d}_{file.name}"
        at.symlink_to(file.resolve())
        return at.relative_to(folder)

    return replace(view, photo=link(view.photo, "photos"), mask=link(view.mask, "masks") if view.mask else None)


def save(path: Path, views: Sequence[View], held_out: Sequence[bool] = ()) -> None:
    """Write views, and which of them are held out of texturing (none by default)."""
    held = list(held_out) or [False] * len(views)
    rows = [to_json(view) | {"hold_out": bool(out)} for view, out in zip(views, held, strict=True)]
    path.write_text(json.dumps(rows, indent=1, default=np.generic.item), encoding="utf-8")


def load(path: Path) -> tuple[View, ...]:
    """Read the views that `save` wrote, in order; relative photos are beside the file, links are followed."""

    def place(file: Path) -> Path:
        return (path.parent / file).resolve()

    views = (from_json(row) for row in _rows(path))
    return tuple(replace(v, photo=place(v.photo), mask=place(v.mask) if v.mask else None) for v in views)


def load_held_out(path: Path) -> tuple[bool, ...]:
    """Read which of the views are held out of texturing, in the views' order."""
    return tuple(bool(row["hold_out"]) for row in _rows(path))


def _rows(path: Path) -> list[dict[str, Any]]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(path, f"is no list of views ({error})", "Run again with `--from views`") from None
