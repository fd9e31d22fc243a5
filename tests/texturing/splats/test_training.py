"""Splats trained on photos of a synthetic street corner show it from poses between them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_rays
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole
from scan2sim.pipeline.core.errors import StepError
from scan2sim.pipeline.core.splats import AXIS, GAIN, LOG_SCALE, SplatLayer
from scan2sim.pipeline.core.types import Camera, View
from scan2sim.texturing.backdrop.photos import Photo
from scan2sim.texturing.photo_cache import camera_of
from scan2sim.texturing.splats import background, rasterizer, start
from scan2sim.texturing.splats.descent import Descent
from scan2sim.texturing.splats.exposure import Gains, Response, falloff
from scan2sim.texturing.splats.projection import Pinhole
from scan2sim.texturing.splats.shots import SCALES, Shot, shots
from scan2sim.texturing.splats.start import first_background, first_splats
from scan2sim.texturing.splats.training import Schedule, Training
from scan2sim.texturing.splats.view import SplatRenderer
from tests.texturing.corner import BOX, GROUND, photograph

CAMERA = pinhole(160, 120, field=80)
SCHEDULE = Schedule(epochs=(3, 5, 5))
PATH = [look_at((-4.5, y, 1.8), (0, y / 2, 0.6)) for y in np.linspace(-2, 2, 6)]
BETWEEN = look_at((-4.5, 0.4, 1.8), (0, 0.2, 0.6))


def photo(
    pose: np.ndarray, camera: Camera = CAMERA, gain: float = 1.0, name: str = "photo", exposure: float = 0.0
) -> Photo:
    """A prepared photo of the corner, whose depth is known; above the horizon is sky.

    Args:
        pose, camera, name: of the photo.
        gain: its grey levels are multiplied by it, which its correction doesn't know.
        exposure: its correction, natural logarithm of the factor.
    """
    image = Renderer([Body(GROUND), Body(BOX)]).view(camera, pose)
    correction = np.array([exposure, exposure, exposure, 0, 0])
    response = Response.of(correction, np.ones((1, 1), np.float32))
    taken = response.shown(np.asarray(photograph(camera, pose) / 255, np.float32))
    rgb = np.clip(np.round(255 * gain * taken), 0, 255).astype(np.uint8)
    known = np.where(image.hit, image.range, np.inf).astype(np.float32)
    rays = np.nan_to_num(pixel_rays(camera).astype(np.float64)) @ pose[:3, :3].T
    view = View(name, camera, pose, Path("photo.png"))
    nothing = np.zeros(image.hit.shape, bool)
    return Photo(
        view, camera, rays, known, image.hit, ~image.hit, nothing, 255 * response.world(rgb), rgb >= 250, rgb,
        ~image.hit, correction, nothing, np.zeros(image.hit.shape, np.float32),
    )  # fmt: skip


def begun(photos: list[Photo]) -> tuple[Training, list[Shot]]:
    """A training before its first epoch."""
    seen = [shot for one in photos for shot in shots(one, one.movable, one.known)]
    inverse = [np.where(np.isfinite(one.known), 1 / one.known, 0).astype(np.float32) for one in photos]
    first, size = first_splats(photos, inverse, [one.movable for one in photos])
    return Training.of(first, size, first_background(seen), seen), seen


def trained(photos: list[Photo], schedule: Schedule = SCHEDULE) -> tuple[Training, list[Shot]]:
    training, seen = begun(photos)
    training.run(seen, schedule, lambda share, text: None)
    return training, seen


@pytest.fixture(scope="module")
def street() -> tuple[Training, list[Shot]]:
    return trained([photo(pose, name=str(i)) for i, pose in enumerate(PATH)])


@pytest.fixture(scope="module")
def corner(street: tuple[Training, list[Shot]]) -> Training:
    return street[0]


def psnr(training: Training, pose: np.ndarray) -> float:
    (shot,) = shots_of(photo(pose))
    drawn, behind = training.rendered(shot.levels[-1])
    return float(-10 * np.log10(np.square(np.clip(drawn.over(behind), 0, 1) - shot.rgb / 255).mean()))


def shots_of(one: Photo) -> list[Shot]:
    """All of a photo as shots."""
    return list(shots(one, np.zeros(one.known.shape, bool), one.known))


def test_a_pose_between_the_photos_is_shown_better_than_before_the_training(corner: Training) -> None:
    untrained, _ = trained([photo(pose, name=str(i)) for i, pose in enumerate(PATH)], Schedule(epochs=(0, 0, 0)))
    assert psnr(corner, BETWEEN) > max(28, psnr(untrained, BETWEEN) + 3)


def test_a_darker_photo_gets_a_gain_and_does_not_darken_the_world() -> None:
    gains = [1.0, 0.7, 1.0, 1.0, 0.7, 1.0]
    training, _ = trained([photo(pose, gain=gains[i], name=str(i)) for i, pose in enumerate(PATH)])
    relative = training.gains.gain.mean(axis=1)
    assert relative[[1, 4]].max() < 0.8 * relative[[0, 2, 3, 5]].min()


def test_a_darker_panorama_gets_one_gain_of_all_of_its_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faces that show nothing but sky don't decide."""
    for module in (background, start):  # no finer than the panoramas, so that all of them share texels
        monkeypatch.setattr(module, "WIDTH_PX", 240)
        monkeypatch.setattr(module, "HEIGHT_PX", 120)
    camera, gains = Camera("equirectangular", 240, 120), [1.0, 0.7, 1.0, 1.0]
    training, seen = trained([photo(pose, camera, gains[i], str(i)) for i, pose in enumerate(PATH[:4])])
    assert len(seen) >= 4 * 5 and len(training.gains.gain) == 4
    relative = training.gains.gain.mean(axis=1)
    assert relative[1] < 0.8 * relative[[0, 2, 3]].min() and np.ptp(relative[[0, 2, 3]]) < 0.15
    rows, cameras = training.photos(seen)
    assert cameras == ("_240x120",) and not rows[:, AXIS].any()
    assert rows[:, GAIN].mean(axis=1) == pytest.approx(relative)


def test_photos_of_other_exposures_are_shown_by_their_corrections() -> None:
    """Little of it remains for the gains, and each photo is shown as it was taken."""
    taken = [photo(pose, name=str(i), exposure=0.25 * (i % 2)) for i, pose in enumerate(PATH)]
    training, seen = trained(taken)
    bright, dark = (training.gains.gain[first::2].mean() for first in (0, 1))
    assert dark / bright == pytest.approx(1, abs=0.05)
    layer = SplatLayer(training.result(seen), training.background.texture, *training.photos(seen))
    bright, dark = (layer.photos[first::2, GAIN].mean() for first in (0, 1))
    assert dark / bright == pytest.approx(np.exp(-0.25), abs=0.05)
    errors = []
    for as_photo in (camera_of(taken[3].view), None):
        shown = SplatRenderer(layer).view(CAMERA, PATH[3], as_photo=as_photo).rgb
        errors.append(np.abs(shown.astype(float) - taken[3].raw).mean())
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("size", [(320, 240), (160, 120), (96, 72)])
def test_known_depth_is_that_of_the_depth_map_in_each_size(size: tuple[int, int]) -> None:
    """A quarter of a size hasn't the depth of any of its pixels, but that in their middle."""
    one = photo(BETWEEN)
    image = Renderer([Body(GROUND), Body(BOX)]).view(CAMERA.resized(*size), BETWEEN)
    scanned = np.where(image.hit, image.range, np.inf).astype(np.float32)
    one.known = np.full_like(one.known, np.inf)  # no surface
    (shot,) = shots(one, one.movable, scanned)
    for level, scale in zip(shot.levels, SCALES, strict=True):
        camera = CAMERA.resized(CAMERA.width // scale, CAMERA.height // scale)
        rays = pixel_rays(camera).astype(np.float64)
        truth = Renderer([Body(GROUND), Body(BOX)]).view(camera, BETWEEN).range * rays[..., 2]
        known = level.known > 0
        error = np.abs(level.known - truth)[known]
        assert known.mean() > 0.2 and np.median(error) < 0.003 and np.quantile(error, 0.98) < 0.02


def test_depth_is_unknown_at_edges_and_of_the_surface_where_nothing_was_scanned() -> None:
    one = photo(BETWEEN)
    scanned = one.known.copy()
    scanned[:, :80] = np.inf
    one.known = one.known + np.where(np.arange(160) < 80, 0, 1).astype(np.float32)
    (shot,) = shots(one, one.movable, scanned)
    distance = 1 / np.maximum(shot.inverse, 1e-6)
    assert np.allclose(distance[110, :75], one.known[110, :75], rtol=1e-4)
    assert np.allclose(distance[110, 85:], scanned[110, 85:], rtol=1e-4)
    box = Renderer([Body(GROUND), Body(BOX)]).view(CAMERA, BETWEEN).body == 1
    outline = box[:, 90:] ^ np.roll(box, 1, axis=0)[:, 90:]
    assert outline.any() and not shot.inverse[:60, 90:][outline[:60]].any()


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
    taken = shots_of(photo(pose, camera))
    assert len(taken) == 1 if camera.model == "opencv" else len(taken) >= 3
    for shot in taken:
        truth = photograph(shot.camera, shot.T_world_cam)
        assert np.array_equal(shot.axis, [0, 0, 0] if camera.model == "equirectangular" else pose[:3, 2])
        error = np.abs(shot.rgb - truth).mean(axis=-1)[shot.used]
        assert shot.used.mean() > 0.05 and np.median(error) < 5


def test_pixels_are_clipped_in_reduced_sizes_where_most_of_them_are() -> None:
    """Their mean would be a colour that the scene hasn't."""
    one = photo(BETWEEN)
    one.raw[:2, :4, 0] = [[255, 251, 255, 250], [40, 250, 40, 40]]
    one.raw[:2, :4, 1] = 100
    (shot,) = shots_of(one)
    half = shot.levels[1].rgb
    assert SCALES[1] == 2 and half[0, :2, 0].tolist() == [255, 146] and (half[0, :2, 1] == 100).all()
    assert np.array_equal(shot.levels[2].rgb, one.raw)


def test_a_training_that_diverged_stops_and_is_not_saved(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    training, seen = begun([photo(pose, name=str(i)) for i, pose in enumerate(PATH[:2])])
    training.descent.parameters[0, 0] = np.nan
    reports: list[float] = []
    with pytest.raises(StepError, match=r"diverged: 1 splats aren't finite"):
        training.run(seen, Schedule(epochs=(2, 0, 0)), lambda share, text: reports.append(share))
    assert not reports
    training.descent.parameters[0, 0], training.gains.offset[1] = 0, np.inf
    with pytest.raises(StepError, match="1 offsets of photos"):
        training.save(file)
    assert not file.exists()


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


def test_surfaces_are_covered_from_the_side(street: tuple[Training, list[Shot]]) -> None:
    training, seen = street
    aside = look_at((-3.5, 2.5, 1.4), (0.5, 0, 0.5))
    drawn = rasterizer.render(training.result(seen).parameters, Pinhole.of(CAMERA, aside))
    hit = Renderer([Body(GROUND), Body(BOX)]).view(CAMERA, aside).hit
    assert (1 - drawn.transmittance)[hit].mean() > 0.9


def test_the_exposure_of_the_world_changes_without_changing_renderings(corner: Training) -> None:
    random = np.random.default_rng(1)
    gains = Gains(np.arange(4, dtype=np.int32))
    gains.gain, gains.offset = (random.uniform(*span, (4, 3)).astype(np.float32) for span in ((0.6, 1.5), (-0.1, 0.1)))
    world = random.uniform(0.2, 0.8, (5, 6, 3)).astype(np.float32)
    exposed = [Response.of(np.array([0.1 * k, 0, -0.1 * k, 0, 0]), falloff(0.2, 0.1, 5, 6)) for k in range(4)]
    before = [gains.response(k, exposed[k]).shown(world) for k in range(4)]
    factor, offset = gains.centre()
    after = [gains.response(k, exposed[k]).shown(world * factor + offset) for k in range(4)]
    assert np.allclose(before, after, atol=1e-5)
    assert np.allclose(np.log(gains.gain).mean(axis=0), 0, atol=1e-5)
    assert np.allclose(gains.offset.mean(axis=0), 0, atol=1e-5)


def test_what_no_photo_shows_is_left_out(street: tuple[Training, list[Shot]]) -> None:
    """Two large splats behind all cameras: haze in the view of who stands farther back."""
    training, seen = street
    shown = len(training.result(seen))
    assert shown > 0.9 * len(training.descent.parameters)
    unseen = training.descent.parameters[:2].copy()
    unseen[:, :3] = (-6.5, 0, 1.8), (-6.5, 0.5, 1.2)
    unseen[:, LOG_SCALE] = np.log(0.5)
    more = np.concatenate([training.descent.parameters, unseen])
    grown = Training(Descent(more, np.ones(len(more), np.float32)), training.background, training.gains)
    assert len(grown.result(seen)) == shown
    back = look_at((-8.5, 0, 1.8), (0, 0, 0.6))
    (shot,) = shots_of(photo(back))
    clear, hazy = (
        rasterizer.render(one, shot.levels[-1].camera).over(np.ones((*shot.rgb.shape,), np.float32))
        for one in (grown.result(seen).parameters, grown.descent.parameters)
    )
    assert np.abs(clear - hazy).mean() > 0.05
