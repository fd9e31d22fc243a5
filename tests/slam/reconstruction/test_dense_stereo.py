"""Dense stereo: position of its cloud, and errors; COLMAP itself needs CUDA and is replaced by a fake."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import DataError, StepError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import clouds
from scan2sim.slam.steps.dense_stereo import DenseStereoParams, dense_stereo

FRAME = Frame("EPSG:32633", (391000.0, 5820000.0, 40.0))
XYZ = np.random.default_rng(0).uniform(-20, 20, (50, 3))


def inputs(folder: Path, model: str = "opencv", *, georeferenced: bool = True) -> dict[str, Path]:
    made = {"georeferenced": georeferenced, "lenses": {"camera_1": {"model": model}}}
    (folder / "reconstruction.json").write_text(json.dumps(made), encoding="utf-8")
    (folder / "frame.json").write_text(json.dumps(asdict(FRAME)), encoding="utf-8")
    return {"path": folder, "images": folder, "frame": folder / "frame.json"}


def test_dense_cloud_is_in_the_crs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def call(_: str, model: Path, images: Path, workspace: Path, out: Path, size: int, **__: Any) -> int:
        header = "ply\nformat ascii 1.0\nelement vertex 50\n" + "".join(f"property float {name}\n" for name in "xyz")
        rows = "".join(f"{x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in XYZ)
        out.write_text(f"{header}end_header\n{rows}", encoding="utf-8")
        return len(XYZ)

    monkeypatch.setattr(sandbox, "call", call)
    out = tmp_path / "out"
    out.mkdir()
    done = dense_stereo(inputs(tmp_path), DenseStereoParams(), out, silent)
    assert clouds.read_header(done.files["cloud"]).crs is not None
    found = clouds.read(done.files["cloud"], FRAME).xyz
    assert np.allclose(np.sort(found[:, 0]), np.sort(XYZ[:, 0]), atol=2e-3)
    assert [path.name for path in out.iterdir()] == ["cloud.laz"]


def test_failure_names_the_cloud_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def call(*_: Any, **__: Any) -> int:
        raise StepError("dense_stereo", "no CUDA device", "")

    monkeypatch.setattr(sandbox, "call", call)
    (tmp_path / "out").mkdir()
    with pytest.raises(StepError, match="no CUDA device. Give --cloud"):
        dense_stereo(inputs(tmp_path), DenseStereoParams(), tmp_path / "out", silent)


def test_photos_without_scale_and_panoramas_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="GPS doesn't give the scale.*--cloud"):
        dense_stereo(inputs(tmp_path, georeferenced=False), DenseStereoParams(), tmp_path, silent)
    with pytest.raises(DataError, match="shows panoramas.*--cloud"):
        dense_stereo(inputs(tmp_path, "equirectangular"), DenseStereoParams(), tmp_path, silent)
