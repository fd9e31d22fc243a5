"""Alignment of photos with a cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.core.errors import DataError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import read_photos
from scan2sim.pipeline.io.clouds import las
from scan2sim.slam.steps import place_photos
from scan2sim.slam.steps.reconstruct import Reconstructed, reconstruct
from tests.fakes import textured_street

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
