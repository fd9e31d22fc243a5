"""Exposures solved jointly, against those that photos were taken with."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, U8
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.exposure import ExposureParams, exposure
from scan2sim.texturing.photo_cache import Exposures, camera_of
from tests.texturing.corner import CAMERAS, POSES, Street, photograph

STOPS = [0.5, -0.7, 0.2, 0.0]


def exposed(image: U8, stops: float, tint: tuple[float, float, float] = (0, 0, 0), corners: float = 0.0) -> U8:
    """A photo with its light times 2^stops (channels: times 2^tint), and 2^-corners times that in its corners."""
    x = image / 255.0
    light = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    v, u = np.mgrid[-1 : 1 : image.shape[0] * 1j, -1 : 1 : image.shape[1] * 1j]
    q = (u * u * image.shape[1] ** 2 + v * v * image.shape[0] ** 2) / (image.shape[1] ** 2 + image.shape[0] ** 2)
    light = light * 2.0 ** (stops + np.asarray(tint) - corners * q[..., None])
    x = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.clip(light, 1e-9, None) ** (1 / 2.4) - 0.055)
    return np.clip(np.round(255 * x), 0, 255).astype(np.uint8)


def solved(street: Street, out: Path, prior: Path | None = None, **params: Any) -> tuple[Exposures, Mapping[str, Any]]:
    """Run the step; the exposures it found, and its facts."""
    hides = scene(street.occluders)
    (out / "depth").mkdir(parents=True)
    for i, view in enumerate(street.views):
        np.save(out / "depth" / f"{i}.npy", depth_map(view.camera, view.T_world_cam, hides).range)
    views_io.save(out / "views.json", street.views, street.held_out)
    inputs = {"views": out / "views.json", "depth": out / "depth"}
    if prior is not None:
        inputs["prior"] = prior
    done = exposure(inputs, ExposureParams(**params), out, silent)
    return Exposures.load(done.files["exposures"]), done.facts


@pytest.fixture
def taken(street: Street) -> Street:
    """Four photos of different exposure, one of them bluish."""
    for pose, stops in zip(POSES, STOPS, strict=True):
        tint = (-0.1, 0, 0.1) if stops == 0.2 else (0, 0, 0)
        street.add(CAMERAS["pinhole"], pose, exposed(photograph(CAMERAS["pinhole"], pose), stops - 0.5, tint))
    return street


def stops_of(exposures: Exposures, street: Street) -> F64:
    return np.array([np.log2(exposures.gain[view.name]) for view in street.views])


def test_exposures_and_tints_are_found(taken: Street, tmp_path: Path) -> None:
    found, facts = solved(taken, tmp_path / "x")
    relative = stops_of(found, taken)
    relative -= relative.mean()
    true = -np.array([[s] * 3 for s in STOPS])
    true[2] += (0.1, 0, -0.1)
    np.testing.assert_allclose(relative, true - true.mean(), atol=0.08)
    assert facts["disagreement_after"] < 0.3 * facts["disagreement_before"]


def test_the_whole_stays_as_bright_as_the_photos_are(taken: Street, tmp_path: Path) -> None:
    found, _ = solved(taken, tmp_path / "x")
    assert abs(stops_of(found, taken).mean()) < 0.05


def test_what_an_earlier_tile_found_stays(taken: Street, tmp_path: Path) -> None:
    first, _ = solved(taken, tmp_path / "x")
    r, g, b = first.gain[taken.views[1].name]
    brighter = Exposures({taken.views[1].name: (2 * r, 2 * g, 2 * b)}, {})
    brighter.save(tmp_path / "prior.json")
    found, _ = solved(taken, tmp_path / "y", tmp_path / "prior.json")
    np.testing.assert_allclose(stops_of(found, taken), stops_of(first, taken) + 1, atol=0.1)


def test_vignetting_is_found_where_there_is_some(street: Street, tmp_path: Path) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose, exposed(photograph(CAMERAS["pinhole"], pose), -0.2, corners=0.8))
    found, _ = solved(street, tmp_path / "x")
    a, b = found.vignetting[camera_of(street.views[0])]
    assert (a + b) / np.log(2) == pytest.approx(0.8, abs=0.25)


def test_photos_alike_are_left_alone(street: Street, tmp_path: Path) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    found, _ = solved(street, tmp_path / "x")
    assert np.abs(stops_of(found, street)).max() < 0.02 and not found.vignetting


def test_switched_off_or_alone_nothing_changes(taken: Street, tmp_path: Path) -> None:
    assert not solved(taken, tmp_path / "x", solve=False)[0].gain
    taken.views = taken.views[:1]
    assert not solved(taken, tmp_path / "y")[0].gain


def test_no_exposure_file_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "prior.json").write_text('{"gain": {"a": [1, 1]}}', encoding="utf-8")
    with pytest.raises(InputError, match=r"prior\.json"):
        Exposures.load(tmp_path / "prior.json")
