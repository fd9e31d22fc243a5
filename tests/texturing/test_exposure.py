"""Joint exposure calibration against the exposures with which photos were taken."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scan2sim.pipeline.camera.depth_map import depth_map, scene
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, U8, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.texturing.exposure import ExposureParams, exposure
from scan2sim.texturing.exposure_model import compressed, overexposed_weight
from scan2sim.texturing.photo_cache import Exposures, camera_of
from tests.texturing.corner import CAMERAS, POSES, Street, photograph

STOPS = [0.5, -0.7, 0.2, 0.0]


def exposed(image: U8, stops: float, tint: tuple[float, float, float] = (0, 0, 0), corners: float = 0.0) -> U8:
    """A photo with its light multiplied by 2^stops (channels by 2^tint), and by 2^-corners in the corners."""
    x = image / 255.0
    light = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    v, u = np.mgrid[-1 : 1 : image.shape[0] * 1j, -1 : 1 : image.shape[1] * 1j]
    q = (u * u * image.shape[1] ** 2 + v * v * image.shape[0] ** 2) / (image.shape[1] ** 2 + image.shape[0] ** 2)
    light = light * 2.0 ** (stops + np.asarray(tint) - corners * q[..., None])
    x = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.clip(light, 1e-9, None) ** (1 / 2.4) - 0.055)
    return np.clip(np.round(255 * x), 0, 255).astype(np.uint8)


def solved(street: Street, out: Path, prior: Path | None = None, **params: Any) -> tuple[Exposures, Mapping[str, Any]]:
    """Run the step; returns the estimated exposures, and its metrics."""
    occluders = scene(street.occluders)
    (out / "depth").mkdir(parents=True)
    for i, view in enumerate(street.views):
        np.save(out / "depth" / f"{i}.npy", depth_map(view.camera, view.T_world_cam, occluders).range)
    views_io.save(out / "views.json", street.views, street.held_out)
    inputs = {"views": out / "views.json", "depth": out / "depth"}
    if prior is not None:
        inputs["prior"] = prior
    done = exposure(inputs, ExposureParams(**params), out, silent)
    return Exposures.load(done.files["exposures"]), done.metrics


@pytest.fixture
def exposed_street(street: Street) -> Street:
    """Street with four photos of different exposure, one of them bluish."""
    for pose, stops in zip(POSES, STOPS, strict=True):
        tint = (-0.1, 0, 0.1) if stops == 0.2 else (0, 0, 0)
        street.add(CAMERAS["pinhole"], pose, exposed(photograph(CAMERAS["pinhole"], pose), stops - 0.5, tint))
    return street


def stops_of(exposures: Exposures, street: Street) -> F64:
    return np.array([np.log2(exposures.gain[view.name]) for view in street.views])


def test_exposures_and_tints_are_estimated(exposed_street: Street, tmp_path: Path) -> None:
    found, facts = solved(exposed_street, tmp_path / "x")
    relative = stops_of(found, exposed_street)
    relative -= relative.mean()
    true = -np.array([[s] * 3 for s in STOPS])
    true[2] += (0.1, 0, -0.1)
    np.testing.assert_allclose(relative, true - true.mean(), atol=0.08)
    assert facts["disagreement_after"] < 0.3 * facts["disagreement_before"]


def test_mean_brightness_is_unchanged(exposed_street: Street, tmp_path: Path) -> None:
    found, _ = solved(exposed_street, tmp_path / "x")
    assert abs(stops_of(found, exposed_street).mean()) < 0.05


def test_own_exposures_are_kept_to_the_given_share(exposed_street: Street, tmp_path: Path) -> None:
    shares = (0.0, 0.3, 10.0)
    found = [solved(exposed_street, tmp_path / str(share), own_exposure=share)[0] for share in shares]
    spread = [np.ptp(stops_of(one, exposed_street).mean(axis=1)) for one in found]
    assert spread[0] == pytest.approx(np.ptp(STOPS), abs=0.08)
    assert 0.2 * spread[0] < spread[1] < 0.9 * spread[0] and spread[2] < 0.15 * spread[0]


def test_white_point_follows_from_the_largest_gain() -> None:
    assert Exposures().white == Exposures({"dark": (0.5, 0.6, 0.5)}).white == 255
    brightened = Exposures({"a": (1.0, 1.0, 1.0), "b": (2.0, 3.0, 2.0)})
    assert brightened.white == pytest.approx((243 + 14.025) * 3 ** (1 / 2.4) - 14.025)


def test_tone_curve_keeps_highlights_and_everything_below() -> None:
    levels = np.linspace(0, 400, 401)
    by_white = {white: np.array([compressed(level, white) for level in levels]) for white in (255.0, 320.0, 400.0)}
    assert np.allclose(by_white[255.0], levels)
    for white, curve in by_white.items():
        assert np.allclose(curve[levels <= 230], levels[levels <= 230]) and (np.diff(curve) > 0).all()
        assert curve[levels == white] == pytest.approx(255)


def test_overexposed_pixels_count_less_in_darkened_photos() -> None:
    gains = {"darkened": (0.5, 0.5, 0.5), "kept": (1.0, 1.0, 1.0), "brightened": (2.0, 2.0, 2.0)}
    exposures, camera = Exposures(gains), CAMERAS["pinhole"]
    weight = {n: overexposed_weight(exposures.of(View(n, camera, np.eye(4), Path("a.png")))) for n in gains}
    assert weight["darkened"] == pytest.approx(0.5**4) and weight["kept"] == weight["brightened"] == 1


def test_prior_exposures_are_kept(exposed_street: Street, tmp_path: Path) -> None:
    first, _ = solved(exposed_street, tmp_path / "x")
    r, g, b = first.gain[exposed_street.views[1].name]
    brighter = Exposures({exposed_street.views[1].name: (2 * r, 2 * g, 2 * b)}, {})
    brighter.save(tmp_path / "prior.json")
    found, _ = solved(exposed_street, tmp_path / "y", tmp_path / "prior.json")
    np.testing.assert_allclose(stops_of(found, exposed_street), stops_of(first, exposed_street) + 1, atol=0.1)


def test_vignetting_is_estimated(street: Street, tmp_path: Path) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose, exposed(photograph(CAMERAS["pinhole"], pose), -0.2, corners=0.8))
    found, _ = solved(street, tmp_path / "x")
    a, b = found.vignetting[camera_of(street.views[0])]
    assert (a + b) / np.log(2) == pytest.approx(0.8, abs=0.25)


def test_equal_photos_are_unchanged(street: Street, tmp_path: Path) -> None:
    for pose in POSES:
        street.add(CAMERAS["pinhole"], pose)
    found, _ = solved(street, tmp_path / "x")
    assert np.abs(stops_of(found, street)).max() < 0.02 and not found.vignetting


def test_exposures_are_unchanged_if_disabled_or_with_one_photo(exposed_street: Street, tmp_path: Path) -> None:
    assert not solved(exposed_street, tmp_path / "x", solve=False)[0].gain
    exposed_street.views = exposed_street.views[:1]
    assert not solved(exposed_street, tmp_path / "y")[0].gain


def test_invalid_exposure_file_is_rejected_with_its_name(tmp_path: Path) -> None:
    (tmp_path / "prior.json").write_text('{"gain": {"a": [1, 1]}}', encoding="utf-8")
    with pytest.raises(InputError, match=r"prior\.json"):
        Exposures.load(tmp_path / "prior.json")
