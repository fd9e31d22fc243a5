"""Textures of a synthetic street corner against its known colours."""

import json
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from scan2sim.pipeline.camera.renderer import Renderer, look_at, textured
from scan2sim.pipeline.core.classes import CODE, colour_of
from scan2sim.pipeline.core.types import F64, U8, Camera, Frame, Mesh
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.inpainting import hole_filling
from tests.present import present
from tests.texturing.corner import BOX, CAMERAS, GROUND, POSES, Street, paint, photograph, points

LOW, HIGH = (-5, -5, 0), (5, 5, 3)


def from_above(folder: Path, width: int = 200) -> tuple[F64, U8, F64, F64, F64]:
    """Orthographic view of the textured ground: rgb (H, W, 3), seen (H, W), true colours (H, W, 3), x and y (H, W)."""
    image = Renderer([textured(folder)]).above(LOW, HIGH, width=width)
    x, y = np.meshgrid(-5 + (np.arange(width) + 0.5) * 10 / width, 5 - (np.arange(width) + 0.5) * 10 / width)
    return image.rgb.astype(float), image.seen, np.clip(paint(np.stack([x, y, 0 * x], axis=-1)), 0, 255), x, y


def away_from_the_box(x: F64, y: F64) -> npt.NDArray[np.bool_]:
    """(H, W) ground outside the box and farther from it than the bias of the depth test."""
    return (abs(x - 0.5) > 0.65) | (abs(y) > 1.15)


def psnr(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> float:
    return float(10 * np.log10(255**2 / ((a - b) ** 2).mean()))


@pytest.mark.parametrize("name", CAMERAS)
def test_texture_equals_the_true_colours(street: Street, name: str) -> None:
    for pose in POSES:
        street.add(CAMERAS[name], pose)
    street.clouds["terrain"] = points()
    folder, done = street.run()
    rgb, seen, truth, x, y = from_above(folder)
    near = (seen == 255) & (x < 1) & away_from_the_box(x, y) & (abs(y) < 4.9)
    assert near.mean() > 0.2
    assert psnr(rgb[near], truth[near]) > 30
    assert done.metrics["photos"] == 4
    assert done.metrics["seen_m2"] == pytest.approx(100 * done.metrics["coverage"], rel=0.02)


def test_hidden_ground_does_not_get_the_colour_of_the_box(street: Street) -> None:
    street.add(CAMERAS["pinhole"], look_at((-4, 0, 1.2), (0, 0, 0.6)))
    street.clouds["terrain"] = points(rgb=(0, 255, 0))
    folder, done = street.run()
    rgb, seen, _, x, y = from_above(folder)
    behind = (x > 1.2) & (x < 4) & (abs(y) < 1)
    assert (seen[behind] == 128).mean() > 0.99
    assert (rgb[behind] == [0, 255, 0]).all(axis=-1).mean() > 0.99
    red = (rgb[..., 0] > 170) & (rgb[..., 1] < 90)
    assert red[away_from_the_box(x, y)].mean() < 0.003
    assert 0 < done.metrics["coverage"] < 1


def test_wall_is_textured_on_its_front_only(street: Street) -> None:
    street.mesh = BOX
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    folder, _ = street.run()
    image = Renderer([textured(folder)]).view(CAMERAS["pinhole"], look_at((-4, 0.3, 1.0), (0, 0, 1)))
    truth = photograph(CAMERAS["pinhole"], look_at((-4, 0.3, 1.0), (0, 0, 1)), meshes=(BOX,))
    assert (image.seen[image.hit] == 255).mean() > 0.95
    assert psnr(image.rgb[image.hit].astype(float), truth[image.hit].astype(float)) > 28
    back = Renderer([textured(folder)]).view(CAMERAS["pinhole"], look_at((5, 0, 1.0), (0, 0, 1)))
    assert (back.seen[back.hit] != 255).mean() > 0.9


def test_nearer_photo_has_more_weight(street: Street) -> None:
    camera = CAMERAS["pinhole"]
    white, black = np.full((480, 640, 3), 220, np.uint8), np.full((480, 640, 3), 20, np.uint8)
    street.occluders = (GROUND,)
    street.add(camera, look_at((-4.5, 0, 2), (-2, 0, 0)), white)
    street.add(camera, look_at((4.5, 0, 2), (2, 0, 0)), black)
    rgb, _, _, x, y = from_above(street.run(feather=0.001, exposure={"solve": False})[0])
    lit = abs(y) < 0.5
    assert rgb[lit & (x > -3) & (x < -1.5)].mean() > 195
    assert rgb[lit & (x < 3) & (x > 1.5)].mean() < 45
    assert 60 < rgb[lit & (abs(x) < 0.1)].mean() < 180


def test_higher_power_gives_sharper_transitions(street: Street) -> None:
    camera = CAMERAS["pinhole"]
    street.occluders = (GROUND,)
    street.add(camera, look_at((-4.5, 0, 2), (-2, 0, 0)), np.full((480, 640, 3), 220, np.uint8))
    street.add(camera, look_at((4.5, 0, 2), (2, 0, 0)), np.full((480, 640, 3), 20, np.uint8))
    soft, sharp = (from_above(street.run(power=p, exposure={"solve": False})[0])[0][100, 85] for p in (0.5, 4.0))
    assert sharp.mean() > soft.mean() + 10


def test_unseen_texels_take_point_colours(street: Street) -> None:
    street.clouds["terrain"] = points()
    folder, done = street.run()
    rgb, seen, truth, _, _ = from_above(folder)
    assert (seen == 128).all()
    assert psnr(rgb, truth) > 25  # of points 5 cm apart
    assert done.metrics["coverage"] == 0 and done.metrics["coloured_m2"] == pytest.approx(100, rel=0.02)


def test_grey_points_without_colour_are_not_used(street: Street) -> None:
    cloud = points()
    grey = cloud.xyz[:, 0] > 0.5
    present(cloud.rgb)[grey] = 128
    street.clouds["terrain"] = cloud
    rgb, seen, truth, x, _ = from_above(street.run()[0])
    assert (seen[x < 0] == 128).all() and (seen[x > 1] == 64).all()
    far = x > 1
    assert (rgb[far] == 128).all(axis=-1).mean() < 0.01  # flat grey marks texels without any information
    assert abs(rgb[far].mean() - truth[x < 0].mean()) < 25


def test_unseen_ground_is_inpainted(street: Street) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    cloud = points()
    present(cloud.rgb)[:] = 128
    street.clouds["terrain"] = cloud
    flat, *_ = from_above(street.run()[0])
    folder, done = street.run(inpaint=True)
    rgb, seen, truth, x, y = from_above(folder)
    unseen = (seen == 64) & away_from_the_box(x, y)
    assert unseen.mean() > 0.01 and done.metrics["filled_m2"] > 1

    def mean_error(image: F64) -> float:
        return float(np.abs(image - truth)[unseen].mean())

    assert mean_error(rgb) < 0.8 * mean_error(flat) and mean_error(rgb) < 0.6 * np.abs(128 - truth)[unseen].mean()
    # equal except where bilinear lookups mix seen and filled texels
    assert (flat[seen == 255] == rgb[seen == 255]).all(axis=-1).mean() > 0.97


def test_dark_ground_below_a_removed_car_is_inpainted(street: Street) -> None:
    camera, pose = CAMERAS["pinhole"], look_at((-4.5, 0, 3.0), (-1, 0, 0))
    street.occluders = (GROUND,)
    photo = photograph(camera, pose, meshes=(GROUND,))
    corners = (GROUND.vertices * [0.2, 0.1, 1] - [1.5, 0, 0]).astype(np.float32)
    below = photograph(camera, pose, meshes=(Mesh(Frame(), corners, GROUND.faces),))
    photo[np.abs(below.astype(int) - [200, 214, 230]).sum(axis=-1) > 0] = 5  # shadow of the car: 2 x 1 m
    street.add(camera, pose, photo)
    street.clouds["terrain"] = points()

    def black(rgb: F64) -> int:
        return int((rgb.max(axis=-1) < 30).sum())

    before = black(from_above(street.run(inpaint=True, exposure={"solve": False})[0])[0])
    ring = [[-2.6, -0.6], [-0.4, -0.6], [-0.4, 0.6], [-2.6, 0.6], [-2.6, -0.6]]
    car = {"kind": "car", "moved": False}
    feature = {"type": "Feature", "properties": car, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    street.files["instances"] = street.folder / "instances.geojson"
    street.files["instances"].write_text(
        json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8"
    )
    rgb, seen, _, x, y = from_above(street.run(inpaint=True, exposure={"solve": False})[0])
    assert before > 500 and black(rgb) < 0.02 * before
    assert not (seen[(abs(x + 1.5) < 1.0) & (abs(y) < 0.5)] == 255).any()


def test_colours_of_the_rest_cloud_are_not_used(street: Street) -> None:
    street.clouds["terrain"], street.clouds["rest"] = points(rgb=(10, 200, 10)), points(rgb=(255, 0, 0))
    rgb, *_ = from_above(street.run()[0])
    assert (rgb == [10, 200, 10]).all()


def test_points_without_colours_give_class_colours(street: Street) -> None:
    street.clouds["terrain"] = points(colour=False)
    folder, done = street.run()
    rgb, seen, *_ = from_above(folder)
    assert (seen == 64).all()
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) == 1 and rgb[0, 0].tolist() == pytest.approx(
        [110, 110, 118], abs=4
    )
    assert done.metrics["filled_m2"] == pytest.approx(100, rel=0.02)


def test_class_colours_of_the_ground_are_those_of_ground_points(street: Street) -> None:
    furniture = points(colour=False)
    furniture.xyz[:, 2] = 0.01
    present(furniture.classification)[:] = CODE["furniture"]
    street.clouds["terrain"], street.clouds["furniture"] = points(colour=False, n=4_000), furniture
    rgb, *_ = from_above(street.run(context={"surface": "terrain"})[0])
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) == 1
    street.clouds["terrain"] = points(colour=False, n=0)
    rgb, *_ = from_above(street.run(context={"surface": "terrain"})[0])
    assert abs(rgb[0, 0] - colour_of()[CODE["furniture"]]).max() < 6  # better than grey


def test_without_point_colours_unseen_texels_take_colours_of_seen_neighbours(street: Street) -> None:
    street.add(CAMERAS["pinhole"], POSES[1], np.full((480, 640, 3), (20, 90, 200), np.uint8))
    street.clouds["terrain"] = points(colour=False)
    rgb, seen, *_ = from_above(street.run()[0])
    assert (seen == 64).any() and (seen == 255).any()
    assert (rgb[seen == 64] == [20, 90, 200]).all(axis=1).mean() > 0.95


def test_texture_is_grey_without_photos_and_points(street: Street) -> None:
    rgb, seen, *_ = from_above(street.run()[0])
    assert (rgb == 128).all() and (seen == 64).all()


def test_masked_pixels_are_not_used(street: Street) -> None:
    camera, pose = CAMERAS["pinhole"], POSES[1]
    image = photograph(camera, pose)
    image[240:, :320] = (255, 0, 255)  # ego vehicle
    mask = np.full((480, 640), 255, np.uint8)
    mask[240:, :320] = 0
    street.add(camera, pose, image, mask)
    street.clouds["terrain"] = points()
    rgb, seen, *_ = from_above(street.run()[0])
    assert (seen == 255).any()
    magenta = (rgb[..., 0] > 200) & (rgb[..., 1] < 60) & (rgb[..., 2] > 200)
    assert magenta.sum() == 0


def test_unreadable_photos_are_skipped_and_reported(street: Street) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    street.views[1].photo.write_bytes(b"broken")
    cv2.imwrite(str(street.views[2].photo), np.zeros((10, 10, 3), np.uint8))
    street.clouds["terrain"] = points()
    folder, done = street.run()
    assert any("photo1.png" in warning for warning in done.warnings)
    assert any("photo2.png" in warning and "10 x 10" in warning for warning in done.warnings)
    assert done.metrics["photos"] == 2
    rgb, seen, truth, x, y = from_above(folder)
    near = (seen == 255) & (x < 1) & away_from_the_box(x, y) & (abs(y) < 4.9)
    assert psnr(rgb[near], truth[near]) > 30


def test_held_out_photos_are_never_used(street: Street) -> None:
    street.add(CAMERAS["pinhole"], POSES[1])
    street.add(CAMERAS["pinhole"], POSES[2], np.full((480, 640, 3), (255, 0, 255), np.uint8))
    street.held_out = (False, True)
    street.clouds["terrain"] = points()
    folder, done = street.run()
    rgb, *_ = from_above(folder)
    assert not ((rgb[..., 0] > 200) & (rgb[..., 1] < 60)).any()
    assert list(done.metrics["texels_by_photo"]) == ["photo0"]


def test_grey_and_sixteen_bit_photos_are_read(street: Street) -> None:
    view = street.add(CAMERAS["pinhole"], POSES[1])
    grey = cv2.imread(str(view.photo), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(view.photo), grey.astype(np.uint16) * 257)
    rgb, seen, *_ = from_above(street.run()[0])
    assert (seen == 255).any()
    assert np.ptp(rgb[seen == 255], axis=1).max() <= 1


def test_results_are_byte_identical_on_any_number_of_threads(street: Street) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    cloud = points()
    present(cloud.rgb)[len(cloud) // 2 :] = 128  # no colour: inpainted
    street.clouds["terrain"] = cloud
    one = street.run(inpaint=True)[0]
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        two = street.run(inpaint=True)[0]
    finally:
        numba.set_num_threads(threads)
    for name in ("page_0.png", "page_0_seen.png"):
        assert (one / name).read_bytes() == (two / name).read_bytes()


def test_padding_in_parts_equals_padding_of_whole_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    seen = np.where(rng.random((300, 200)) < 0.003, 255, 0).astype(np.uint8)
    seen[120:200] = 0
    whole = np.where(seen[..., None] > 0, rng.integers(1, 255, (300, 200, 3)), 0).astype(np.uint8)
    parts = whole.copy()
    hole_filling.pad(whole, seen, 12)
    monkeypatch.setattr(hole_filling, "PADDING_ROWS", 32)
    hole_filling.pad(parts, seen, 12)
    assert (parts == whole).all()
    assert (whole[seen == 0] > 0).any(axis=1).all()


def test_charts_are_padded_with_their_colours(street: Street) -> None:
    street.mesh, street.clouds["terrain"] = BOX, points(rgb=(200, 10, 10))
    folder, _ = street.run()
    page = cv2.imread(str(folder / "page_0.png"))[..., ::-1]
    seen = cv2.imread(str(folder / "page_0_seen.png"), cv2.IMREAD_GRAYSCALE)
    assert (seen == 0).any()
    assert (abs(page.astype(int) - [200, 10, 10]) <= 1).all()


def test_empty_mesh_is_accepted(street: Street) -> None:
    street.mesh = Mesh(Frame(), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    folder, done = street.run()
    assert len(Mesh.load(folder / "mesh.npz")) == 0
    assert done.metrics["area_m2"] == 0


def test_no_seams_between_pages(street: Street) -> None:
    street.clouds["terrain"] = points()
    street.texel, street.page_size = 0.01, 512
    folder, done = street.run()
    assert done.metrics["pages"] > 3 and len(list(folder.glob("page_?.png"))) == done.metrics["pages"]
    rgb, _, truth, *_ = from_above(folder)
    assert np.abs(rgb - truth).max() < 12  # grey levels, at the seams, too


def test_views_are_unchanged_by_saving_and_loading(street: Street, tmp_path: Path) -> None:
    view = street.add(CAMERAS["opencv"], POSES[0], mask=np.zeros((480, 640), np.uint8))
    views_io.save(tmp_path / "v.json", [view], [True])
    (read,) = views_io.load(tmp_path / "v.json")
    assert read.camera == view.camera and read.photo == view.photo and read.mask == view.mask
    np.testing.assert_array_equal(read.T_world_cam, view.T_world_cam)
    assert views_io.load_held_out(tmp_path / "v.json") == (True,)
    assert json.loads(json.dumps(views_io.to_json(view, with_paths=False)))["photo"] == view.photo.name


@pytest.mark.parametrize("kind", ["16 bit", "grey", "cmyk"])
def test_photos_of_other_pixel_formats_are_read(street: Street, kind: str) -> None:
    for pose in POSES:
        view = street.add(CAMERAS["pinhole"], pose)
        photo = photograph(CAMERAS["pinhole"], pose)
        if kind == "16 bit":
            cv2.imwrite(str(view.photo), photo[..., ::-1].astype(np.uint16) * 257)
        elif kind == "grey":
            cv2.imwrite(str(view.photo), cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
        else:
            Image.fromarray(photo).convert("CMYK").save(view.photo, "JPEG", quality=95)
    folder, done = street.run()
    rgb, seen, truth, x, y = from_above(folder)
    near = (seen == 255) & (x < 1) & away_from_the_box(x, y) & (abs(y) < 4.9)
    if kind == "grey":
        truth = np.repeat((truth @ [0.299, 0.587, 0.114])[..., None], 3, axis=-1)
    assert near.mean() > 0.2 and done.metrics["photos"] == 4
    assert psnr(rgb[near], truth[near]) > 28


def test_orthophoto_textures_ground_and_roof_but_no_facade(street: Street) -> None:
    down = np.diag([1.0, -1, -1, 1])
    down[2, 3] = 30.0
    camera = Camera("orthographic", 480, 480, 40.0, 40.0, 239.5, 239.5)  # 12 m, 2.5 cm per pixel
    street.add(camera, down)
    folder, done = street.run()
    rgb, seen, truth, x, y = from_above(folder)
    clear = away_from_the_box(x, y) & (abs(x) < 4.9) & (abs(y) < 4.9)
    assert (seen[clear] == 255).mean() > 0.99
    assert psnr(rgb[clear], truth[clear]) > 30
    under = (abs(x - 0.5) < 0.3) & (abs(y) < 0.8)
    assert not (seen[under] == 255).any()
    assert done.metrics["photos"] == 1

    street.mesh, street.folder = BOX, street.folder / "box"
    street.folder.mkdir()
    folder, _ = street.run()
    side = Renderer([textured(folder)]).view(CAMERAS["pinhole"], look_at((-4, 0, 0.6), (0, 0, 0.6)))
    assert not (side.seen[side.hit] == 255).any()
    top = Renderer([textured(folder)]).view(camera, down)
    assert (top.seen[top.hit] == 255).mean() > 0.98
