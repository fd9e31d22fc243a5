"""Training labels for the detector from the lidar of a drive: 3D boxes of vehicles projected into its photos.

Parked vehicles are those of the tile's step `instances`; moving ones are clusters of the points that step
`dynamic_objects` removed, of the moment of the photo. The share of a box that is visible follows from the depth of the
cloud. What the lidar can't decide is ignored in training: distant regions, people, rows of vehicles, pixels that the
segmentation network classifies as vehicles where the lidar has none, and what was scanned only for a moment and has a
vehicle's size. Everything else teaches what no vehicle is.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import CODE, group_of
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F32, F64, U8, Bools, PointCloud, View
from scan2sim.pipeline.geometry.voxel_grid import sample, voxel_groups
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.segmentation.labels import CLASSES as PIXEL_CLASSES

CLASS_OF_KIND = {"car": "car", "part": "car", "van": "van", "truck": "truck"}
"""Class of the detector by kind of a vehicle of step `instances`; other kinds are ignored."""
MOMENT_S = 0.06
"""Maximum time between a photo and the returns of the moving objects in it: half a revolution of a lidar at 10 Hz."""
CELL_PX = 8
"""Side of the cells in which depth and the ignored regions are computed, pixels."""
VOXEL_M = 0.15
"""Voxel size at which the cloud is projected."""
OCCLUDER_GAP_M = 0.5
"""Distance before the front of a box from which points occlude it."""
MAX_DISTANCE_M = 45.0
"""Distance up to which the lidar finds vehicles reliably; beyond it photos are ignored where nothing is nearer."""
NEARER_SHARE = 0.75
"""Part of this distance from which a cell shows nothing nearer: its ground may be before a distant vehicle."""
BAND_M = (-1.5, 4.5)
"""Heights above the ground between which distant vehicles appear."""
CORNER_CUT_M, SILL_M = 0.4, 0.1
"""Rounding of a body's corners in plan, and height of its lower edge, metres."""
ROOF_LENGTH, ROOF_WIDTH, BONNET_HEIGHT = 0.6, 0.8, 0.6
"""Size of a car's roof relative to the car, and height from which it narrows."""
MIN_CLUSTER_POINTS = 15
"""Fewest returns of a moving vehicle."""
UNEXPLAINED_MIN_CELLS = 2
"""Smallest region of pixels classified as vehicle that is ignored, in cells."""
BRIEF_VOXEL_M, BRIEF_MAX_S = 0.4, 0.3
"""Voxels whose returns all lie within this time may belong to a moving object that was not removed."""
BRIEF_BAND_M = (0.3, 3.0)
"""Heights above the ground of such returns."""
NEAREST_M = 0.5
"""Depth from which points count."""


@dataclass(frozen=True)
class Box:
    """A vehicle: class of the detector (None: ignored), and its corners (8, 3) in local metres."""

    label: str | None
    corners: F64

    def outline(self) -> F64:
        """(N, 3) points with the bounding box of the vehicle in a photo: bodies are rounded, roofs of cars smaller."""
        floor, height = self.corners[:4], self.corners[4, 2] - self.corners[0, 2]
        sides = floor[[1, 2, 3, 0]] - floor
        lengths = np.maximum(np.linalg.norm(sides, axis=1), 1e-6)
        cut = sides * np.minimum(0.25, CORNER_CUT_M / lengths)[:, None]
        lower, up = np.concatenate([floor + cut, floor[[1, 2, 3, 0]] - cut]), np.array([0.0, 0.0, height])
        sill = lower + [0, 0, SILL_M]
        if self.label != "car":
            return np.concatenate([sill, lower + up])
        shares = np.where(lengths[:2] >= lengths[:2].max(), ROOF_LENGTH, ROOF_WIDTH)
        along, across = sides[:2] * shares[:, None] / 2
        roof = floor.mean(axis=0) + [a * along + b * across for a in (-1, 1) for b in (-1, 1)]
        return np.concatenate([sill, lower + BONNET_HEIGHT * up, roof + up])


@dataclass(frozen=True)
class Drive:
    """A tile with the results of its steps up to `instances`.

    Attributes:
        name: prefix of the images' names.
        views: photos.
        cloud: classified static points.
        moving: points of moving objects.
        parked: boxes of vehicles and people of step `instances`.
        labels: folder with class probabilities per pixel, `<view index>.npy`, of step `label`; None without photos.
    """

    name: str
    views: Sequence[View]
    cloud: PointCloud
    moving: PointCloud
    parked: Sequence[Box]
    labels: Path | None


def write(drives: Sequence[Drive], names: Sequence[str], out: Path, report: Report = silent) -> dict[str, int]:
    """Write the labelled photos of drives as a dataset (`detector.dataset`); returns numbers of images and boxes.

    Args:
        drives: drives to label.
        names: classes of the detector.
        out: folder of the dataset; an existing one is replaced.
        report: progress callback.
    """
    (out / "images").mkdir(parents=True, exist_ok=True)
    lines, learned = [], 0
    total = sum(len(drive.views) for drive in drives)
    for drive in drives:
        for name, objects, photo in labelled_photos(drive):
            file = out / "images" / name
            file.unlink(missing_ok=True)
            link_or_copy(photo, file)
            lines.append(json.dumps({"image": name, "objects": objects}) + "\n")
            learned += sum(one["visible"] > 0 for one in objects)
            report(len(lines) / max(total, 1), name)
    (out / "classes.json").write_text(json.dumps(list(names)), encoding="utf-8")
    (out / "boxes.jsonl").write_text("".join(lines), encoding="utf-8")
    return {"images": len(lines), "boxes": learned}


def labelled_photos(drive: Drive) -> Iterator[tuple[str, list[dict[str, Any]], Path]]:
    """Name, objects and file of each photo; objects with a visible share of 0 are to be ignored."""
    assert drive.cloud.classification is not None
    thin = sample(drive.cloud, VOXEL_M)
    assert thin.classification is not None
    ground = group_of()[thin.classification] == group_of()[CODE["terrain"]]
    brief = brief_points(drive.cloud)
    for i, view in enumerate(drive.views):
        if view.camera.model in ("equirectangular", "orthographic"):
            continue
        probabilities = drive.labels / f"{i}.npy" if drive.labels else None
        pixels = np.load(probabilities) if probabilities and probabilities.is_file() else None
        name = f"{drive.name}_{i:05d}{view.photo.suffix}"
        yield name, objects_in(view, drive, thin, ground, brief, pixels), view.photo


def objects_in(
    view: View, drive: Drive, thin: PointCloud, ground: Bools, brief: PointCloud, pixels: U8 | None
) -> list[dict[str, Any]]:
    """Objects of a photo in the form of `boxes.jsonl`.

    Args:
        view: the photo.
        drive: its drive.
        thin: cloud of the drive, sampled.
        ground: (N,) whether each of its points is ground.
        brief: its points that may have moved.
        pixels: (h, w, C) class probabilities of the photo, or None.
    """
    floor = _ground_z(thin, ground, view)
    passing, doubted = at_time(drive.moving, view.time), at_time(brief, view.time)
    height = doubted[:, 2] - floor
    doubted = doubted[(height > BRIEF_BAND_M[0]) & (height < BRIEF_BAND_M[1])]
    boxes = [*drive.parked, *moving_boxes(passing, floor)]
    boxes += [Box(None, one.corners) for one in moving_boxes(doubted, floor) if one.label]
    above = np.concatenate([thin.xyz[~ground], passing])
    depth, first = depth_cells(view, above), depth_cells(view, np.concatenate([above, thin.xyz[ground]]))
    out: list[dict[str, Any]] = []
    explained = np.zeros(depth.shape, bool)
    for box in boxes:
        projected = box_in_image(view, box.outline())
        if projected is None:
            continue
        corners, nearest = projected
        share = _visible_share(depth, corners, nearest)
        explained[_cells(corners, depth.shape, margin=1)] = True
        is_known = box.label is not None and nearest < MAX_DISTANCE_M
        out.append(_entry(box.label or "car", corners, share if is_known else 0.0))
    doubtful = _distant(view, first, floor)
    if pixels is not None:
        doubtful |= _movable_pixels(pixels, depth.shape) & ~explained
    for row, start, end in runs(doubtful):
        x0, x1, y0 = start * CELL_PX, min(end * CELL_PX, view.camera.width), row * CELL_PX
        out.append(_entry("car", np.array([x0, y0, x1, min(y0 + CELL_PX, view.camera.height)]), 0.0))
    return out


def parked_boxes(geojson: Path, cloud: PointCloud) -> list[Box]:
    """Boxes of the instances that step `instances` wrote; those that moved are left to `moving_boxes`."""
    boxes = []
    for feature in json.loads(geojson.read_text(encoding="utf-8"))["features"]:
        properties = feature["properties"]
        if properties["moved"]:
            continue
        ring = np.array(feature["geometry"]["coordinates"][0][:4])
        floor = cloud.frame.to_local(np.column_stack([ring, np.full(4, properties["ground_z"])]))
        label = CLASS_OF_KIND.get(properties["kind"])
        boxes.append(Box(label, np.concatenate([floor, floor + [0, 0, properties["height_m"]]])))
    return boxes


def at_time(cloud: PointCloud, time: float | None) -> F32:
    """(N, 3) points that were scanned at the time of a photo; none if the times are unknown."""
    if time is None or cloud.time is None or not len(cloud):
        return np.zeros((0, 3), np.float32)
    return cloud.xyz[np.abs(cloud.time - time) < MOMENT_S]


def brief_points(cloud: PointCloud) -> PointCloud:
    """Points above the ground in voxels that were scanned for a moment only; none if the times are unknown."""
    if cloud.time is None or cloud.classification is None:
        return cloud.take(slice(0))
    above = cloud.take(group_of()[cloud.classification] != group_of()[CODE["terrain"]])
    if above.time is None or not len(above):
        return above
    order, starts = voxel_groups(above.xyz, BRIEF_VOXEL_M)
    times = above.time[order]
    spread = np.maximum.reduceat(times, starts) - np.minimum.reduceat(times, starts)
    counts = np.diff(np.append(starts, len(order)))
    return above.take(np.sort(order[np.repeat(spread < BRIEF_MAX_S, counts)]))


def moving_boxes(xyz: F32, ground_z: float) -> list[Box]:
    """Boxes of the moving vehicles of a moment; clusters of another size are ignored."""
    from scan2sim.segmentation import vehicle_boxes

    boxes = []
    for index in vehicle_boxes.clusters(xyz, np.ones(len(xyz), bool)):
        points = xyz[index]
        bottom, top = min(ground_z, float(points[:, 2].min())), float(points[:, 2].max())
        plan = vehicle_boxes.fit_rectangle(points[:, :2])
        kind = _kind(plan.length, plan.width, top - bottom) if len(index) >= MIN_CLUSTER_POINTS else None
        floor = np.column_stack([plan.corners, np.full(4, bottom)])
        boxes.append(Box(kind, np.concatenate([floor, floor + [0, 0, top - bottom]])))
    return boxes


def _kind(length: float, width: float, height: float) -> str | None:
    """Class of a moving box: of one sweep only the side towards the scanner is known, so its length may be short."""
    from scan2sim.segmentation.vehicle_boxes import KINDS

    for kind in KINDS:
        if kind.height[0] - 0.2 < height < kind.height[1] and 1.2 < length < kind.length[1] and width < kind.width[1]:
            return CLASS_OF_KIND[kind.name]
    return None


def box_in_image(view: View, outline: F64) -> tuple[F64, float] | None:
    """Bounding box x0, y0, x1, y1 in pixels, clipped to the image, and smallest depth; None outside the image.

    Args:
        view: the photo.
        outline: (N, 3) points of the object's hull, local metres.
    """
    from scan2sim.pipeline.camera.models import project

    T = np.linalg.inv(view.T_world_cam)
    a, b = np.triu_indices(len(outline), 1)  # lines between points, as a part of the object may be beside the camera
    share = np.linspace(0, 1, 5)[:, None, None]
    lines = (outline[a] * (1 - share) + outline[b] * share).reshape(-1, 3)
    points = lines @ T[:3, :3].T + T[:3, 3]
    points = points[points[:, 2] > NEAREST_M]
    if not len(points):
        return None
    uv, usable = project(view.camera, points)
    if not usable.any():
        return None
    low, high = uv[usable].min(axis=0), uv[usable].max(axis=0)
    box = np.clip(np.concatenate([low, high]), 0, [view.camera.width, view.camera.height] * 2).astype(np.float64)
    return (box, float(points[:, 2].min())) if (box[2:] - box[:2] > 1).all() else None


def depth_cells(view: View, xyz: F32) -> F32:
    """(h, w) depth of the nearest point in each cell of `CELL_PX`, infinite where there is none."""
    from scan2sim.pipeline.camera.models import project

    shape = -(-view.camera.height // CELL_PX), -(-view.camera.width // CELL_PX)
    depth = np.full(shape, np.inf, np.float32)
    T = np.linalg.inv(view.T_world_cam)
    points = xyz @ T[:3, :3].T + T[:3, 3]
    points = points[points[:, 2] > NEAREST_M]
    uv, usable = project(view.camera, points)
    cell = np.floor(uv / CELL_PX)
    usable &= (cell >= 0).all(axis=1) & (cell < [shape[1], shape[0]]).all(axis=1)
    x, y = cell[usable].astype(np.int64).T
    np.minimum.at(depth, (y, x), points[usable, 2].astype(np.float32))
    return depth


def _visible_share(depth: F32, corners: F64, nearest: float) -> float:
    """Share of the cells of a box that nothing before it occludes."""
    inner = depth[_cells(corners, depth.shape)]
    return round(float((inner > nearest - OCCLUDER_GAP_M).mean()), 3) if inner.size else 0.0


def _cells(corners: F64, shape: tuple[int, ...], margin: int = 0) -> tuple[slice, slice]:
    """Cells that a box covers."""
    x0, y0, x1, y1 = corners / CELL_PX
    rows = slice(max(0, int(y0) - margin), min(shape[0], int(np.ceil(y1)) + margin))
    return rows, slice(max(0, int(x0) - margin), min(shape[1], int(np.ceil(x1)) + margin))


def _distant(view: View, depth: F32, ground_z: float) -> Bools:
    """(h, w) cells where vehicles beyond `MAX_DISTANCE_M` could appear."""
    from scan2sim.pipeline.camera.models import unproject

    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    centres = np.stack([x + 0.5, y + 0.5], axis=-1).reshape(-1, 2) * CELL_PX
    rays = unproject(view.camera, centres) @ view.T_world_cam[:3, :3].T
    slope = rays[:, 2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-6)
    height = (view.centre[2] + MAX_DISTANCE_M * slope - ground_z).reshape(depth.shape)
    return np.asarray((height > BAND_M[0]) & (height < BAND_M[1]) & (depth > NEARER_SHARE * MAX_DISTANCE_M))


def _movable_pixels(pixels: U8, shape: tuple[int, ...]) -> Bools:
    """(h, w) cells with pixels that are classified as vehicle or person; single cells are noise."""
    import cv2
    from scipy import ndimage

    movable = np.isin(pixels.argmax(axis=2), [PIXEL_CLASSES.index(name) for name in ("vehicle", "person")])
    cells = cv2.resize(movable.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA) > 0.2
    part, count = ndimage.label(cells, np.ones((3, 3)))
    size = np.bincount(part.ravel(), minlength=count + 1)
    return np.asarray(cells & (size[part] >= UNEXPLAINED_MIN_CELLS))


def _ground_z(thin: PointCloud, ground: Bools, view: View) -> float:
    """Height of the ground below a camera, local metres."""
    near = ground & (np.hypot(*(thin.xyz[:, :2] - view.centre[:2]).T) < 10)
    return float(np.median(thin.xyz[near, 2])) if near.any() else float(view.centre[2]) - 1.7


def runs(cells: Bools) -> Iterator[tuple[int, int, int]]:
    """Row, first column and end of the runs of true cells."""
    for row, line in enumerate(cells):
        edge = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
        for start, end in zip(edge[::2], edge[1::2], strict=True):
            yield row, int(start), int(end)


def _entry(label: str, corners: F64, visible: float) -> dict[str, Any]:
    return {"class": label, "box": [round(float(v), 1) for v in corners], "visible": visible}
