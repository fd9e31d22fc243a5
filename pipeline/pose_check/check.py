"""Checks the photos of a tile against its cloud: which usual mistake explains that they don't fit, if any."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64, Tile
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.pose_check.alternatives import Alternative, alternatives
from scan2sim.pipeline.pose_check.photo_fit import Fit, fit, sample_points, small_photos
from scan2sim.pipeline.pose_check.photo_offset import CameraOffset, offsets


@dataclass(frozen=True)
class CheckLimits:
    """When a mistake is named.

    Attributes:
        min_photos: photos that are needed.
        min_gain, min_t, min_score: mean gain of the score over the given poses; relative to its standard error over the
            photos (Student's t); score of the alternative.
        large_gain, large_gain_t, large_gain_score: the same for large gains, which are certain from fewer photos.
        min_better_share: share of the photos whose score increases.
    """

    min_photos: int = 3
    min_gain: float = 0.06
    min_t: float = 4.0
    min_score: float = 0.2
    large_gain: float = 0.2
    large_gain_t: float = 2.0
    large_gain_score: float = 0.4
    min_better_share: float = 0.75


LIMITS = CheckLimits()


@dataclass(frozen=True)
class Mistake:
    """A recognized mistake.

    Attributes:
        what: as `Alternative.what`.
        option: option of the import that undoes it.
        score, given_score: mean scores of the photos with and without it.
    """

    what: str
    option: str
    score: float
    given_score: float

    def __str__(self) -> str:
        return (
            f"{self.what}: with `{self.option}` the photos fit the cloud "
            f"(score {self.score:.2f} instead of {self.given_score:.2f})"
        )


CHECK = "photo_check.json"
"""File beside the `tile.toml` with the result of `check_photos`."""


def check_photos(path: Path, *, conventions: bool = True) -> list[str]:
    """Check the photos of a tile against its cloud, and write the result beside it.

    Args:
        path: the `tile.toml`.
        conventions: look for usual mistakes in the poses, too; without, only for offsets.

    Returns:
        Warnings, also if the check fails.
    """
    try:
        tile = read_tile(path)
        mistake = find_mistake(tile) if conventions else None
        found = [] if mistake else measured_offsets(tile)
    except Exception as error:  # the check must not cost the import
        return [f"the photos couldn't be checked against the cloud ({type(error).__name__}: {error})"]
    warnings = [str(mistake)] if mistake else [text for one in found if (text := one.warning())]
    if mistake or found:
        summary = "; ".join(one.text() for one in found) or f"don't fit the cloud: {mistake}"
        content = {"summary": summary, "warnings": warnings, "cameras": [one.figures() for one in found]}
        (path.parent / CHECK).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return warnings


def read_check(tile: Path) -> dict[str, Any] | None:
    """Content of `photo_check.json` in the folder of a tile; None if it has none, or a damaged one."""
    try:
        content = json.loads((tile / CHECK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def measured_offsets(tile: Tile) -> list[CameraOffset]:
    """Offsets of the photos from the cloud, for each camera.

    Raises:
        ScanError: the cloud can't be read.
    """
    views = [view for view in tile.views if view.camera.model != "orthographic"]
    return offsets(views, sample_points(tile)) if len(views) >= LIMITS.min_photos else []


def find_mistake(tile: Tile) -> Mistake | None:
    """The mistake without which the photos fit the cloud clearly better; None if there is none.

    Raises:
        ScanError: the cloud can't be read.
    """
    scores = scored(tile)
    given = scores[0][1] if scores else None
    named = [(one, found) for one, found in scores if one is not None and given and _is_clear(found, given)]
    if not named or given is None:
        return None
    best, found = max(named, key=lambda item: _gain(item[1], given).mean())
    both = np.isfinite(_gain(found, given, finite=False))
    return Mistake(best.what, best.option, float(found.score[both].mean()), float(given.score[both].mean()))


def scored(tile: Tile) -> list[tuple[Alternative | None, Fit]]:
    """Scores of the given poses (None), then of all alternatives; empty if there are too few photos."""
    views = [view for view in tile.views if view.camera.model != "orthographic"]
    photos = small_photos(views)
    if len(photos) < LIMITS.min_photos:
        return []
    cloud = sample_points(tile)
    given = fit(photos, [view.camera for view in views], np.array([view.T_world_cam for view in views]), cloud)
    return [(None, given), *((one, fit(photos, one.cameras, one.T, cloud)) for one in alternatives(tile, views))]


def _gain(found: Fit, given: Fit, finite: bool = True) -> F64:
    """Gains (P,) of the photos; by default only of those that have a pose in both."""
    gain = found.score - given.score
    return np.asarray(gain[np.isfinite(gain)] if finite else gain)


def _is_clear(found: Fit, given: Fit) -> bool:
    gain = _gain(found, given)
    if len(gain) < LIMITS.min_photos:
        return False
    mean, score = float(gain.mean()), float(np.nanmean(found.score))
    t = mean / max(float(gain.std(ddof=1)) / len(gain) ** 0.5, 1e-9)
    return bool(np.mean(gain > 0) >= LIMITS.min_better_share) and (
        (mean >= LIMITS.min_gain and t >= LIMITS.min_t and score >= LIMITS.min_score)
        or (mean >= LIMITS.large_gain and t >= LIMITS.large_gain_t and score >= LIMITS.large_gain_score)
    )
