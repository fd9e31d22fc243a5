"""PLY clouds, through trimesh (vertices, colours; float64 coordinates kept)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.errors import InputError
from scan2sim.pipeline.types import F64, Frame, PointCloud


def _load(path: Path) -> Any:
    import trimesh

    try:
        loaded: Any = trimesh.load(path, process=False)
        if len(loaded.vertices) == 0:
            raise ValueError("no vertices")
        return loaded
    except FileNotFoundError:
        raise InputError(path, "is missing", "Put it there, or mend the name") from None
    except Exception as error:  # trimesh's parsers raise whatever the damage leads to
        raise InputError(path, f"is no readable PLY cloud ({error})", "Export it again, or as LAZ") from None


def read_header(path: Path) -> tuple[int, F64, F64, str | None]:
    """Number of points, low and high corner (CRS units); PLY has no CRS."""
    xyz = np.asarray(_load(path).vertices, np.float64)
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    if len(xyz) == 0:
        raise InputError(path, "holds no point with finite coordinates", "Export it again, or as LAZ")
    return len(xyz), xyz.min(axis=0), xyz.max(axis=0), None


def read(path: Path, frame: Frame) -> PointCloud:
    """Read vertices into local coordinates, with colours and a `class`, `label` or `classification` property."""
    loaded = _load(path)
    xyz = frame.to_local(loaded.vertices).astype(np.float32)
    colours = getattr(loaded, "colors", None)
    if colours is None and getattr(loaded.visual, "kind", None) == "vertex":
        colours = loaded.visual.vertex_colors
    rgb = np.asarray(colours, np.uint8)[:, :3] if colours is not None and len(colours) == len(xyz) else None
    data = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    fields = getattr(getattr(data, "dtype", None), "names", None) or ()
    names = data if isinstance(data, dict) else fields  # trimesh gives ASCII as a dict
    label = next(
        (np.asarray(data[n]).ravel().astype(np.uint8) for n in ("classification", "class", "label") if n in names), None
    )
    return PointCloud(frame, xyz, rgb, label=label)


def chunks(path: Path, frame: Frame, size: int) -> Iterator[PointCloud]:
    """All points at once: PLY is read as a whole."""
    _, low, high, _ = read_header(path)
    x, y, z = np.floor((low + high) / 2 * frame.unit).tolist()
    yield read(path, replace(frame, origin=(x, y, z)))
