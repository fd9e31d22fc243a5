"""Inpainting of holes in an image of the ground with a known pattern."""

import numpy as np
import numpy.typing as npt
import pytest

from scan2sim.pipeline.core.types import F32
from scan2sim.texturing.inpainting.patch_offsets import COARSE_FACTOR, inpaint


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
def test_paving_kerb_and_line_are_continued(rows: slice) -> None:
    truth, wanted = street(), hole(rows, slice(200, 290))
    rgb, filled = inpaint(np.where(wanted[..., None], 255, truth), ~wanted, wanted)
    assert filled[wanted].all() and not filled[~wanted].any()
    assert error(rgb, truth, wanted) < 14  # two grains' difference is 7; flat grey is off by 30
    assert (rgb[~wanted] == truth[~wanted]).all()


def test_tone_matches_both_sides_of_the_hole() -> None:
    truth = street() * np.linspace(0.4, 1.0, 480, dtype=np.float32)[None, :, None]
    wanted = hole(slice(60, 140), slice(200, 290))
    rgb, _ = inpaint(truth, ~wanted, wanted)
    rims = [hole(slice(60, 140), columns) for columns in (slice(204, 214), slice(276, 286))]
    for rim in rims:  # shading changes the grey level by 18 from one side to the other
        assert abs(rgb[rim].mean() - truth[rim].mean()) < 6


def test_other_classes_of_ground_are_not_copied() -> None:
    truth, wanted = street(), hole(slice(160, 192), slice(180, 300))
    by_row = np.where(np.arange(360)[::COARSE_FACTOR] < 200, 1, 2)
    classes = np.repeat(by_row[:, None], 480 // COARSE_FACTOR, axis=1).astype(np.int32)
    rgb, _ = inpaint(truth, ~wanted, wanted, classes)
    assert (rgb[wanted].mean(axis=-1) < 75).mean() < 0.15  # only the joints, no road


def test_ignored_cells_are_neither_filled_nor_copied() -> None:
    truth, wanted = street(), hole(slice(60, 140), slice(200, 290))
    unknown = hole(slice(0, 50), slice(0, 480))
    rgb, filled = inpaint(np.where(unknown[..., None], 255, truth), ~wanted & ~unknown, wanted)
    assert not filled[unknown].any()
    assert rgb[wanted].max() < 230


def test_image_without_known_cells_is_unchanged() -> None:
    wanted = np.ones((64, 64), bool)
    rgb, filled = inpaint(np.zeros((64, 64, 3), np.float32), ~wanted, wanted)
    assert not filled.any() and not rgb.any()


def test_inpainting_is_deterministic() -> None:
    truth, wanted = street(), hole(slice(150, 230), slice(200, 290))
    assert (inpaint(truth, ~wanted, wanted)[0] == inpaint(truth, ~wanted, wanted)[0]).all()
