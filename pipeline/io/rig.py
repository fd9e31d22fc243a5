"""A rig of cameras: a folder with `rig.toml` and a folder of photos for each camera, named by its id.

`rig.toml` has a table `[[cameras]]` for each camera: id, model, size, focal, centre and distortion as in a tile.toml,
and `T_camera_scanner`, three rows of four numbers: scanner axes to camera axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.io import file_checks, toml
from scan2sim.pipeline.io.images.image import SUFFIXES
from scan2sim.pipeline.io.tile import CameraEntry, camera_entry, camera_of

RIG = "rig.toml"
REMEDY = "docs/reference/formats.md describes rig.toml"
Row = tuple[float, float, float, float]


@dataclass(frozen=True)
class RigCamera:
    """A camera of a rig: id, intrinsics, and T_camera_scanner (4, 4)."""

    id: str
    camera: Camera
    T_camera_scanner: F64


class _Entry(CameraEntry):
    T_camera_scanner: tuple[Row, Row, Row]


class _RigFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    cameras: Annotated[tuple[_Entry, ...], Field(min_length=1)]


def read_rig(folder: Path) -> list[RigCamera]:
    """Cameras of a rig's folder.

    Raises:
        InputError: its `rig.toml` is missing or invalid.
    """
    path = folder / RIG
    rig = toml.read(path, _RigFile, absent=("file not found", "Check the path"), fields=REMEDY)
    found = []
    for entry in rig.cameras:
        T = np.eye(4)
        T[:3] = entry.T_camera_scanner
        R = T[:3, :3]
        if not np.isfinite(T).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise InputError(path, f"T_camera_scanner of {entry.id!r} is not a rigid transform", REMEDY)
        if not entry.id or entry.id != Path(entry.id).name:
            raise InputError(path, f"the id {entry.id!r} is not the name of a folder", REMEDY)
        found.append(RigCamera(entry.id, camera_of(path, entry), T))
    return found


def masks_of_rig(path: Path | None, ids: list[str]) -> dict[str, Path]:
    """Ego-vehicle masks of a rig's cameras by id.

    Args:
        path: the mask of the only camera, or a folder of masks that are named by the cameras (front.png); None: none.
        ids: the cameras.

    Raises:
        InputError: one mask for several cameras, or a mask of none of them.
    """
    if path is None:
        return {}
    cameras = ", ".join(ids)
    if not path.is_dir():
        if len(ids) > 1:
            remedy = f"Give a folder of masks named by camera, such as {ids[0]}.png"
            raise InputError(path, f"is one mask for several cameras ({cameras})", remedy)
        return {ids[0]: path}
    masks = {file.stem: file for file in file_checks.files(path) if file.suffix.lower() in SUFFIXES}
    if not masks or not masks.keys() <= set(ids):
        cause = f"has the masks {', '.join(masks) or 'none'}, but the cameras are {cameras}"
        raise InputError(path, cause, f"Name each mask after its camera, such as {ids[0]}.png")
    return masks


def write_rig(folder: Path, cameras: Iterable[RigCamera]) -> Path:
    """Write `rig.toml` into a folder and return its path."""
    import tomli_w

    entries = [
        camera_entry(one.id, one.camera) | {"T_camera_scanner": one.T_camera_scanner[:3].tolist()} for one in cameras
    ]
    path = folder / RIG
    path.write_text(tomli_w.dumps({"cameras": entries}), encoding="utf-8")
    return path
