"""Valid text inputs: tile.toml, survey.toml and drive.toml, CSVs of photos, trajectories, GPS tracks, settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import TypeAlias

import cv2
import numpy as np
import tomli_w

from scan2sim.flows.pipelines.drive import Drive
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.steps import STEPS
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.calibration import read_camera, read_extrinsics
from scan2sim.pipeline.io.survey import read_survey, write_survey
from scan2sim.pipeline.io.tile import read_tile
from tests.fuzz.damage import TEXTS
from tests.pipeline.importers.test_clouds_and_photos import cloud
from tests.pipeline.io import test_gps as gps
from tests.pipeline.io.test_tile import body, save
from tests.pipeline.io.test_trajectory import UTM, sample_trajectory

Make: TypeAlias = Callable[[Path], list[Path]]
Read: TypeAlias = Callable[[Path], object]


def written(name: str, text: str) -> Make:
    """Writer of a file with given name and text."""

    def make(folder: Path) -> list[Path]:
        (folder / name).write_text(text, encoding="utf-8")
        return [folder / name]

    return make


def tile(folder: Path) -> list[Path]:
    """Write a tile with a camera, a photo, a trajectory, a cell and classes."""
    (folder / "path.csv").write_text("time,x,y,z\n1,500000,5400000,101\n2,500001,5400000,101\n", encoding="utf-8")
    more = {"trajectory": "path.csv", "classes": {"65": "noise"}, "cell": {"seed": [500_010.0, 5_400_010.0]}}
    save(folder, body(folder, **more))
    return [folder / "tile.toml", folder / "path.csv"]


def survey(folder: Path) -> list[Path]:
    """Write a survey of one tile."""
    (folder / "a").mkdir()
    save(folder / "a", body(folder / "a", name="a", photos=[], cameras=[]))
    made = write_survey(folder, name="s", crs="EPSG:32632", length=100.0, buffer=5.0, tiles=["a"])
    return [made, folder / "a" / "tile.toml"]


DRIVE = """
[slam]
video = "video.mp4"
gps = "track.gpx"
[sweeps]
folder = "sweeps"
extrinsics = "T.txt"
max_range = 40.0
voxel = 0.05
[tiles]
length = 100.0
buffer = 5.0
"""
SETTINGS: dict[str, object] = {
    "decimate": {"target": 50_000, "building": {"target": 20_000}},
    "voxel": {"size": 0.1},
    "split": {"vegetation": "both"},
    "segment": {"overwrite": True, "min_classified": 0.3},
}


def settings(folder: Path) -> object:
    """Parameters of all steps, with the settings of the file."""
    return _params(Settings.read(folder / "settings.toml"))


def assignments(folder: Path) -> object:
    """Parameters of all steps, with `--set` options, one per line of the file."""
    lines = (folder / "set.txt").read_bytes().decode("utf-8", "replace").splitlines()
    return _params(Settings.read(None, [line for line in lines if line]))


def _params(settings: Settings) -> object:
    settings.check(STEPS)
    steps = [step for step in STEPS if not any(f.is_required() for f in step.params.model_fields.values())]
    return [settings.params(step, group) for step in steps for group in ("terrain", "building")]


def every_setting(data: bytes, rng: Random) -> bytes:
    """Assign a random value to a random parameter of a random step."""
    step = rng.choice(STEPS)
    names = list(step.params.model_fields) or ["x"]
    value = rng.choice((*TEXTS, "[1, 2]", "{a = 1}", "'x'", "1979-05-27"))
    return f"{step.name}.{rng.choice(names)}={value}\n".encode("utf-8", "replace")


def photos(folder: Path) -> list[Path]:
    """Write a cloud, a photo, a CSV of photos and one of cameras."""
    cloud(folder / "c.laz")
    cv2.imwrite(str(folder / "1.png"), np.zeros((48, 64, 3), np.uint8))
    (folder / "photos.csv").write_text(
        "file,x,y,z,qw,qx,qy,qz,time,camera\n1.png,500010,5400010,102,1,0,0,0,3.5,front\n", encoding="utf-8"
    )
    heading = "camera,model,width,height,fx,fy,cx,cy,k1,k2,p1,p2"
    (folder / "cameras.csv").write_text(f"{heading}\nfront,opencv,64,48,50,50,31.5,23.5,0.1,0,0,0\n", encoding="utf-8")
    return [folder / "photos.csv", folder / "cameras.csv", folder / "1.png"]


def read_photos(folder: Path) -> object:
    """Import the cloud and photos as a tile."""
    out = folder / "tile"
    photos, cameras = folder / "photos.csv", folder / "cameras.csv"
    return import_las([folder / "c.laz"], out, photos=photos, cameras=cameras, overwrite=out.exists())


def trajectory(suffix: str) -> tuple[Make, Read]:
    """Trajectory file: writer and reader."""

    def make(folder: Path) -> list[Path]:
        trajectory_io.write(folder / f"t{suffix}", sample_trajectory(), UTM)
        return [folder / f"t{suffix}"]

    return make, lambda folder: trajectory_io.read(folder / f"t{suffix}", UTM)


def camera_file(folder: Path) -> list[Path]:
    """Write a camera file and extrinsics."""
    camera = {"id": "c", "model": "opencv", "size": [64, 48], "focal": [50.0, 50.0], "centre": [31.5, 23.5]}
    (folder / "cameras.toml").write_text(tomli_w.dumps({"cameras": [camera]}), encoding="utf-8")
    np.savetxt(folder / "T.txt", np.eye(4)[:3], "%.9f")
    return [folder / "cameras.toml", folder / "T.txt"]


def read_camera_file(folder: Path) -> object:
    """Read the camera and the extrinsics."""
    return read_camera(folder / "cameras.toml", 64, 48), read_extrinsics(folder / "T.txt")


def calibration(folder: Path) -> list[Path]:
    """Write calibrations of other programs as YAML and as OpenCV's XML."""
    chain = "{camera_model: pinhole, intrinsics: [50, 50, 31, 23], distortion_model: radtan, "
    chain += "distortion_coeffs: [0.1, 0, 0, 0], resolution: [64, 48]}"
    livo = f"extrin_calib: {{Rcl: {np.eye(3).ravel().tolist()}, Pcl: [0, 0, 1]}}"
    (folder / "chain.yaml").write_text(f"cam0: {chain}\n{livo}\n", encoding="utf-8")
    file = cv2.FileStorage(str(folder / "camera.xml"), cv2.FILE_STORAGE_WRITE)
    file.write("camera_matrix", np.array([[50.0, 0, 31], [0, 50, 23], [0, 0, 1]]))
    file.write("distortion_coefficients", np.zeros((5, 1)))
    file.release()
    return [folder / "chain.yaml", folder / "camera.xml"]


def read_calibration(folder: Path) -> object:
    """Read the cameras and the extrinsics."""
    cameras = [read_camera(folder / name, 64, 48) for name in ("chain.yaml", "camera.xml")]
    return cameras, read_extrinsics(folder / "chain.yaml")


def track(name: str, text: str) -> tuple[Make, Read]:
    """GPS track: writer and reader."""
    return written(name, text), lambda folder: gps_io.read(folder / name)


def video(folder: Path) -> list[Path]:
    """Write a GoPro video with GPS telemetry."""
    packets = [gps.gps5(0, stamp=7.0), gps.gps9(1), gps.gps5(2, stamp=9.0)]
    return [gps.film(folder / "g.mp4", packets, [0.0, 1.0, 2.0])]


def telemetry(data: bytes, rng: Random) -> bytes:
    """Damage bytes of the telemetry, which is a small part of the file."""
    at = data.find(b"DEVC", rng.randrange(len(data)))
    at = (at if at >= 0 else max(0, data.find(b"DEVC"))) + rng.randrange(700)
    out = bytearray(data)
    for i in range(at, min(at + rng.choice((1, 1, 4)), len(out))):
        out[i] = rng.choice((0, 255, 63, rng.randrange(256)))
    return bytes(out)


def read_drive_file(folder: Path) -> object:
    """Read drive.toml."""
    return Drive.read(folder / "drive.toml")


def read_survey_folder(folder: Path) -> object:
    """Read the survey and its tiles."""
    return [read_tile(path) for path in read_survey(folder).tiles.values()]
