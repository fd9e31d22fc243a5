"""Holes of a picture of the ground, whose pattern is known all over."""

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.types import F32
from scan2sim.texturing.inpainting.patch_offsets import FACTOR, continued


def street(height: int = 360, width: int = 480) -> F32:
    """(H, W, 3) paving of 40 x 40 cells with dark joints, a kerb and a road with a line, and some grain."""
    y, x = np.mgrid[:height, :width]
    rgb = np.full((height, width, 3), 150.0)
    rgb[(y % 40 < 4) | (x % 40 < 4)] = 80
    road = y > 200
    rgb[road] = 70
    rgb[(y > 192) & ~road] = 190
    rgb[(y > 270) & (y < 280)] = 230
    return (rgb + np.random.default_rng(0).normal(0, 6, (height, width, 1))).astype(np.float32)


def hole(rows: slice, columns: slice, shape: tuple[int, int] = (360, 480)) -> npt.NDArray[np.bool_]:
    mask = np.zeros(shape, bool)
    mask[rows, columns] = True
    return mask


def error(rgb: F32, truth: F32, where: npt.NDArray[np.bool_]) -> float:
    return float(np.abs(rgb[where] - truth[where]).mean())


@pytest.mark.parametrize("rows", [slice(60, 140), slice(150, 230), slice(230, 310)])
def test_paving_kerb_and_line_go_on(rows: slice) -> None:
    truth, wanted = street(), hole(rows, slice(200, 290))
    rgb, filled = continued(np.where(wanted[..., None], 255, truth), ~wanted, wanted)
    assert filled[wanted].all() and not filled[~wanted].any()
    assert error(rgb, truth, wanted) < 14  # two grains' difference is 7; flat grey is off by 30
    assert (rgb[~wanted] == truth[~wanted]).all()


def test_shade_on_one_side_is_met_on_both() -> None:
    truth = street() * np.linspace(0.4, 1.0, 480, dtype=np.float32)[None, :, None]
    wanted = hole(slice(60, 140), slice(200, 290))
    rgb, _ = continued(truth, ~wanted, wanted)
    rims = [hole(slice(60, 140), columns) for columns in (slice(204, 214), slice(276, 286))]
    for rim in rims:  # shade moves one side's grey by 18 against the other's
        assert abs(rgb[rim].mean() - truth[rim].mean()) < 6


def test_other_kinds_of_ground_are_not_copied() -> None:
    truth, wanted = street(), hole(slice(160, 192), slice(180, 300))
    kind = np.repeat(np.where(np.arange(360)[::FACTOR] < 200, 1, 2)[:, None], 480 // FACTOR, axis=1).astype(np.int32)
    rgb, _ = continued(truth, ~wanted, wanted, kind)
    assert (rgb[wanted].mean(axis=-1) < 75).mean() < 0.15  # the joints alone, no road


def test_what_is_not_wanted_is_left_and_nothing_is_copied_from_it() -> None:
    truth, wanted = street(), hole(slice(60, 140), slice(200, 290))
    unknown = hole(slice(0, 50), slice(0, 480))
    rgb, filled = continued(np.where(unknown[..., None], 255, truth), ~wanted & ~unknown, wanted)
    assert not filled[unknown].any()
    assert rgb[wanted].max() < 230


def test_a_picture_of_nothing_known_is_left_alone() -> None:
    wanted = np.ones((64, 64), bool)
    rgb, filled = continued(np.zeros((64, 64, 3), np.float32), ~wanted, wanted)
    assert not filled.any() and not rgb.any()


def test_the_same_picture_is_filled_the_same() -> None:
    truth, wanted = street(), hole(slice(150, 230), slice(200, 290))
    assert (continued(truth, ~wanted, wanted)[0] == continued(truth, ~wanted, wanted)[0]).all()
