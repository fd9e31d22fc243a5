"""Splats trained on photos of a synthetic street corner show it from poses between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole
from scan2sim.pipeline.core.types import Camera, View
from scan2sim.texturing.backdrop.photos import Photo
from scan2sim.texturing.splats import rasterizer
from scan2sim.texturing.splats.exposure import Gains
from scan2sim.texturing.splats.projection import Pinhole
from scan2sim.texturing.splats.shots import Shot, shots
from scan2sim.texturing.splats.start import first_background, first_splats
from scan2sim.texturing.splats.training import Schedule, Training
from tests.texturing.corner import BOX, GROUND, photograph

CAMERA = pinhole(160, 120, field=80)
SCHEDULE = Schedule(epochs=(3, 5, 5))
PATH = [look_at((-4.5, y, 1.8), (0, y / 2, 0.6)) for y in np.linspace(-2, 2, 6)]
BETWEEN = look_at((-4.5, 0.4, 1.8), (0, 0.2, 0.6))


def photo(pose: np.ndarray, camera: Camera = CAMERA, gain: float = 1.0, name: str = "photo") -> Photo:
    """A prepared photo of the corner, whose depth is known; above the horizon is sky."""
    image = Renderer([Body(GROUND), Body(BOX)]).view(camera, pose)
    rgb = np.round(photograph(camera, pose) * gain).astype(np.uint8)
    known = np.where(image.hit, image.range, np.inf).astype(np.float32)
    rays = np.nan_to_num(pixel_rays(camera).astype(np.float64)) @ pose[:3, :3].T
    view = View(name, camera, pose, Path("photo.png"))
    nothing = np.zeros(image.hit.shape, bool)
    return Photo(
        view, camera, rays, known, image.hit, ~image.hit, nothing, rgb.astype(np.float32), rgb >= 250, rgb, ~image.hit,
        rgb >= 250, nothing, np.zeros(image.hit.shape, np.float32),
    )  # fmt: skip


def begun(photos: list[Photo]) -> tuple[Training, list[Shot]]:
    """A training before its first epoch."""
    seen = [shot for one in photos for shot in shots(one, one.movable)]
    inverse = [np.where(np.isfinite(one.known), 1 / one.known, 0).astype(np.float32) for one in photos]
    first, size = first_splats(photos, inverse, [one.movable for one in photos])
    return Training.of(first, size, first_background(seen), len(photos)), seen


def trained(photos: list[Photo], schedule: Schedule = SCHEDULE) -> tuple[Training, list[Shot]]:
    training, seen = begun(photos)
    training.run(seen, schedule, lambda share, text: None)
    return training, seen


@pytest.fixture(scope="module")
def corner() -> Training:
    return trained([photo(pose, name=str(i)) for i, pose in enumerate(PATH)])[0]


def psnr(training: Training, pose: np.ndarray) -> float:
    (shot,) = shots(photo(pose), np.zeros((CAMERA.height, CAMERA.width), bool))
    drawn, behind = training.rendered(shot.levels[-1])
    return float(-10 * np.log10(np.square(np.clip(drawn.over(behind), 0, 1) - shot.rgb).mean()))


def test_a_pose_between_the_photos_is_shown_better_than_before_the_training(corner: Training) -> None:
    untrained, _ = trained([photo(pose, name=str(i)) for i, pose in enumerate(PATH)], Schedule(epochs=(0, 0, 0)))
    assert psnr(corner, BETWEEN) > max(28, psnr(untrained, BETWEEN) + 3)


def test_a_darker_photo_gets_a_gain_and_does_not_darken_the_world() -> None:
    gains = [1.0, 0.7, 1.0, 1.0, 0.7, 1.0]
    training, _ = trained([photo(pose, gain=gains[i], name=str(i)) for i, pose in enumerate(PATH)])
    relative = training.gains.gain.mean(axis=1)
    assert relative[[1, 4]].max() < 0.8 * relative[[0, 2, 3, 5]].min()


@pytest.mark.parametrize(
    "camera",
    [
        Camera("opencv", 160, 120, 95.0, 95.0, 79.5, 59.5, (-0.15, 0.03, 0.0005, -0.0005)),
        Camera("fisheye", 160, 160, 55.0, 55.0, 79.5, 79.5, (0.02, -0.003, 0.0, 0.0)),
        Camera("equirectangular", 240, 120),
    ],
    ids=lambda camera: camera.model,
)
def test_shots_of_other_cameras_are_pinhole_images_of_the_same_scene(camera: Camera) -> None:
    pose = PATH[2]
    taken = list(shots(photo(pose, camera), np.zeros((camera.height, camera.width), bool)))
    assert len(taken) == 1 if camera.model == "opencv" else len(taken) >= 3
    for shot in taken:
        truth = photograph(shot.camera, shot.T_world_cam) / 255
        error = np.abs(shot.rgb - truth).mean(axis=-1)[shot.usable]
        assert shot.usable.mean() > 0.05 and np.median(error) < 0.02


def test_a_training_continues_where_it_was_saved(tmp_path: Path) -> None:
    photos = [photo(pose, name=str(i)) for i, pose in enumerate(PATH[:3])]
    whole, _ = trained(photos, Schedule(epochs=(2, 1, 1)))
    stopped, seen = begun(photos)

    class Stop(Exception):
        pass

    def stop(share: float, text: str) -> None:
        stopped.save(tmp_path / "state.npz")
        if share >= 0.5:
            raise Stop

    with pytest.raises(Stop):
        stopped.run(seen, Schedule(epochs=(2, 1, 1)), stop)
    loaded = Training.load(tmp_path / "state.npz")
    loaded.run(seen, Schedule(epochs=(2, 1, 1)), lambda share, text: None)
    assert np.array_equal(loaded.descent.parameters, whole.descent.parameters)
    assert np.array_equal(loaded.background.texture, whole.background.texture)


def test_surfaces_are_covered_from_the_side(corner: Training) -> None:
    aside = look_at((-3.5, 2.5, 1.4), (0.5, 0, 0.5))
    drawn = rasterizer.render(corner.result().parameters, Pinhole.of(CAMERA, aside))
    hit = Renderer([Body(GROUND), Body(BOX)]).view(CAMERA, aside).hit
    assert (1 - drawn.transmittance)[hit].mean() > 0.9


def test_the_exposure_of_the_world_changes_without_changing_renderings(corner: Training) -> None:
    random = np.random.default_rng(1)
    gains = Gains(4)
    gains.gain, gains.offset = (random.uniform(*span, (4, 3)).astype(np.float32) for span in ((0.6, 1.5), (-0.1, 0.1)))
    world = random.uniform(0.2, 0.8, (5, 6, 3)).astype(np.float32)
    before = [gains.applied(k, world) for k in range(4)]
    factor, offset = gains.centre()
    after = [gains.applied(k, world * factor + offset) for k in range(4)]
    assert np.allclose(before, after, atol=1e-5)
    assert np.allclose(np.log(gains.gain).mean(axis=0), 0, atol=1e-5)
    assert np.allclose(gains.offset.mean(axis=0), 0, atol=1e-5)
