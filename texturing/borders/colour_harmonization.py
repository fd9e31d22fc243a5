"""Colour harmonization step: removes colour steps on the borders of tiles that were textured independently.

Where tiles share vertices, the target colour of each is the mean of the colours of all of them, so all tiles compute
the same target. The colour change that takes a tile to its target is extrapolated inwards as a mean over the border,
weighted by 1 / distance^4. Along a straight border this is the biharmonic surface: a wave of length l fades as
(1 + k d) exp(-k d) with the distance d, k = 2 pi / l, and without a crease. Fine differences therefore fade close to
the border and wide ones far from it, as in multi-band blending (Burt and Adelson 1983), and there is no step where the
nearest border changes. A constant difference along the border is faded out over `fade_distance`. Seam levelling:
Lempitsky and Ivanov 2007; inward extrapolation by weighted means: Farbman et al. 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.io.file_checks import link_or_copy
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured
    from scan2sim.texturing.borders.correspondences import Border

NEIGHBOUR_PREFIX = "neighbour."


class ColourHarmonizationParams(Params):
    """Settings of the colour harmonization.

    Attributes:
        fade_distance: metres from the border over which a colour step between tiles is faded out.
    """

    fade_distance: float = Field(4.0, ge=0.01, le=1000)


def colour_harmonization(inputs: Inputs, params: ColourHarmonizationParams, out: Path, report: Report) -> Done:
    """Change a tile's colours at its border to the mean of the tiles that meet there, fading inwards.

    Inputs: `textured` (of the step `texture`) and `neighbour.*`, the same of the neighbouring tiles, before their own
    colour harmonization.
    File: `textured`, with the same layout; unchanged files, including all masks, are byte-identical.

    Raises:
        InputError: a page can't be read.
    """
    from scan2sim.pipeline.io.worlds import textured_mesh
    from scan2sim.texturing.borders import correspondences, sampling

    folder = out / "textured"
    folder.mkdir()
    own = textured_mesh.read(inputs["textured"])
    folders = {
        name.removeprefix(NEIGHBOUR_PREFIX): path
        for name, path in sorted(inputs.items())
        if name.startswith(NEIGHBOUR_PREFIX)
    }
    others = {name: tile for name, path in folders.items() if (tile := textured_mesh.read(path)) is not None}
    metrics: dict[str, Any] = {"border_m": 0.0, "step_before": 0.0, "step_after": 0.0, "step_p95_after": 0.0}
    if own is not None and others:
        tiles = (own, *others.values())
        border = correspondences.shared_border([correspondences.open_edges(tile.mesh) for tile in tiles])
        if len(border.samples[0].point):
            pairs = zip(border.samples, tiles, strict=True)
            current = np.stack([sampling.colours(samples, tile.pages, len(border)) for samples, tile in pairs])
            target = sampling.targets(border.xyz, current, params.fade_distance)
            after = _harmonize_pages(own, border, current[0], target, params.fade_distance, folder, report)
            metrics = _metrics(border, list(others), current, target, after)
    _link_unchanged(inputs["textured"], folder)
    return Done({"textured": folder}, metrics)


def _harmonize_pages(
    own: Textured, border: Border, current: F32, target: F32, fade_distance: float, folder: Path, report: Report
) -> F32:
    """Write the pages that change; returns (P, 3) grey levels of the harmonized mesh at the border points.

    Args:
        own: textured mesh of the tile.
        border: border with its neighbours.
        current, target: (P, 3) grey levels at the border points before and wanted after.
        fade_distance: fading distance in metres.
        folder: folder of the pages.
        report: progress callback.
    """
    from scan2sim.pipeline.camera.image_sampling import page_colours
    from scan2sim.texturing import texel_map
    from scan2sim.texturing.borders import fading, sampling

    mesh, samples = own.mesh, border.samples[0]
    assert mesh.uv is not None and mesh.page is not None
    has = np.isfinite(current[:, 0])
    points = border.xyz[has] - np.asarray(mesh.frame.origin)
    corners, tree = mesh.corners, fading.changes(points, border.metres[has], (target - current)[has])
    near = fading.within(tree, corners, fade_distance)
    after = np.empty((len(samples.point), 3), np.float32)
    pages = np.unique(mesh.page[near]).tolist()
    for i, k in enumerate(pages):
        report(i / len(pages), f"page {i + 1} of {len(pages)}")
        faces = np.flatnonzero(mesh.page == k)
        on_page = samples.page == k
        before = image.read_rgb(own.pages[k])
        page, (height, width) = before.copy(), before.shape[:2]
        flat = texel_map.corners(mesh.uv[faces], width, height)
        owner = texel_map.owners(flat, width, height)
        source = fading.padding_sources(owner)
        fading.fade(page, owner, flat, corners[faces], near[faces], tree, fade_distance)
        fading.match_samples(page, source, samples.uv[on_page], target[samples.point[on_page]])
        fading.update_padding(before, page, owner, source)
        after[on_page] = page_colours(page, samples.uv[on_page])
        image.write(folder / f"page_{k}.png", page)
    return sampling.mean_by_point(samples.point, after, len(border))


def _metrics(border: Border, names: Sequence[str], current: F32, target: F32, after: F32) -> dict[str, Any]:
    """Length of the border in metres, and the colour step in grey levels before and after (with both tiles changed)."""
    before, left = np.abs(current[1:] - current[0]), 2 * np.abs(after - target)
    neighbours = {
        name: {
            "border_m": round(length, 2),
            "step_before": round(float(np.nanmean(step)), 2) if np.isfinite(step).any() else 0.0,
        }
        for name, length, step in zip(names, border.length, before, strict=True)
    }
    return {
        "border_m": round(sum(border.length), 2),
        "step_before": round(float(np.nanmean(before)), 2),
        "step_after": round(float(np.nanmean(left)), 2),
        "step_p95_after": round(float(np.nanpercentile(left, 95)), 2),
        "neighbours": neighbours,
    }


def _link_unchanged(source: Path, folder: Path) -> None:
    """Hard-link or copy the files of `source` that are missing in `folder`."""
    for path in sorted(source.iterdir()):
        target = folder / path.name
        if target.exists():
            continue
        link_or_copy(path, target)


COLOUR_HARMONIZATION = Step(
    "colour_harmonization", 2, colour_harmonization, ColourHarmonizationParams, per_class=True, memory=(1.0, 3)
)
