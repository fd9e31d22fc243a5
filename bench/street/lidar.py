"""Whole held-out sweeps of a street, cast through its exported world by the scanner's own poses.

Returns are read from the recording, up to 80 m, not from the tile. Excluded are returns of
moving objects (near points that the run removed as moving at that time; on raw 0009 KITTI's tracking boxes, too), of
people, and of vehicles that the run removed as instances.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.street import boxes
from bench.street.world import Photo, World, photos
from scan2sim.pipeline.core.classes import CODE, GROUPS, SURFACES, surface_of
from scan2sim.pipeline.core.types import F32, F64, Bools, Frame, PointCloud
from scan2sim.pipeline.dynamic_objects.instance_boxes import BOX_MARGIN_M, in_boxes
from scan2sim.pipeline.importers.kitti_odometry import read_sequence
from scan2sim.pipeline.importers.kitti_raw import Drive, point_times, read_drive, read_drive_sweep
from scan2sim.pipeline.importers.scanner_path import ScannerPath
from scan2sim.pipeline.lidar import range_errors
from scan2sim.pipeline.lidar.casting import Scanner, Simulated
from scan2sim.pipeline.lidar.range_errors import MAX_RANGE_M, Row
from scan2sim.pipeline.lidar.score import score
from scan2sim.pipeline.lidar.sweeps import Sweeps, every_nth, moving_returns, near_moving
from scan2sim.pipeline.lidar.unreturned import near_excluded, unreturned_rays
from scan2sim.pipeline.steps.lidar_score import nearest_class

HOLD_OUT = 8
"""Every Nth sweep is held out by the run."""
LABELLED_RANGE_M, LABEL_MARGIN_PX, SAME_POINT_M = 30.0, 6, 0.03
"""Range of the returns that labels decide about, pixels around a label that are not decided, and the distance within
which a removed point is the return itself."""
DIVERGENCE_RAD = 0.002
"""Full angle of the beams of KITTI's scanner, a Velodyne HDL-64E, from its data sheet."""
FLOOR_RAYS, FLOOR_POINTS, FLOOR_RADIUS_M = 40_000, 24, 0.25
MIN_INCIDENCE = 0.02
"""Least cosine of the angle between a ray and a plane's normal: one degree."""
Found = dict[str, Any]


def metrics(
    data: Path, tile: Path, run: Path, pictures: Path, labels: Path | None = None, vertical_angle_offset: float = 0.0
) -> Found:
    """Score of a street's world by its held-out sweeps; writes a picture of each into the folder `pictures`.

    Args:
        data: the recording, a KITTI raw drive (a folder that contains one) or odometry sequence.
        tile, run: folders of the street's tile and run.
        pictures: folder for the pictures.
        labels: KITTI's tracking boxes, if there are some.
        vertical_angle_offset: of the tile's import, degrees: the held-out sweeps are corrected as the others.
    """
    from PIL import Image

    world = World(run / "world")
    names = [name for name in SURFACES if name in GROUPS or name in world.surfaces]
    surfaces = [list[str](names).index(name) for name in world.surfaces]
    scanner = Scanner(world.casting, surfaces)
    sweeps, views = held_out(data, tile, world.origin, vertical_angle_offset)
    numbers = np.unique(sweeps.number).tolist()
    unreturned, unknown = unreturned_rays(sweeps)
    others = _moved(PointCloud.load(newest(run, "instances", "cloud.npz")), world.origin)  # without held-out sweeps
    code = nearest_class(sweeps.xyz, others)
    local = Frame(origin=tuple(world.origin.tolist()))
    instances = newest(run, "instances", "instances.geojson")
    moving = moving_returns(sweeps, _moved(PointCloud.load(newest(run, "dynamic_objects", "moving.npz")), world.origin))
    excluded = in_boxes(sweeps.xyz, local, instances, lambda _: True) | near_moving(sweeps, moving)
    if labels:
        for number in numbers:
            own = sweeps.number == number
            excluded[own] |= _in_tracked(sweeps.xyz[own], boxes.in_frame(labels, number, views[number]))
    kept = ~excluded
    found = score(
        scanner,
        sweeps.take(kept),
        names,
        surface_of(names)[code[kept]],
        unreturned.take(~near_excluded(unreturned, Sweeps.join([moving, sweeps.take(excluded)]))),
        unknown,
        lambda xyz: in_boxes(xyz, local, instances, lambda _: True),
    )
    beams = Scanner(world.casting, surfaces, DIVERGENCE_RAD).scan(sweeps.origins[kept], sweeps.xyz[kept])
    planes = floor(sweeps.take(kept), others.xyz, surface_of(names)[code[kept]])
    for number, image in found.images.items():
        pictures.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image.picture()).save(pictures / f"sweep_{number:02d}.png")
    return {
        "excluded": float(excluded.mean()),
        "all": found.all,
        "beams": range_errors.row(beams),
        "by_surface": found.by_surface,
        "by_distance": found.by_distance,
        "phantoms": found.phantoms,
        "floor": range_errors.by_surface(planes, names, planes.surface),
        "range_image": found.range_image(),
        "sweeps": found.sweeps,
    }


def wrongly_removed(
    data: Path, tile: Path, run: Path, vehicles: Callable[[int, Photo], Bools], vertical_angle_offset: float = 0.0
) -> float:
    """Share of the static returns of held-out sweeps that the run removed, as moving or as vehicle or person.

    Static are returns within `LABELLED_RANGE_M` that project into the photo at least `LABEL_MARGIN_PX` beside what is
    labelled as a vehicle or person in it. Removed are those that are in the run's moving points, or next to points
    whose final class is vehicle or person.

    Args:
        data, tile, run: as in `metrics`.
        vehicles: function of a photo's number and the photo that returns its (H, W) pixels of vehicles and people.
    """
    from scipy.ndimage import binary_dilation

    origin = np.array(json.loads((run / "world" / "metadata.json").read_text(encoding="utf-8"))["origin_m"])
    sweeps, views = held_out(data, tile, origin, vertical_angle_offset)
    static = np.zeros(len(sweeps), bool)
    for number in np.unique(sweeps.number).tolist():
        photo, own = views[number], np.flatnonzero(sweeps.number == number)
        labelled = binary_dilation(vehicles(number, photo), iterations=LABEL_MARGIN_PX)
        local = (sweeps.xyz[own] - photo.T[:3, 3]) @ photo.T[:3, :3]
        ahead = (local[:, 2] > 0.5) & (np.linalg.norm(local, axis=1) < LABELLED_RANGE_M)
        own, pixel = own[ahead], photo.pixels(local[ahead])
        column, row = np.round(pixel).astype(np.int64).T
        inside = (column >= 0) & (column < labelled.shape[1]) & (row >= 0) & (row < labelled.shape[0])
        static[own[inside]] = ~labelled[row[inside], column[inside]]
    sweeps = sweeps.take(static)
    moving = PointCloud.load(newest(run, "dynamic_objects", "moving.npz"))
    removed = near_moving(sweeps, moving_returns(sweeps, _moved(moving, origin)), SAME_POINT_M)
    classified = _moved(PointCloud.load(newest(run, "instances", "cloud.npz")), origin)
    removed |= np.isin(nearest_class(sweeps.xyz, classified), [CODE["vehicle"], CODE["person"]])
    return float(removed.mean())


def held_out(
    data: Path, tile: Path, origin: F64, vertical_angle_offset: float = 0.0
) -> tuple[Sweeps, dict[int, Photo]]:
    """The held-out sweeps of a recording, and all photos, at the poses of the import, not those that a run refined."""
    views = photos(tile, tile, origin)
    drive, deskew = street_drive(data)
    numbers = list(drive.sweeps)
    parts = [_sweep(drive, numbers[i], views, deskew, vertical_angle_offset) for i in every_nth(len(numbers), HOLD_OUT)]
    return Sweeps.join(parts), views


def floor(sweeps: Sweeps, others: F32, surface: npt.NDArray[np.integer]) -> Simulated:
    """What rays would measure on the points of the other sweeps themselves: the error that no reconstruction avoids.

    It contains the noise of both sweeps and the disagreement of their poses; at grazing incidence, on the road, a
    centimetre of height is ten of range. The surface at a return is the plane of its nearest `FLOOR_POINTS` within
    `FLOOR_RADIUS_M`; rays parallel to it, or with fewer than half of the points, are left out.

    Args:
        sweeps: returns that count.
        others: (M, 3) points of the other sweeps, local metres.
        surface: (N,) index of the surface that each return was recorded on.
    """
    from scipy.spatial import cKDTree

    every = slice(None, None, max(1, len(sweeps) // FLOOR_RAYS))
    returns, origins, surface = sweeps.xyz[every].astype(np.float64), sweeps.origins[every], surface[every]
    apart, near = cKDTree(others).query(returns, k=FLOOR_POINTS, distance_upper_bound=FLOOR_RADIUS_M)
    known = np.isfinite(apart).sum(axis=1) >= FLOOR_POINTS // 2
    returns, origins, surface, apart, near = (one[known] for one in (returns, origins, surface, apart, near))
    weight = np.isfinite(apart).astype(np.float64)
    points = others[np.where(weight > 0, near, 0)].astype(np.float64)
    centre = (weight[..., None] * points).sum(axis=1) / weight.sum(axis=1)[:, None]
    offset = weight[..., None] * (points - centre[:, None])
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    recorded = np.linalg.norm(returns - origins, axis=1)
    directions = (returns - origins) / recorded[:, None]
    slope = np.einsum("ni,ni->n", normal, directions)
    hit = np.abs(slope) > MIN_INCIDENCE
    distance = np.einsum("ni,ni->n", normal, centre - origins)[hit] / slope[hit]
    found = Simulated(
        recorded[hit].astype(np.float32),
        distance.astype(np.float32),
        surface[hit].astype(np.int16),
        apart[hit, 0].astype(np.float32),
        directions[hit],
    )
    return found


def result(streets: list[Found]) -> dict[str, float | None]:
    """Results that have targets, the worst of the streets; None without a street or where a street has none."""

    def worst(values: list[float | None], sign: int = 1) -> float | None:
        known = [value for value in values if value is not None]
        return sign * max(sign * v for v in known) if known and len(known) == len(values) else None

    def centimetres(value: float | None) -> float | None:
        return None if value is None else 100 * value

    return {
        "lidar_ground_cm": worst([centimetres(_worst_median(s["by_surface"])) for s in streets]),
        "lidar_early_share": worst([_solid(s["by_surface"], "early_20cm") for s in streets]),
        "lidar_vegetation_early_share": worst([s["by_surface"]["vegetation"]["early_50cm"] for s in streets]),
        "lidar_phantom_share": worst([s["phantoms"]["phantom"] for s in streets]),
        "lidar_f22": worst([s["range_image"]["f_score"] for s in streets], -1),
        "lidar_chamfer_m2": worst([s["range_image"]["chamfer_m2"] for s in streets]),
        "lidar_depth_median_cm": worst([centimetres(s["range_image"]["depth_median_m"]) for s in streets]),
        "lidar_missing_share": worst([s["all"]["missing"] for s in streets]),
        "returns_near_share": worst([s["all"]["near_surface"] for s in streets], -1),
        "returns_mid_share": worst([s["by_distance"]["20-40 m"]["near_surface"] for s in streets], -1),
    }


def _worst_median(rows: Mapping[str, Any]) -> float | None:
    """The largest median range error, metres, of ground, walls and furniture; None: no ray hit any."""
    known = [one["median_m"] for name, one in rows.items() if name != "vegetation" and one["median_m"] is not None]
    return max(known, default=None)


def table(found: Found) -> None:
    """Print a street's score."""

    def text(value: float | None, scale: float = 100, digits: int = 1) -> str:
        return "-" if value is None else f"{scale * value:.{digits}f}"

    rows: Mapping[str, Any] = {
        **found["by_surface"],
        **found["by_distance"],
        "all": found["all"],
        "as beams": found["beams"],
    }
    print(
        f"  held-out sweeps, returns up to 80 m ({found['excluded']:.1%} excluded): range error median, 90 % (cm);",
        end="",
    )
    print(" %: early by 20, 50 cm, late by 50 cm, missing, within 22 cm of a surface")
    keys = ("median_m", "p90_m", "early_20cm", "early_50cm", "late_50cm", "missing", "near_surface")
    for name, one in rows.items():
        print(f"    {name:11}{one['rays']:>8,}" + "".join(f"{text(one[key]):>8}" for key in keys))
    one = found["phantoms"]
    if one["reason"]:
        print(f"    phantom returns: unknown, {one['reason']}")
    else:
        print(
            f"    phantom returns, % of the simulated ones: {text(one['phantom'])}; {text(one['without_return'])} "
            f"where the ray had no return ({one['rays']:,} rays had none; of them {text(one['ground'])} % hit ground, "
            f"{text(one['surface'])} % a surface beside the gap)"
        )
        for key in ("by_surface", "by_distance"):
            print("      " + ", ".join(f"{name} {text(share)}" for name, share in one[key].items()))
    print("    floor (the other sweeps' own points as surface), median (cm) and % early by 20 cm:", end=" ")
    known = {name: row for name, row in found["floor"].items() if row["rays"]}
    print(", ".join(f"{name} {text(row['median_m'])}, {text(row['early_20cm'])}" for name, row in known.items()))
    image = found["range_image"]
    print(
        f"    range images: RMSE {text(image['depth_rmse_m'], 1, 2)} m, median {text(image['depth_median_m'])} cm, "
        f"Chamfer {text(image['chamfer_m2'], 1, 3)} m2, F {text(image['f_score'], 1, 3)}"
    )


def street_drive(data: Path) -> tuple[Drive, bool]:
    """The drive of a recording, and whether its sweeps must be deskewed."""
    if (data / "velodyne").is_dir():
        return read_sequence(data), False
    poses = sorted(data.glob("T_velo0_velo*.txt"))
    return read_drive(data, poses=poses[0] if poses else None), True


def _sweep(drive: Drive, number: int, views: Mapping[int, Photo], deskew: bool, vertical_angle_offset: float) -> Sweeps:
    """A frame's sweep at the poses of the tile, which may have been corrected by the import."""
    numbers, rig = list(drive.sweeps), next(iter(drive.rigs.values()))
    path = ScannerPath(drive.spans[:, 1], np.array([views[n].T @ np.linalg.inv(rig.T_velo_cam) for n in numbers]))
    start, _, end = drive.spans[numbers.index(number)]
    sweep = read_drive_sweep(drive.sweeps[number], MAX_RANGE_M, vertical_angle_offset)
    times = point_times(sweep, start, end, deskew)
    xyz = path.to_local(sweep.xyz, times).astype(np.float32)
    return Sweeps(xyz, path.at(times)[:, :3, 3], np.full(len(xyz), number, np.int32), sweep.xyz, times)


def newest(run: Path, step: str, file: str) -> Path:
    """The newest result of a step of a run."""
    return max((run / "steps" / step).glob(f"*/{file}"), key=lambda path: path.stat().st_mtime)


def _moved(cloud: PointCloud, origin: F64) -> PointCloud:
    """The cloud in the world's local frame."""
    shift = (np.asarray(cloud.frame.origin) - origin).astype(np.float32)
    return PointCloud(cloud.frame, cloud.xyz + shift, classification=cloud.classification, time=cloud.time)


def _in_tracked(xyz: F32, tracked: list[boxes.Box]) -> Bools:
    """(N,) whether points are in a box, or within `BOX_MARGIN_M` of one."""
    inside = np.zeros(len(xyz), bool)
    for box in tracked:
        local = (xyz - box.T[:3, 3]) @ box.T[:3, :3]
        own = (np.abs(local[:, :2]) < box.size[:2] / 2 + BOX_MARGIN_M).all(axis=1)
        inside |= own & (np.abs(local[:, 2] - box.size[2] / 2) < box.size[2] / 2 + BOX_MARGIN_M)
    return inside


def _solid(rows: Mapping[str, Row], key: str) -> float | None:
    """A share (`key`) over all rays that hit surfaces other than vegetation: ground, walls, furniture; None: no ray."""
    parts = [(one[key], one["rays"]) for name, one in rows.items() if name != "vegetation" and one[key] is not None]
    return sum(value * rays for value, rays in parts) / sum(rays for _, rays in parts) if parts else None
