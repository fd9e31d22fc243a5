"""Alignment of photos with a cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import F64, Frame, PointCloud, Trajectory
from scan2sim.pipeline.importers.clouds_and_photos import read_photos
from scan2sim.pipeline.io import colmap_writer
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.clouds import las
from scan2sim.slam.reconstruction import photos as photos_io
from scan2sim.slam.steps import place_photos
from scan2sim.slam.steps.reconstruct import Reconstructed, reconstruct
from tests.fakes import exif_photos, textured_street
from tests.present import present

FRAME = Frame("EPSG:32633", (391000.0, 5820000.0, 40.0))


def test_only_points_near_the_photos_are_read_and_distant_clouds_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    xyz = np.random.default_rng(0).uniform(-300, 300, (200_000, 3)).astype(np.float32)
    las.write(tmp_path / "cloud.laz", PointCloud(FRAME, xyz))
    other = Frame(FRAME.crs, (391100.0, 5820000.0, 0.0))
    monkeypatch.setattr(place_photos, "MODEL", place_photos.AlignmentModel(points_max=4000))
    found = place_photos.points_near(tmp_path / "cloud.laz", other, np.array([[0.0, 0, 40], [10, 0, 40]]))
    assert 1500 < len(found) <= 4000 and found.frame == other
    assert np.linalg.norm(found.xyz[:, :2] - [5, 0], axis=1).max() < 66
    with pytest.raises(DataError, match=r"0 points within 60 m.*--crs"):
        place_photos.points_near(tmp_path / "cloud.laz", other, np.array([[5000.0, 0, 0]]))


def test_reconstruction_is_aligned_with_the_cloud(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    few = place_photos.AlignmentModel(sample_max=(5000, 15_000), climbed=1, groups=2, fine_steps_m=(0.12, 0.06))
    monkeypatch.setattr(place_photos, "MODEL", few)
    truth = textured_street.write(tmp_path, FRAME, 7)[:, :3, 3]
    shifts = [1.1, -0.8, 45.0] + np.random.default_rng(0).normal(size=truth.shape) * 0.2
    rows = [f"{i:02d}.jpg,{x},{y},{z}\n" for i, (x, y, z) in enumerate(FRAME.to_crs(truth + shifts))]
    (tmp_path / "rough.csv").write_text("file,x,y,z\n" + "".join(rows), encoding="utf-8")
    for name in ("checkpoint", "model", "placed"):
        (tmp_path / name).mkdir()
    photos, context = tmp_path / "photos", place_photos.PlaceContext(crs=FRAME.crs)
    made = reconstruct(
        {"photos": photos}, Reconstructed(features=1500), tmp_path / "model", silent, tmp_path / "checkpoint"
    )
    beside = {"images": photos, "cloud": tmp_path / "cloud.laz", "positions": tmp_path / "rough.csv"}
    done = place_photos.place_photos(
        {**made.files, **beside}, place_photos.PlaceParams(context=context), tmp_path / "placed", silent
    )
    shots, _ = read_photos(done.files["table"])
    errors = FRAME.to_local(np.array([shot["position"] for shot in shots])) - truth
    assert np.linalg.norm(errors, axis=1).max() < 0.3


def placed(folder: Path, T: F64, places: F64 | None, orientation: int = 1) -> Done:
    """Place the photos of a model without a scale.

    Args:
        folder: folder to write to.
        T: (P, 4, 4) their poses, metres.
        places: (P, 3) what their GPS says, None: nothing.
        orientation: that of their EXIF.
    """
    pytest.importorskip("pycolmap")
    names = [f"{i}.jpg" for i in range(len(T))]
    for i, name in enumerate(names):
        position = None
        if places is not None:
            lon, lat = Transformer.from_crs(FRAME.crs, "EPSG:4326", always_xy=True).transform(*places[i, :2])
            position = (lat, lon, places[i, 2])
        exif_photos.write(folder / "photos" / name, position=position, orientation=orientation)
    model, path = folder / "model", Trajectory(np.arange(float(len(T))), T[:, :3, 3] / 7, T[:, :3, :3])
    colmap_writer.write(model, path, textured_street.CAMERA, names)
    known = photos_io.write(folder / "photos.json", photos_io.read_headers(folder / "photos"))
    (folder / "summary.json").write_text("{}", encoding="utf-8")
    (folder / "out").mkdir()
    inputs = {"images": folder / "photos", "model": model, "photos": known, "summary": folder / "summary.json"}
    return place_photos.place_photos(inputs, place_photos.PlaceParams(), folder / "out", silent)


def test_gps_in_the_photos_gives_the_scale(tmp_path: Path) -> None:
    T = textured_street.poses(8, 4.0)
    done = placed(tmp_path, T, FRAME.to_crs(T[:, :3, 3]))
    assert done.metrics["georeferenced"] and done.metrics["scale"] == pytest.approx(7, rel=0.01)


def test_gps_of_one_spot_gives_no_scale_and_says_why(tmp_path: Path) -> None:
    spot = FRAME.to_crs(np.random.default_rng(0).normal(size=(8, 3)) * 3)
    done = placed(tmp_path, textured_street.poses(8, 4.0), spot)
    assert not done.metrics["georeferenced"]
    assert any("the GPS in the photos isn't used" in text for text in done.warnings)
    assert any("trajectory.csv isn't in metres" in text for text in done.warnings)


@pytest.mark.parametrize(("orientation", "degrees"), [(1, 0), (6, 90), (8, -90), (3, 180)])
def test_portraits_that_are_stored_on_their_side_are_placed_upright(
    orientation: int, degrees: float, tmp_path: Path
) -> None:
    """Along a line, GPS doesn't determine the roll; without GPS, nothing else says what is up."""
    T = textured_street.poses(8, 4.0)
    T[:, :3, 3] = T[0, :3, 3] + np.arange(8)[:, None] * [4.0, 0, 0]
    stored = T.copy()
    stored[:, :3, :3] = T[:, :3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    done = placed(tmp_path / "gps", stored, FRAME.to_crs(T[:, :3, 3]), orientation)
    turns = present(trajectory_io.read(done.files["path"] / "trajectory.csv", FRAME).rotations)
    errors = Rotation.from_matrix(np.einsum("nij,nkj->nik", turns, stored[:, :3, :3])).magnitude()
    assert np.degrees(errors).max() < 4  # the photos look 3 degrees down
    done = placed(tmp_path / "none", stored, None, orientation)
    turns = present(trajectory_io.read(done.files["path"] / "trajectory.csv").rotations)
    down = turns @ Rotation.from_euler("z", -degrees, degrees=True).as_matrix()[:, 1]
    assert down[:, 2].max() < -0.99


def test_too_few_photos_with_gps_are_counted(tmp_path: Path) -> None:
    images, params, warnings = tmp_path, place_photos.PlaceParams(), list[str]()
    for i in range(8):
        exif_photos.write(images / f"{i}.jpg", position=(52.5, 13.4 + i * 1e-4, 30) if i < 2 else None)
    photos = photos_io.read_headers(images)
    assert place_photos.approximate({"images": images}, photos, params, warnings.append) is None
    assert warnings == ["only 2 of 8 photos have GPS"]
    with pytest.raises(DataError, match="only 2 of 8 photos have GPS.*--gps TRACK"):
        place_photos.approximate({"images": images, "cloud": images}, photos, params, warnings.append)
