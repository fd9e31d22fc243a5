"""Level: the colours of neighbouring tiles, textured apart, meet at their border.

Where tiles share vertices, the target of each is the mean of what all of them show there, so all compute the same.
The change that takes a tile to its target is carried inwards as its mean over the border, weighted by 1 / distance^4.
Along a straight border that is the biharmonic surface: a wave of length l fades as (1 + k d) exp(-k d) with the
distance d, k = 2 pi / l, and without a crease. So fine differences end close to the border and wide ones far from it,
as in multi-band blending (Burt and Adelson 1983), and where the nearest border changes there is no step. What is the
same all along the border is faded out over `reach`. Levelled seams: Lempitsky and Ivanov 2007; colours carried
inwards as weighted means: Farbman et al. 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32
from scan2sim.pipeline.io.file_checks import pass_on
from scan2sim.pipeline.io.images import image

if TYPE_CHECKING:
    from scan2sim.pipeline.io.worlds.textured_mesh import Textured
    from scan2sim.texturing.borders.correspondences import Border

NEIGHBOUR = "neighbour."


class LevelParams(Params):
    """How colours are levelled.

    Attributes:
        reach: metres from the border over which a step between tiles is faded out.
    """

    reach: float = Field(4.0, ge=0.01, le=1000)


def level(inputs: Inputs, params: LevelParams, out: Path, report: Report) -> Done:
    """Take a tile's colours at its border to the mean of the tiles that meet there, fading inwards.

    Inputs: `textured` (of the step `texture`) and `neighbour.*`, the same of the tiles around, before they are
    levelled themselves.
    File: `textured`, the same layout; what is not changed, masks included, is the same bytes.

    Raises:
        InputError: a page can't be read.
    """
    from scan2sim.pipeline.io.worlds import textured_mesh
    from scan2sim.texturing.borders import correspondences, sampling

    folder = out / "textured"
    folder.mkdir()
    own = textured_mesh.read(inputs["textured"])
    given = {name.removeprefix(NEIGHBOUR): path for name, path in sorted(inputs.items()) if name.startswith(NEIGHBOUR)}
    others = {name: tile for name, path in given.items() if (tile := textured_mesh.read(path)) is not None}
    facts: dict[str, Any] = {"border_m": 0.0, "step_before": 0.0, "step_after": 0.0, "step_p95_after": 0.0}
    if own is not None and others:
        tiles = (own, *others.values())
        border = correspondences.shared_border([correspondences.rim(tile.mesh) for tile in tiles])
        if len(border.samples[0].place):
            pairs = zip(border.samples, tiles, strict=True)
            shown = np.stack([sampling.colours(samples, tile.pages, len(border)) for samples, tile in pairs])
            target = sampling.targets(border.xyz, shown, params.reach)
            after = _level_pages(own, border, shown[0], target, params.reach, folder, report)
            facts = _facts(border, list(others), shown, target, after)
    _link_others(inputs["textured"], folder)
    return Done({"textured": folder}, facts)


def _level_pages(
    own: Textured, border: Border, shown: F32, target: F32, reach: float, folder: Path, report: Report
) -> F32:
    """Write the pages that change; returns (P, 3) what the levelled mesh shows at the border's places.

    Args:
        shown, target: (P, 3) grey levels of the places, as they are and as they are to be.
    """
    from scan2sim.pipeline.camera.image_sampling import page_colours
    from scan2sim.texturing.bake import texel_map
    from scan2sim.texturing.borders import fading, sampling

    mesh, samples = own.mesh, border.samples[0]
    assert mesh.uv is not None and mesh.page is not None
    mine = np.isfinite(shown[:, 0])
    places = border.xyz[mine] - np.asarray(mesh.frame.origin)
    corners, tree = mesh.corners, fading.changes(places, border.metres[mine], (target - shown)[mine])
    near = fading.within(tree, corners, reach)
    after = np.empty((len(samples.place), 3), np.float32)
    pages = np.unique(mesh.page[near]).tolist()
    for i, k in enumerate(pages):
        report(i / len(pages), f"page {i + 1} of {len(pages)}")
        faces = np.flatnonzero(mesh.page == k)
        here = samples.page == k
        before = image.read_rgb(own.pages[k])
        page, (height, width) = before.copy(), before.shape[:2]
        flat = texel_map.corners(mesh.uv[faces], width, height)
        owner = texel_map.owners(flat, width, height)
        source = fading.sources(owner)
        fading.fade(page, owner, flat, corners[faces], near[faces], tree, reach)
        fading.settle(page, source, samples.uv[here], target[samples.place[here]])
        fading.follow(before, page, owner, source)
        after[here] = page_colours(page, samples.uv[here])
        image.write(folder / f"page_{k}.png", page)
    return sampling.by_place(samples.place, after, len(border))


def _facts(border: Border, names: Sequence[str], shown: F32, target: F32, after: F32) -> dict[str, Any]:
    """Metres of border and the colour step there, grey levels, before and after (both tiles being levelled)."""
    before, left = np.abs(shown[1:] - shown[0]), 2 * np.abs(after - target)
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


def _link_others(source: Path, folder: Path) -> None:
    """Put the files of `source` that `folder` has no own version of into it, as hard links where possible."""
    for path in sorted(source.iterdir()):
        place = folder / path.name
        if place.exists():
            continue
        pass_on(path, place)


LEVEL = Step("level", 2, level, LevelParams, per_class=True, memory=(1.0, 3))
