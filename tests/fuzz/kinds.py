"""Kinds of input files: how to write valid ones, how to read them, and damage specific to them.

To have a reader fuzzed, add it to `KINDS`. Cloud formats of `test_cloud_formats.FORMATS` are included automatically.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from scan2sim.flows.commands.inspect import inspect_path
from scan2sim.pipeline.io import gps as gps_io
from scan2sim.pipeline.io.tile import read_tile
from tests.fakes.bags import FORMATS as BAG_FORMATS
from tests.fuzz import bags, clouds, datasets, models, tables
from tests.fuzz.damage import Damage
from tests.pipeline.importers.test_photogrammetry import WRITERS
from tests.pipeline.io import test_gps as gps
from tests.pipeline.io.test_cloud_formats import FORMATS


@dataclass(frozen=True)
class Kind:
    """Kind of input.

    Attributes:
        make: writes valid files below a folder; returns those to be damaged.
        read: reads them from that folder, as a command would; any output is written below the folder.
        special: damage specific to the kind, used in half of the cases.
    """

    make: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    special: Damage | None = None


SPECIAL: dict[str, Damage] = {**dict.fromkeys(("las", "laz", "copc"), clouds.las_field), "e57": clouds.e57_content}
SET_OPTIONS = "decimate.target=50000\nsplit.vegetation=both\ndecimate.building.target=2e4\nvoxel.size=0.1\n"
KINDS: dict[str, Kind] = {
    **{n: Kind(clouds.writer(f), clouds.reader(f), SPECIAL.get(n)) for n, f in FORMATS.items()},
    "e57 images": Kind(clouds.e57_images, clouds.read_e57_images, clouds.e57_content),
    "photo jpg": Kind(*models.photo(".jpg")),
    "photo png": Kind(*models.photo(".png")),
    "photo tif": Kind(*models.photo(".tif")),
    "photo exr": Kind(*models.photo(".exr")),
    "tile.toml": Kind(tables.tile, read_tile),
    "survey.toml": Kind(tables.survey, tables.read_survey_folder),
    "drive.toml": Kind(tables.written("drive.toml", tables.DRIVE), tables.read_drive_file),
    "settings.toml": Kind(tables.written("settings.toml", tomli_w.dumps(tables.SETTINGS)), tables.settings),
    "--set": Kind(tables.written("set.txt", SET_OPTIONS), tables.assignments, tables.every_setting),
    "photos.csv": Kind(tables.photos, tables.read_photos),
    "cameras.toml": Kind(tables.camera_file, tables.read_camera_file),
    "calibration": Kind(tables.calibration, tables.read_calibration),
    "trajectory csv": Kind(*tables.trajectory(".csv")),
    "trajectory tum": Kind(*tables.trajectory(".tum")),
    "trajectory kitti": Kind(*tables.trajectory(".kitti")),
    "gps gpx": Kind(*tables.track("g.gpx", gps.gpx("1.1"))),
    "gps nmea": Kind(*tables.track("g.nmea", gps.nmea())),
    "gps csv": Kind(*tables.track("g.csv", gps.table("time,latitude,longitude,altitude"))),
    "gps gopro": Kind(tables.video, lambda folder: gps_io.read(folder / "g.mp4"), tables.telemetry),
    "video": Kind(tables.video, models.read_video),
    "colmap txt": Kind(*models.colmap("txt")),
    "colmap bin": Kind(*models.colmap("bin")),
    **{name: Kind(*models.model(name)) for name in WRITERS},
    **{f"bag {form}": Kind(*bags.bag(form)) for form in BAG_FORMATS},
    "nuscenes": Kind(datasets.scene, datasets.read_scene),
    "pandaset": Kind(datasets.sequence, datasets.read_sequence),
    "kitti odometry": Kind(models.odometry, models.read_odometry),
    "kitti raw": Kind(models.kitti, models.read_kitti),
    "sweeps": Kind(models.drive, models.read_drive),
    "sweep bin": Kind(*models.sweep(".bin")),
    "sweep pcd": Kind(*models.sweep(".pcd")),
    "sweep ply": Kind(*models.sweep(".ply")),
    "result npz": Kind(models.result, lambda folder: inspect_path(folder / "r.npz")),
    "world": Kind(models.world, models.read_world),
}
