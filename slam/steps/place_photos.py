"""Step `place_photos`: scales and georeferences a reconstruction, aligns it with a point cloud, writes poses."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.parameters import Shift
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, Frame, PointCloud, Trajectory, View
from scan2sim.pipeline.geometry.similarity import Similarity
from scan2sim.pipeline.importers import georeference
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import exif
from scan2sim.pipeline.io.photogrammetry import Model, Photos
from scan2sim.pipeline.io.photogrammetry import colmap as model_io
from scan2sim.pipeline.pose_check import photo_fit
from scan2sim.slam.reconstruction import photos as photos_io
from scan2sim.slam.reconstruction import positions as positions_io
from scan2sim.slam.reconstruction import registration
from scan2sim.slam.reconstruction.photos import Photo
from scan2sim.slam.reconstruction.positions import Positions
from scan2sim.slam.scan_pairs import surface_of
from scan2sim.slam.trajectory import output
from scan2sim.slam.trajectory.align import upright
from scan2sim.slam.video import open_video

CSV_COLUMNS = ("model", "width", "height", "fx", "fy", "cx", "cy")
COEFFICIENTS = {"opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}
QUARTER_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
"""Clockwise quarter turns by which a photo is displayed, by the orientation in its EXIF."""
MAX_HEADING_SIGMA_RAD = np.radians(12.0)
"""Standard deviation of the heading by GPS that the registration to a cloud can correct."""


@dataclass(frozen=True)
class AlignmentModel:
    """Alignment of photos with a cloud.

    Attributes:
        range_m: distance from the cameras of the points that are used.
        points_max, sample_max: points kept of the cloud; points projected into the photos, in
            the search and at its end.
        groups, group_size: runs of consecutive photos that are compared with the cloud, and photos of each.
        radius_min_m: least error of the approximate positions.
        climbed: candidates of the registration that are refined.
        steps_m, fine_steps_m: steps of the search by photos: of each candidate, and of the best one.
        lever_m: distance at which a rotation moves points by a step.
        score_min: score of photos that fit (as `pipeline.pose_check.check.CheckLimits.min_score`).
        probe_m: shift that has to lower the score.
        relative_sigma_m: least error of the approximate positions relative to each other.
        sparse_weight: weight of the sparse points' support by surfaces, besides the score of the photos, which doesn't
            know the scale: it is that of the cameras' height above ground.
        prior: decrease of the score by a scale that is off by one standard deviation of that by GPS.
    """

    range_m: float = 60.0
    points_max: int = 2_000_000
    sample_max: tuple[int, int] = (12_000, 120_000)
    groups: int = 3
    group_size: int = 4
    radius_min_m: float = 2.0
    climbed: int = 2
    steps_m: tuple[float, ...] = (1.0, 0.5, 0.25)
    fine_steps_m: tuple[float, ...] = (0.25, 0.12, 0.06, 0.03)
    lever_m: float = 15.0
    score_min: float = 0.2
    probe_m: float = 1.0
    relative_sigma_m: float = 0.3
    sparse_weight: float = 0.5
    prior: float = 0.02


MODEL = AlignmentModel()


class PlaceContext(Context):
    """What the pipeline passes: CRS of the cloud and of the result, None if unknown."""

    crs: str | None = None


class Placed(Params):
    """Placement of a reconstruction: options of `scan2sim import images`."""

    gps_offset: Shift | None = Field(
        None,
        description="Seconds to add to the times of the GPS track, so that they are those of the photos (of a video: "
        "since its start); default: by the clocks.",
    )


class PlaceParams(Placed):
    """Settings of the step."""

    context: PlaceContext = PlaceContext()


def place_photos(inputs: Inputs, params: PlaceParams, out: Path, report: Report) -> Done:
    """Scale and georeference `model` with `photos` (JSON) of the folder `images`, by `gps`, `positions`, or EXIF.

    With `cloud`, the reconstruction is registered to it. Without usable positions it keeps its arbitrary scale.
    `video` is the source of the images, if it is one. `summary` (JSON) is written to `path`,
    with this step's metrics. Files: `table` (CSV of posed photos as `import clouds` reads it),
    `path` (trajectory in all formats, and the COLMAP model, local metres), `frame` (JSON of the local frame).

    Raises:
        DataError: positions are missing or inconsistent, or the photos don't fit the cloud.
    """
    images = inputs["images"]
    model = model_io.read(inputs["model"], Photos(images))
    known = {photo.name: photo for photo in photos_io.read(inputs["photos"])}
    photos = [known[shot.file] for shot in model.shots]
    seen = displayed(model, images)
    ups = -seen[:, :3, 1]
    warnings: list[str] = []
    cloud = inputs.get("cloud")
    found = approximate(inputs, photos, params, warnings.append)
    fit = None if found is None else georeferenced(found, model, ups, inputs, warnings.append)
    metrics: dict[str, Any] = {"georeferenced": fit is not None}
    if found is None or fit is None:
        R = upright(seen)
        onto, frame = Similarity(1.0, R, -R @ model.centres[0]), Frame()
        warnings.append(
            "without usable GPS, scale and position of the photos are unknown: trajectory.csv isn't in metres"
        )
    else:
        warnings += found.notes
        assert fit.rms is not None
        metrics |= {"gps_rms_m": round(fit.rms, 3), "crs": crs_io.name(found.crs), "scale": fit.onto.scale * found.unit}
        origin = np.floor(fit.onto.apply(model.centres).mean(axis=0) * found.unit)
        frame = Frame(found.crs, tuple(origin.tolist()), found.unit)
        to_metres = fit.onto.scale * found.unit
        onto = Similarity(to_metres, fit.onto.rotation, fit.onto.translation * found.unit - origin)
        if cloud is None:
            warnings += fit.notes
        else:
            onto, fitted = align(cloud, frame, model, images, inputs["model"], onto, fit.rms, report, warnings.append)
            metrics |= fitted
    placed = model.transformed(onto)
    table = write_table(out / "photos.csv", placed, photos, frame)
    times = np.array([np.nan if photo.time is None else photo.time for photo in photos])
    timed = np.isfinite(times).all() and len(np.unique(times)) == len(times)
    order = np.argsort(times) if timed else np.arange(len(times))
    seconds = times[order] if timed else order.astype(np.float64)
    poses = np.array([placed.shots[i].pose for i in order])
    path = out / "path"
    output.write(path, Trajectory(seconds, poses[:, :3, 3], poses[:, :3, :3]), frame)
    (path / "colmap").mkdir(exist_ok=True)
    transform = (onto.scale, onto.rotation, onto.translation)
    sandbox.call(
        "scan2sim.slam.reconstruction.colmap:transform", inputs["model"], path / "colmap", transform, timeout=600
    )
    if frame.crs != crs_io.LOCAL:
        x, y, z = frame.to_crs(np.zeros(3)).tolist()
        text = f"COLMAP model in metres, z up, from {x:.3f} {y:.3f} {z:.3f} in {frame.crs}\n"
        (path / "colmap" / "coordinates.txt").write_text(text, encoding="utf-8")
    summary = json.loads(inputs["summary"].read_text(encoding="utf-8")) | metrics
    (path / "reconstruction.json").write_text(json.dumps(summary, indent=1), encoding="utf-8")
    frame_file = out / "frame.json"
    frame_file.write_text(json.dumps(asdict(frame)), encoding="utf-8")
    return Done({"table": table, "path": path, "frame": frame_file}, metrics, warnings)


def displayed(model: Model, images: Path) -> F64:
    """Poses (P, 4, 4) of the photos as they are displayed, camera to model: portraits may be stored on their side."""
    from scipy.spatial.transform import Rotation

    poses = np.array([shot.pose for shot in model.shots])
    turns = [QUARTER_TURNS.get(exif.orientation(images / shot.file), 0) for shot in model.shots]
    poses[:, :3, :3] = (
        poses[:, :3, :3] @ Rotation.from_euler("z", -90.0 * np.array(turns)[:, None], degrees=True).as_matrix()
    )
    return poses


def approximate(
    inputs: Inputs, photos: Sequence[Photo], params: PlaceParams, warn: Callable[[str], None]
) -> Positions | None:
    """Approximate positions of the photos; their CRS is that of the cloud, if any.

    Without a cloud, photos without GPS aren't an error: `warn` receives the reason.

    Returns:
        None if there are none.

    Raises:
        ScanError: as functions of `slam.reconstruction.positions`.
    """
    crs = params.context.crs
    if "positions" in inputs:
        return positions_io.by_list(inputs["positions"], photos, crs or crs_io.LOCAL)
    if "gps" in inputs:
        start = open_video(inputs["video"]).start if "video" in inputs else None
        return positions_io.by_track(inputs["gps"], photos, crs, start, params.gps_offset)
    try:
        return positions_io.by_exif(inputs["images"], photos, crs)
    except DataError as error:
        if "cloud" in inputs:
            raise
        if any(photo.position for photo in photos):
            warn(error.cause)
        return None


def georeferenced(
    found: Positions, model: Model, ups: F64, inputs: Inputs, warn: Callable[[str], None]
) -> georeference.Fit | None:
    """Similarity of a reconstruction to its approximate positions.

    The GPS that happens to be in the photos may be of one spot: `warn` receives the reason, and the result is None.
    For a cloud, or by positions that the user gives, that is an error.

    Raises:
        DataError: the positions are inconsistent, or too near to each other for their errors.
    """
    try:
        return georeference.from_positions(
            inputs["images"], model.centres, ups, found.xyz, found.crs, found.unit,
            max_angle=MAX_HEADING_SIGMA_RAD if "cloud" in inputs else georeference.MAX_ANGLE_SIGMA_RAD,
            remedy="or give more accurate positions",
        )  # fmt: skip
    except DataError as error:
        if not inputs.keys().isdisjoint(("cloud", "gps", "positions")):
            raise
        warn(f"the GPS in the photos isn't used: {error.cause}")
        return None


def align(
    cloud: Path,
    frame: Frame,
    model: Model,
    images: Path,
    folder: Path,
    coarse: Similarity,
    rms: float,
    report: Report,
    warn: Callable[[str], None],
) -> tuple[Similarity, dict[str, Any]]:
    """Align a reconstruction with a cloud: sparse points by ICP, then photos with the cloud's points.

    Args:
        cloud: file.
        frame: local frame of the result.
        model: the reconstruction.
        images: folder of its photos.
        folder: folder of its files.
        coarse: approximate similarity to local metres.
        rms: residual of the approximate positions, metres.
        report: receives progress.
        warn: receives a warning if the alignment is ambiguous.

    Raises:
        DataError: the cloud isn't where the photos are, or doesn't fit them.
    """
    report(0.0, f"reading {cloud.name}")
    centres = model.centres
    near = points_near(cloud, frame, coarse.apply(centres))
    report(0.2, "registering the reconstruction to the cloud")
    sparse, sigma = sandbox.call("scan2sim.slam.reconstruction.colmap:precise_points", folder, timeout=600)
    surface = surface_of(near.xyz.astype(np.float64))
    radius = max(MODEL.radius_min_m, rms)
    starts = [coarse, *registration.candidates(sparse, sigma, centres, surface, coarse, radius)]
    groups = photo_groups(model, images)
    spread = coarse.scale * float(np.sqrt(np.square(centres - centres.mean(axis=0)).sum(axis=1).mean()))
    scale_sigma = max(rms / np.sqrt(len(centres)), MODEL.relative_sigma_m) / spread
    chosen = registration.usable(sparse, sigma, centres, coarse)
    # about the middle of what the photos show, rotations and shifts of the photos are independent
    middle = (sparse[chosen] if len(chosen) else centres).mean(axis=0)

    def score_by(count: int, *, alone: bool = False) -> Callable[[Similarity], float]:
        sample = near.take(slice(0, None, max(1, len(near) // count)))

        def score(onto: Similarity) -> float:
            poses = np.array([shot.pose for shot in model.transformed(onto).shots])
            fits = [photo_fit.fit(small, cameras, poses[rows], sample).score for rows, cameras, small in groups]
            found = float(np.mean(np.concatenate(fits)))
            if alone:
                return found
            off = (onto.scale / coarse.scale - 1) / scale_sigma
            return (
                found + MODEL.sparse_weight * registration.support(sparse[chosen], surface, onto) - MODEL.prior * off**2
            )

        return score

    quick, score = (score_by(count) for count in MODEL.sample_max)
    photos_alone = score_by(MODEL.sample_max[1], alone=True)
    scored = []
    for i, start in enumerate(starts):
        report(0.3 + 0.3 * i / len(starts), f"comparing photos with the cloud: start {i + 1} of {len(starts)}")
        scored.append((quick(start), i))
    scored.sort(reverse=True)
    report(0.6, "refining the alignment")
    climbed = [
        registration.climb(quick, starts[i], middle, MODEL.lever_m, MODEL.steps_m) for _, i in scored[: MODEL.climbed]
    ]
    best, _ = max(climbed, key=lambda item: item[1])
    report(0.8, "refining the alignment")
    best, _ = registration.climb(score, best, middle, MODEL.lever_m, MODEL.fine_steps_m)
    value, before = photos_alone(best), photos_alone(coarse)
    shifts = [
        photos_alone(registration.moved(best, middle, MODEL.probe_m * direction))
        for direction in (*np.eye(7)[:3], *-np.eye(7)[:3])
    ]
    drop = value - max(shifts)
    if value < MODEL.score_min:
        raise DataError(
            cloud, f"doesn't fit the photos (score {value:.2f}, at least {MODEL.score_min:g} is needed)",
            "Check that both show the same place, the --crs of the cloud, and --gps-offset",
        )  # fmt: skip
    if drop < 0.02:
        warn(
            "the cloud doesn't determine the photos' position in one direction, such as along a uniform street: "
            f"shifted by {MODEL.probe_m:g} m they fit nearly as well (score {max(shifts):.2f} instead of {value:.2f})"
        )
    shift = float(np.linalg.norm(best.apply(centres) - coarse.apply(centres), axis=1).mean())
    return best, {
        "fit_score": round(value, 3), "fit_score_before": round(before, 3), "aligned_by_m": round(shift, 3),
        "scale": best.scale,
    }  # fmt: skip


def points_near(cloud: Path, frame: Frame, positions: F64) -> PointCloud:
    """Points of a cloud near the cameras' positions (local metres), thinned evenly to at most `points_max`.

    Raises:
        DataError: there are none.
    """
    from scipy.spatial import cKDTree

    tree, stride, parts = cKDTree(positions[:, :2]), 1, list[PointCloud]()
    for part in cloud_io.chunks(cloud, Frame(frame.crs, frame.origin, frame.unit)):
        xyz = frame.to_local(part.frame.to_crs(part.xyz))
        distance = tree.query(xyz[:, :2], distance_upper_bound=MODEL.range_m)[0]
        rows = np.flatnonzero(np.isfinite(distance))[::stride]
        intensity = None if part.intensity is None else part.intensity[rows]
        parts.append(PointCloud(frame, xyz[rows].astype(np.float32), intensity=intensity))
        while sum(map(len, parts)) > MODEL.points_max:
            stride, parts = stride * 2, [one.take(slice(0, None, 2)) for one in parts]
    count = sum(map(len, parts))
    if count < 1000:
        raise DataError(
            cloud, f"has {count} points within {MODEL.range_m:g} m of the photos",
            "Check that both show the same place, and the --crs of the cloud",
        )  # fmt: skip
    return PointCloud.join(parts)


def photo_groups(model: Model, images: Path) -> list[tuple[list[int], list[Any], list[photo_fit.SmallPhoto]]]:
    """Runs of photos, spread over the path: their rows, cameras and reduced images."""
    count, size = len(model.shots), MODEL.group_size
    first = np.unique(np.linspace(0, max(0, count - size), MODEL.groups).round().astype(int))
    groups = []
    for at in first.tolist():
        rows = list(range(at, min(at + size, count)))
        views = [
            View(shot.file, model.cameras[shot.camera], shot.pose, images / shot.file)
            for shot in (model.shots[i] for i in rows)
        ]
        groups.append((rows, [view.camera for view in views], photo_fit.small_photos(views)))
    return groups


def write_table(path: Path, model: Model, photos: Sequence[Photo], frame: Frame) -> Path:
    """Write the CSV of posed photos of `pipeline.importers.clouds_and_photos`; the model is in local metres."""
    from scipy.spatial.transform import Rotation

    coefficients = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    columns = ("file", "x", "y", "z", "qw", "qx", "qy", "qz", "time", "camera", *CSV_COLUMNS, *coefficients)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for shot, photo in zip(model.shots, photos, strict=True):
            camera = model.cameras[shot.camera]
            quaternion = Rotation.from_matrix(shot.pose[:3, :3]).as_quat(scalar_first=True).tolist()
            row = {"file": shot.file, "camera": shot.camera, "time": "" if photo.time is None else photo.time}
            row |= dict(zip("xyz", frame.to_crs(shot.pose[:3, 3]).tolist(), strict=True))
            row |= dict(zip(("qw", "qx", "qy", "qz"), quaternion, strict=True))
            row |= {name: getattr(camera, name) for name in CSV_COLUMNS}
            row |= dict(zip(COEFFICIENTS.get(camera.model, ()), camera.distortion, strict=False))
            writer.writerow(row)
    return path


PLACE_PHOTOS = Step("place_photos", 1, place_photos, PlaceParams, memory=(1.5, 2))
