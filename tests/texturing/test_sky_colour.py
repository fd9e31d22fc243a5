"""Step `sky_colour`: colour of photos where the world has no surface, in the exposure of the world."""

import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.core.classes import PHOTO_CLASSES
from scan2sim.pipeline.core.step import Done, silent
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io import sky
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.photo_cache import Exposures
from scan2sim.texturing.sky_colour import SkyColourParams, sky_colour
from tests.texturing.corner import CAMERAS, POSES, Street, photograph

SKY = np.array([200, 214, 230])
"""Colour of the sky in the photos of the corner."""


def photo(levels: tuple[int, int, int]) -> U8:
    """A photo of the corner under a sky of this colour."""
    image = photograph(CAMERAS["pinhole"], POSES[0])
    return np.where((image == SKY).all(axis=2)[..., None], levels, image).astype(np.uint8)


def found(
    street: Street, out: Path, exposures: Exposures | None = None, source: Literal["empty", "sky"] = "sky", **labels: U8
) -> Done:
    """Run the step; labels by photo: `_0` is that of the first one."""
    (out / "depth").mkdir(parents=True)
    (out / "labels").mkdir()
    occluders = scene(street.occluders)
    for i, view in enumerate(street.views):
        np.save(out / "depth" / f"{i}.npy", depth_map(view.camera, view.T_world_cam, occluders).range)
    for name, values in labels.items():
        np.save(out / "labels" / f"{name[1:]}.npy", values)
    views_io.save(out / "views.json", street.views, street.held_out)
    (exposures or Exposures()).save(out / "exposures.json")
    inputs = {"views": out / "views.json", "depth": out / "depth", "exposures": out / "exposures.json"}
    (out / "result").mkdir()
    return sky_colour(inputs | {"labels": out / "labels"}, SkyColourParams(source=source), out / "result", silent)


def test_median_of_the_photos_without_those_held_out(street: Street, tmp_path: Path) -> None:
    for levels in ((120, 160, 220), (124, 164, 224), (128, 168, 228), (10, 200, 240)):
        street.add(CAMERAS["pinhole"], POSES[0], photo(levels))
    street.held_out = (False, False, False, True)
    done = found(street, tmp_path)
    assert sky.read(done.files["sky"]) == (124, 164, 224)
    assert done.metrics == {"rgb": [124, 164, 224], "photos": 3}


def test_photo_of_another_exposure_counts_in_that_of_the_world(street: Street, tmp_path: Path) -> None:
    view = street.add(CAMERAS["pinhole"], POSES[0], photo((120, 150, 200)))
    colour = sky.read(found(street, tmp_path, Exposures({view.name: (1.3, 1.3, 1.3)})).files["sky"])
    assert colour is not None and colour == pytest.approx((135, 169, 225), abs=2)  # encoded values: 1.3 ** (1 / 2.4)


def test_classes_of_a_network_decide_what_is_sky(street: Street, tmp_path: Path) -> None:
    """The left half of the image above the corner is a white wall, which looks like clouds."""
    image = photo((110, 150, 230))
    is_sky = (image == [110, 150, 230]).all(axis=2)
    image[:, :320][is_sky[:, :320]] = 250
    labels = np.zeros((*is_sky.shape, len(PHOTO_CLASSES)), np.uint8)
    labels[..., PHOTO_CLASSES.index("building")] = 200
    labels[:, 320:, PHOTO_CLASSES.index("sky")] = 255
    street.add(CAMERAS["pinhole"], POSES[0], image)
    assert sky.read(found(street, tmp_path, _0=labels).files["sky"]) == (110, 150, 230)


def test_mean_of_all_photo_pixels_without_a_surface(street: Street, tmp_path: Path) -> None:
    """Half of these pixels show trees."""
    image = photo((100, 150, 200))
    empty = (image == [100, 150, 200]).all(axis=2)
    columns = np.flatnonzero(empty.any(axis=0))
    tree = empty & (np.arange(640) < columns.mean())
    image[tree] = (40, 50, 20)
    street.add(CAMERAS["pinhole"], POSES[0], image)
    colour = sky.read(found(street, tmp_path, source="empty").files["sky"])
    share = tree.sum() / empty.sum()
    assert colour == pytest.approx(share * np.array([40, 50, 20]) + (1 - share) * np.array([100, 150, 200]), abs=15)


def test_sky_colour_is_none_without_photos_of_the_sky(street: Street, tmp_path: Path) -> None:
    street.add(CAMERAS["pinhole"], POSES[0], photo((30, 40, 20)))  # trees
    done = found(street, tmp_path)
    assert sky.read(done.files["sky"]) is None and json.loads(json.dumps(done.metrics)) == {"rgb": None, "photos": 0}
    assert sky.read(None) is None
