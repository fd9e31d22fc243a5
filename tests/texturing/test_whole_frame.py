"""Whole-frame score: backdrops behind surfaces, and excluded pixels of vehicles."""

import json
from pathlib import Path

import numpy as np
import pytest

from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.camera.renderer import Body, Renderer, look_at, pinhole
from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.types import F32, U8, Bools, Frame, Mesh, View
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.evaluate import BAND_NAMES, HeldOut, held_out
from scan2sim.texturing.whole_frame import box_mesh, left_out, whole_frame

CAMERA = pinhole(256, 192, field=80)
POSE = look_at((-4, 0, 2), (4, 0, 2))
SKY = (120, 160, 230)


def plate(x: float, low: float, high: float, half: float = 30.0) -> Mesh:
    """A wall across x, from height `low` to `high`."""
    corners = [(x, -half, low), (x, half, low), (x, half, high), (x, -half, high)]
    return Mesh(Frame(), np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def ground() -> Mesh:
    corners = [(-5, -30, 0), (4, -30, 0), (4, 30, 0), (-5, 30, 0)]
    return Mesh(Frame(), np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


@pytest.fixture
def photo(tmp_path: Path) -> View:
    """A photo of grey ground, a brown wall behind it, and the sky."""
    shown = Renderer([Body(ground(), colour=(90, 90, 90)), Body(plate(4, 0, 3), colour=(150, 90, 40))], SKY)
    image.write(tmp_path / "photo.png", shown.view(CAMERA, POSE).rgb)
    return View("photo", CAMERA, POSE, tmp_path / "photo.png")


def scored(view: View, surfaces: list[Body], colour: tuple[int, int, int] = SKY) -> HeldOut:
    (result,) = held_out(Renderer(surfaces, colour), [view])
    return result


GROUND = Body(ground(), colour=(90, 90, 90))
NOTHING: F32 = np.full((192, 256), np.inf, np.float32)


def test_world_equal_to_the_street_has_no_error(photo: View) -> None:
    wall = Body(plate(4, 0, 3), colour=(150, 90, 40))
    frame = whole_frame(scored(photo, [GROUND, wall]), 2, NOTHING)
    assert frame is not None and frame.mask.all() and frame.excluded == 0
    assert np.nanmean(frame.errors.squared) < 3 and frame.ms_ssim > 0.97
    assert set(np.unique(frame.by_class)) == {0, 1, 3}  # ground, wall, no surface
    assert frame.by_distance[0, 0] == len(BAND_NAMES) and frame.by_distance[-1, 128] < 2


def test_missing_wall_is_an_error_that_a_backdrop_removes(photo: View) -> None:
    result = scored(photo, [GROUND])
    missing = whole_frame(result, 1, NOTHING)
    behind = Renderer([Body(plate(20, -4, 5, 90), colour=(150, 90, 40))], SKY)  # as large from the camera
    shown = whole_frame(result, 1, NOTHING, backdrop=behind)
    assert missing is not None and shown is not None
    wall = (missing.by_class > 0) & (image.read_rgb(photo.photo)[..., 2] == 40)
    assert missing.errors.squared[wall].mean() > 5000 and shown.errors.squared[wall].mean() < 50
    np.testing.assert_array_equal(shown.by_class, missing.by_class)  # a backdrop isn't a surface
    np.testing.assert_array_equal(result.render.rgb, missing.rgb)


def test_backdrop_in_front_of_a_surface_hides_it(photo: View) -> None:
    wall = Body(plate(4, 0, 3), colour=(150, 90, 40))
    frame = whole_frame(scored(photo, [GROUND, wall]), 2, NOTHING, backdrop=Renderer([Body(plate(1, 0, 9))], SKY))
    assert frame is not None
    assert (frame.rgb[frame.by_class == 1] == 200).all()  # the colour of the plate


def test_sky_is_distinguished_from_missing_surfaces_by_photo_classes(photo: View) -> None:
    labels = np.zeros((48, 64, len(PHOTO_CLASSES)), np.uint8)
    labels[..., PHOTO_CLASSES.index("building")] = 100
    labels[:10, :, PHOTO_CLASSES.index("sky")] = 200
    frame = whole_frame(scored(photo, [GROUND]), 1, NOTHING, labels)
    assert frame is not None and (frame.by_class[:40] == 1).all() and 2 in frame.by_class[40:]


def movable(rows: slice, columns: slice) -> U8:
    """Probabilities of a photo that shows a vehicle in a rectangle."""
    labels = np.zeros((192, 256, len(PHOTO_CLASSES)), np.uint8)
    labels[..., PHOTO_CLASSES.index("building")] = 100
    labels[rows, columns, PHOTO_CLASSES.index("vehicle")] = 200
    return labels


def measured(rows: slice, columns: slice) -> F32:
    """Depth map with a measured object at 3 m in a rectangle."""
    depth = NOTHING.copy()
    depth[rows, columns] = 3
    return depth


def excluded(depth: F32, labels: U8 | None, boxes: Mesh | None = None) -> Bools:
    render = Renderer([GROUND]).view(CAMERA, POSE)
    shown = None if boxes is None else Renderer([Body(boxes)]).view(CAMERA, POSE)
    return left_out(render, depth, pixel_angle(CAMERA), labels, shown)


def test_vehicle_is_excluded_as_a_whole_if_a_part_of_it_was_measured() -> None:
    """The lidar measured only its lower half."""
    found = excluded(measured(slice(90, 110), slice(40, 80)), movable(slice(60, 110), slice(40, 80)))
    assert found[60:110, 40:80].all() and found.sum() == 50 * 40


def test_predicted_vehicle_is_counted_far_from_measured_points() -> None:
    """Trees behind a car, predicted as one vehicle with it: 1.5 m at 3 m are 76 pixels."""
    found = excluded(measured(slice(90, 110), slice(40, 60)), movable(slice(0, 110), slice(40, 256)))
    assert found[90:110, 40:60].all() and found[100, 130] and not found[100, 142:].any() and not found[:10].any()


def test_predicted_vehicle_without_measured_points_is_counted() -> None:
    assert not excluded(NOTHING, movable(slice(60, 110), slice(40, 80))).any()


def test_measured_object_that_is_not_a_vehicle_is_counted() -> None:
    """A shrub that is missing in the world."""
    found = excluded(measured(slice(90, 110), slice(40, 80)), movable(slice(0, 20), slice(200, 220)))
    assert not found.any()


def test_all_measured_objects_in_front_are_excluded_without_classes() -> None:
    found = excluded(measured(slice(90, 110), slice(40, 80)), None)
    assert found[90:110, 40:80].all() and found.sum() == 20 * 40


def test_box_of_a_removed_vehicle_is_excluded_unless_vehicles_are_kept(tmp_path: Path) -> None:
    ring = [[0, -1], [2, -1], [2, 1], [0, 1], [0, -1]]
    about = {"kind": "car", "moved": False, "height_m": 1.5, "ground_z": 0.0}
    feature = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}, "properties": about}
    file = tmp_path / "instances.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")
    removed = box_mesh(file, Frame(), keep_vehicles=False)
    assert len(removed) == 12 and not len(box_mesh(file, Frame(), keep_vehicles=True))
    labels = movable(slice(0, 0), slice(0, 0))
    found = excluded(NOTHING, labels, removed)
    render = Renderer([Body(removed)]).view(CAMERA, POSE)
    np.testing.assert_array_equal(found, render.hit)
    assert 500 < found.sum() < 20_000
