"""Generator of synthetic streets: a tile as recorded by a mobile mapping vehicle, with ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.data_samples import objects
from scan2sim.data_samples.layout import FRAME, Layout, Style, lay_out
from scan2sim.data_samples.photos import Effects, Shot, cameras, develop, plan_shots, render
from scan2sim.data_samples.road_users import road_users
from scan2sim.data_samples.scanner import Drive, plan_drive, scan
from scan2sim.data_samples.scene import TRUTH_FOOTPRINT_M, Scene, srgb
from scan2sim.data_samples.shapes import Part
from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.tracking.tracks import Category, Track, write_tracks

LENGTH_MIN_M = 8.0
TRUTH_INTERVAL_S = 0.05
"""Interval of the poses of true tracks."""


def generate(
    out: Path,
    *,
    length: float = 100.0,
    points: float = 9e6,
    photos: int = 40,
    seed: int = 0,
    photo_width: int = 1600,
    truth_density: float = 150.0,
    photo_labels: bool = False,
    cloud_scale: float = 0.001,
    style: Style | None = None,
    effects: Effects | None = None,
    traffic: bool = False,
    name: str = "street",
    report: Report = silent,
) -> Path:
    """Write a tile folder, and return the path of its `tile.toml`; the same arguments write the same bytes.

    Args:
        out: output folder; created if missing, files of the same names are replaced.
        length: length of the road, metres.
        points: exact number of lidar returns.
        photos: number of photos; they are taken at stations at most 5 m apart if there are enough of them. Photos that
            show nothing of the street (the last station's front camera) are omitted.
        seed: seed of all random numbers.
        photo_width: width of a pinhole photo (4:3), pixels; panoramas (2:1) are 1.28 times as wide.
        truth_density: samples of the true surface per square metre.
        photo_labels: also write `truth/labels/NAME.png` with a LAS class code per pixel, 0 for the sky.
        cloud_scale: resolution of the LAZ coordinates, metres.
        style: ranges of the street's random parameters; the default is a European town.
        effects: camera effects: exposure changes, noise, vignetting, JPEG quality.
        traffic: besides the oncoming car, there are a car ahead, a cyclist and a pedestrian; their paths, and the
            parked cars, are written to `truth/tracks.json`.
        name: name of the tile.
        report: receives progress.

    Raises:
        SettingError: length, points, photos or photo_width is too small.
    """
    for key, value, least in (
        ("length", length, LENGTH_MIN_M),
        ("points", points, 1),
        ("photos", photos, 0),
        ("photo_width", photo_width, 64),
    ):
        if not (np.isfinite(value) and value >= least):
            raise SettingError(key, f"{value} is less than {least:g}", f"Give {least:g} or more")
    from scan2sim.pipeline.io.clouds import las
    from scan2sim.pipeline.io.tile import read_tile, write_tile

    effects = effects or Effects()
    (out / "photos").mkdir(parents=True, exist_ok=True)
    (out / "truth").mkdir(exist_ok=True)
    report(0.0, "building the street")
    layout = lay_out(length, seed, style)
    scene = Scene(layout, road_users(layout) if traffic else ())
    drive = plan_drive(layout, points)

    cloud = scan(scene, drive, points, lambda f, m="": report(0.05 + 0.25 * f, m))
    report(0.3, "writing the cloud")
    las.write(out / "cloud.laz", cloud, cloud_scale)
    del cloud
    _write_trajectory(out / "trajectory.csv", drive.trajectory())

    entries = _take_photos(
        out, scene, drive, photos, photo_width, effects, photo_labels, lambda f, m="": report(0.4 + 0.55 * f, m)
    )
    report(0.95, "writing the truth")
    _write_truth(out / "truth", scene, truth_density, cloud_scale)
    if traffic:
        write_tracks(out / "truth" / "tracks.json", true_tracks(scene, drive), FRAME)
    path = write_tile(
        out,
        name=name,
        crs=FRAME.crs,
        clouds=["cloud.laz"],
        cameras=cameras(photo_width) if photos else {},
        photos=entries,
        trajectory="trajectory.csv",
        truth={"mesh": "truth/mesh.npz", "points": "truth/points.laz"},
    )
    read_tile(path)  # validates the written tile
    report(1.0, "done")
    return path


def true_tracks(scene: Scene, drive: Drive) -> list[Track]:
    """True tracks: of each moving road user in each pass, and of the parked cars."""
    layout = scene.layout
    car: tuple[Category, tuple[float, float, float]] = "car", _size(objects.car(layout.moving))
    kinds = [car, *((user.category, user.size) for user in scene.road_users)]
    tracks: list[Track] = []
    for i in range(drive.passes):
        times = drive.start(i) + np.arange(0, drive.duration, TRUTH_INTERVAL_S)
        for (category, size), (position, heading, inside) in zip(kinds, drive.movers(scene, times), strict=True):
            if inside.sum() > 1:
                poses = np.column_stack([position, heading])[inside]
                tracks.append(
                    Track(len(tracks), category, size, times[inside], poses, np.zeros((len(poses), 2)), True, None)
                )
    for parked in layout.parked:
        xy, heading = layout.axis.place(parked.s, parked.t)
        yaw = float(heading) + (0.0 if parked.towards == 1 else np.pi)
        pose = np.array([[*xy, float(layout.height(parked.s, parked.t)), yaw]])
        start = np.array([drive.start(0)])
        tracks.append(Track(len(tracks), *car, start, pose, np.zeros((1, 2)), False, None))
    return tracks


def _size(mesh: Part) -> tuple[float, float, float]:
    length, width, height = (float(value) for value in np.ptp(mesh.vertices, axis=0))
    return length, width, height


def _write_trajectory(path: Path, trajectory: Trajectory) -> None:
    rows = np.column_stack([trajectory.times, FRAME.to_crs(trajectory.positions)])
    np.savetxt(path, rows, fmt="%.4f", delimiter=",", header="time,x,y,z", comments="")


def _take_photos(
    out: Path, scene: Scene, drive: Drive, photos: int, width: int, effects: Effects, labels: bool, report: Report
) -> list[dict[str, object]]:
    """Render and write the photos and their exposures; returns their `[[photos]]` entries."""
    import cv2

    kinds = cameras(width)
    shots = plan_shots(scene.layout, drive, photos, effects.exposure_ev)
    entries: list[dict[str, object]] = []
    taken: list[Shot] = []
    for i, shot in enumerate(shots):
        report(i / len(shots), f"photo {i + 1} of {len(shots)}")
        seen = render(scene, drive, kinds[shot.camera], shot.T_world_cam, shot.time)
        if np.isin(seen.classification, (0, CODE["vehicle"])).all():
            continue
        taken.append(shot)
        image = develop(seen, shot.ev, effects, np.random.default_rng([scene.layout.seed, 5, i]))
        file = f"photos/{shot.name}.jpg"
        _, jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, effects.quality])
        (out / file).write_bytes(jpeg.tobytes())
        if labels:
            (out / "truth" / "labels").mkdir(exist_ok=True)
            _, png = cv2.imencode(".png", seen.classification)
            (out / "truth" / "labels" / f"{shot.name}.png").write_bytes(png.tobytes())
        entries.append(
            {
                "file": file,
                "camera": shot.camera,
                "position": FRAME.to_crs(shot.T_world_cam[:3, 3]),
                "rotation": shot.T_world_cam[:3, :3],
                "time": shot.time,
            }
        )
    lines = ["photo,exposure_ev", *(f"photos/{shot.name}.jpg,{shot.ev:.6f}" for shot in taken)]
    (out / "truth" / "exposures.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return entries


def _write_truth(folder: Path, scene: Scene, density: float, scale: float) -> None:
    from scan2sim.pipeline.io.clouds import las

    mesh = scene.truth_mesh()
    assert mesh.classification is not None
    frame = np.array([mesh.frame.crs, repr(mesh.frame.origin), repr(mesh.frame.unit)])
    with open(folder / "mesh.npz", "wb") as file:  # like Mesh.save, but compressed
        np.savez_compressed(file, frame=frame, vertices=mesh.vertices, faces=mesh.faces, label=mesh.classification)
    las.write(folder / "points.laz", sample_truth(scene, mesh, density), scale)


def sample_truth(scene: Scene, mesh: Mesh, density: float) -> PointCloud:
    """Random samples of the static surface above the ground, `density` per square metre, with true lit colours."""
    rng = np.random.default_rng([scene.layout.seed, 6])
    area = mesh.face_area.astype(np.float64)
    count = max(1, round(density * area.sum()))
    face = np.sort(rng.choice(len(area), count, p=area / area.sum())).astype(np.int32)
    bary = rng.random((count, 2)).astype(np.float32)
    outside = bary.sum(axis=1) > 1
    bary[outside] = 1 - bary[outside]
    c = scene.surface.vertices[scene.surface.faces[face]]
    xyz = c[:, 0] + bary[:, :1] * (c[:, 1] - c[:, 0]) + bary[:, 1:] * (c[:, 2] - c[:, 0])
    above = ~_buried(scene.layout, xyz.astype(np.float64))
    xyz, face, bary = xyz[above], face[above], bary[above]
    n = len(xyz)
    colour = np.empty((n, 3), np.uint8)
    for i in range(0, n, 1 << 20):
        at = slice(i, i + (1 << 20))
        no_heading = np.zeros(len(face[at]), np.float32)
        colour[at] = srgb(scene.lit(xyz[at], face[at], bary[at], no_heading, no_heading + TRUTH_FOOTPRINT_M))
    return PointCloud(FRAME, xyz.astype(np.float32), rgb=colour, classification=scene.surface.classification[face])


def _buried(layout: Layout, xyz: F64) -> np.ndarray:
    """(N,) whether points lie below the ground."""
    s, t = layout.axis.locate(xyz[:, :2])
    return xyz[:, 2] < layout.height(s, t, below_kerb=True) - 0.03
