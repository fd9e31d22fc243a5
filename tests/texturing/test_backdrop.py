"""Step `backdrop` on a street whose houses the scan reached only up to 3 m, with a facade across its far end."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, textured
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.tile_cell import TileCell
from scan2sim.pipeline.core.types import F64, U8, Camera, Mesh
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.worlds.scene import BACKDROP_PARTS
from scan2sim.texturing.backdrop.dome import DOME_FILE, Dome
from scan2sim.texturing.backdrop.step import BackdropContext, BackdropParams, backdrop
from scan2sim.texturing.evaluate import psnr
from tests.texturing.facade_street import (
    CAMERA,
    END,
    HELD_OUT,
    NUMBER,
    SCANNED,
    SKY,
    UPPER,
    FacadeDrive,
)  # fmt: skip

LAYERS, DOME = range(len(BACKDROP_PARTS))


@dataclass
class Drive(FacadeDrive):
    """The drive, and the backdrop from its photos."""

    params: BackdropParams = field(default_factory=BackdropParams)

    @cached_property
    def done(self) -> Done:
        """Result of the step."""
        inputs = self.inputs
        (self.folder / "out").mkdir()
        return backdrop(inputs, self.params, self.folder / "out", silent)

    @property
    def body(self) -> Body:
        """The textured backdrop."""
        return textured(self.done.files["backdrop"])

    def layers(self) -> Mesh:
        """The layers without the dome."""
        mesh = self.body.mesh
        assert mesh.page is not None
        return mesh.keep(mesh.page == LAYERS)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return Drive(tmp_path_factory.mktemp("drive"))


def frame_psnr(bodies: list[Body], camera: Camera, pose: F64, photo: U8) -> float:
    shown = Renderer(bodies).view(camera, pose, background=(200, 214, 230), samples=2).rgb
    return psnr(float(((shown.astype(float) - photo) ** 2).mean()))


def test_backdrop_improves_the_whole_frame_of_a_held_out_photo(drive: Drive) -> None:
    view = drive.views[HELD_OUT]
    photo = image.read_rgb(view.photo)
    without = frame_psnr(SCANNED, view.camera, view.T_world_cam, photo)
    assert frame_psnr([*SCANNED, drive.body], view.camera, view.T_world_cam, photo) > without + 6


def test_parallax_is_right_beside_and_above_the_drive(drive: Drive) -> None:
    pose = look_at((4.0, 1.3, 3.7), (14.0, 1.0, 3.9))
    photo = Renderer([*SCANNED, *UPPER, END]).view(CAMERA, pose, background=SKY, samples=2).rgb
    assert frame_psnr([*SCANNED, drive.body], CAMERA, pose, photo) > frame_psnr(SCANNED, CAMERA, pose, photo) + 4


def test_depth_of_facades_within_ten_percent(drive: Drive) -> None:
    view = drive.views[HELD_OUT]
    truth = Renderer([*UPPER, END]).view(view.camera, view.T_world_cam)
    found = Renderer([Body(drive.layers())]).view(view.camera, view.T_world_cam)
    hidden = Renderer(SCANNED).view(view.camera, view.T_world_cam).hit
    for facade in (truth.body < 2, truth.body == 2):
        every = facade & truth.hit & ~hidden
        error = np.abs(found.range[every] / truth.range[every] - 1)  # inf where there is no layer
        assert np.median(error) < 0.07 and np.mean(error < 0.1) > 0.6


def test_layers_hide_neither_surfaces_nor_the_sky(drive: Drive) -> None:
    for i in (0, HELD_OUT, NUMBER - 1):
        view = drive.views[i]
        layers = Renderer([Body(drive.layers())]).view(view.camera, view.T_world_cam)
        surfaces = Renderer(SCANNED).view(view.camera, view.T_world_cam)
        assert np.mean(layers.range < 0.97 * surfaces.range, where=surfaces.hit) < 0.01
        sky = ~Renderer([*SCANNED, *UPPER, END]).view(view.camera, view.T_world_cam).hit
        sky = binary_erosion(sky, np.ones((3, 3)))  # without the pixels at outlines
        sky[CAMERA.height // 2 :] = False
        shown = Renderer([*SCANNED, drive.body]).view(view.camera, view.T_world_cam).rgb[sky]
        assert np.mean(np.abs(shown.astype(float) - SKY).max(axis=1) < 12) > 0.99


def test_no_gaps_where_photos_show_scenery(drive: Drive) -> None:
    for i in (1, HELD_OUT, NUMBER - 1):
        view = drive.views[i]
        truth = Renderer([*SCANNED, *UPPER, END]).view(view.camera, view.T_world_cam)
        shown = Renderer([*SCANNED, Body(drive.layers())]).view(view.camera, view.T_world_cam)
        assert np.mean(shown.hit[truth.hit]) > 0.98


def test_sky_extends_behind_the_camera(drive: Drive) -> None:
    behind = look_at((4.0, 0.0, 1.7), (-6.0, 0.0, 6.0))
    shown = Renderer([drive.body]).view(CAMERA, behind)
    assert shown.hit.all() and np.abs(shown.rgb.astype(float) - SKY).max() < 12


def test_layers_are_the_mean_of_photos_so_noise_is_reduced(tmp_path: Path) -> None:
    noisy = Drive(tmp_path, noise=15.0)
    view = noisy.views[HELD_OUT]
    clean = Renderer([*SCANNED, *UPPER, END]).view(view.camera, view.T_world_cam, background=SKY, samples=2)
    shown = Renderer([Body(noisy.layers()), *SCANNED]).view(view.camera, view.T_world_cam)
    end = (clean.body == 4) & (shown.body == 0)
    rgb = Renderer([noisy.body]).view(view.camera, view.T_world_cam).rgb
    apart = (rgb.astype(float) - clean.rgb)[end]
    assert end.sum() > 1000 and np.median(np.abs(apart)) < 0.5 * 0.6745 * 15.0


def test_moving_vehicles_are_left_out(tmp_path: Path) -> None:
    red = Drive(tmp_path, vehicle=True)
    view = red.views[HELD_OUT]
    rgb = Renderer([*SCANNED, red.body]).view(view.camera, view.T_world_cam).rgb.astype(int)
    assert np.mean((rgb[..., 0] > 220) & (rgb[..., 1] < 60)) < 0.0005


def test_layers_of_a_survey_tile_end_at_its_cell_without_a_dome(
    drive: Drive, tmp_path: Path
) -> None:  # fmt: skip
    cell = TileCell(name="a", seed=(0.0, 0.0), neighbours={"b": (40.0, 0.0)})
    params = BackdropParams(context=BackdropContext(cell=cell))
    tile, alone = backdrop(drive.inputs, params, tmp_path, silent).files["backdrop"], drive.done.files["backdrop"]
    mesh = textured(tile).mesh
    assert (Dome.load(tile).colour == image.read_rgb(alone / "page_1.png")).all()
    assert not (alone / DOME_FILE).exists()
    assert len(mesh) and mesh.page is not None and (mesh.page == LAYERS).all()
    assert mesh.corners.mean(axis=1)[:, 0].max() < 20.5


def test_single_photo_has_no_backdrop(tmp_path: Path) -> None:
    one = Drive(tmp_path, number=1)
    assert len(one.body.mesh) == 0 and one.done.metrics["photos"] == 1
