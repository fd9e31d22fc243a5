"""Step `splats` on a street whose houses the scan reached only up to 3 m: splats show the whole frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.renderer import Renderer
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.evaluate import psnr
from scan2sim.texturing.splats import step as splats_step
from scan2sim.texturing.splats.step import SplatsParams, splats
from scan2sim.texturing.splats.view import SplatRenderer
from tests.texturing.facade_street import HELD_OUT, NUMBER, SCANNED, FacadeDrive

PARAMS = SplatsParams(epochs=(4, 6, 0))


def run(drive: FacadeDrive, out: Path, params: SplatsParams = PARAMS) -> Done:
    (out / "out").mkdir(parents=True)
    (out / "checkpoint").mkdir()
    return splats(drive.inputs, params, out / "out", silent, out / "checkpoint")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> FacadeDrive:
    return FacadeDrive(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="module")
def layer(drive: FacadeDrive, tmp_path_factory: pytest.TempPathFactory) -> SplatLayer:
    return SplatLayer.load(run(drive, tmp_path_factory.mktemp("splats")).files["splats"])


def error_db(a: np.ndarray, b: np.ndarray) -> float:
    return psnr(float(((a.astype(float) - b) ** 2).mean()))


def test_the_whole_frame_of_a_held_out_photo_is_shown(drive: FacadeDrive, layer: SplatLayer) -> None:
    view = drive.views[HELD_OUT]
    photo = image.read_rgb(view.photo)
    scanned = Renderer(SCANNED).view(view.camera, view.T_world_cam, background=(200, 214, 230), samples=2).rgb
    shown = SplatRenderer(layer).view(view.camera, view.T_world_cam).rgb
    assert len(layer.photos) == NUMBER - 1, "the response of each photo of the training is stored"
    assert error_db(shown, photo) > max(22, error_db(scanned, photo) + 8)


def test_an_orthographic_view_is_rejected(layer: SplatLayer) -> None:
    camera = Camera("orthographic", 20, 10, 5.0, 5.0, 10.0, 5.0)
    with pytest.raises(SettingError, match="orthographic"):
        SplatRenderer(layer).view(camera, np.eye(4))


def test_depth_of_what_was_scanned(drive: FacadeDrive, layer: SplatLayer) -> None:
    view = drive.views[HELD_OUT]
    truth = Renderer(SCANNED).view(view.camera, view.T_world_cam)
    near = truth.hit & (truth.range < 20)
    found = SplatRenderer(layer).view(view.camera, view.T_world_cam).range
    assert np.median(np.abs(found[near] - truth.range[near])) < 0.15


def test_a_training_that_was_interrupted_continues_to_the_same_splats(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splats_step, "CHECKPOINT_S", 0.0)
    (tmp_path / "drive").mkdir()
    drive, params = FacadeDrive(tmp_path / "drive", number=4), SplatsParams(epochs=(3, 0, 0))
    whole = run(drive, tmp_path / "whole", params)

    class Interrupted(Exception):
        pass

    def interrupt(fraction: float, message: str = "") -> None:
        if fraction > 0.6:
            raise Interrupted

    (tmp_path / "out").mkdir()
    (tmp_path / "checkpoint").mkdir()
    with pytest.raises(Interrupted):
        splats(drive.inputs, params, tmp_path / "out", interrupt, tmp_path / "checkpoint")
    visits: list[float] = []

    def visit(fraction: float, message: str = "") -> None:
        visits.append(fraction)

    done = splats(drive.inputs, params, tmp_path / "out", visit, tmp_path / "checkpoint")
    assert sum(share > splats_step.TRAINING_SHARE for share in visits) < 3, "finished epochs are not repeated"
    assert done.files["splats"].read_bytes() == whole.files["splats"].read_bytes()


def test_a_vehicle_ahead_in_every_photo_is_not_shown(tmp_path: Path) -> None:
    red = FacadeDrive(tmp_path / "red", vehicle=True)
    (tmp_path / "red").mkdir()
    layer = SplatLayer.load(run(red, tmp_path, SplatsParams(epochs=(4, 0, 0))).files["splats"])
    view = red.views[HELD_OUT]
    shown = SplatRenderer(layer).view(view.camera, view.T_world_cam).rgb.astype(int)
    assert ((shown[..., 0] > 200) & (shown[..., 1] < 80)).mean() < 0.001


def test_fewer_than_two_photos_give_no_splats(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    done = run(FacadeDrive(tmp_path / "one", number=1), tmp_path)
    assert done.metrics["splats"] == 0 and not len(SplatLayer.load(done.files["splats"]).splats)
    assert "at least two photos" in done.warnings[0]


def test_photos_next_to_each_other_are_left_out(drive: FacadeDrive, tmp_path: Path) -> None:
    done = run(drive, tmp_path, SplatsParams(epochs=(0, 0, 0), max_photos=3))
    assert 2 <= done.metrics["photos"] <= 3


def test_epochs_out_of_range_are_rejected() -> None:
    with pytest.raises(ValueError, match="epochs"):
        SplatsParams(epochs=(1, -1, 0))
