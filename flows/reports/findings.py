"""Quality findings: problems of a finished world as text, worst first, from the metrics and warnings of the steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from scan2sim.pipeline.core.cache import Manifest
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import ScanError

Level = Literal["unusable", "poor", "note"]
LEVELS: tuple[Level, ...] = ("unusable", "poor", "note")


@dataclass(frozen=True)
class FindingLimits:
    """Thresholds of the findings.

    Attributes:
        min_psnr_db: PSNR after a gain per channel, dB; below it a rendering has little in common with its photo.
        max_bad_photos: share of bad held-out photos, or of rejected photos, above which the world is unusable.
        max_inside: share of photos taken from inside a surface, or close to one, above which the world is unusable.
        min_seen_poor: share of the surface seen by photos below which the world is poor.
        min_seen: share of the surface seen by photos below which there is a note.
        max_moving: share of moving points above which there is a note.
        max_residue_m2: area of surface that remains of a removed vehicle above which the place is poor (half a bonnet).
        max_rejected: share of rejected photos above which the world is poor.
        max_focal_change_percent: change of a focal length by pose refinement, in percent, above which there is a note.
    """

    min_psnr_db: float = 15.0
    max_bad_photos: float = 1 / 3
    max_inside: float = 0.05
    min_seen_poor: float = 0.2
    min_seen: float = 0.6
    max_moving: float = 0.05
    max_residue_m2: float = 0.5
    max_rejected: float = 0.1
    max_focal_change_percent: float = 0.3


LIMITS = FindingLimits()
MAX_NAMED_PHOTOS = 3
"""Number of photos that a finding names."""


@dataclass(frozen=True)
class Finding:
    """A problem of a world.

    Attributes:
        level: "unusable": the world can't be used as it is; "poor": parts of it are poor; "note": for information.
        about: name of the task that found it.
        text: what is wrong, and what to do about it.
        weight: severity among the findings of its level.
    """

    level: Level
    about: str
    text: str
    weight: float = 0.0


def findings(done: Mapping[str, Manifest], failed: Mapping[str, ScanError] | None = None) -> list[Finding]:
    """All findings of a run, worst first; equally severe ones in the order of the steps.

    Args:
        done: results by task name.
        failed: errors of side products by name.
    """
    facts = {task: manifest.metrics for task, manifest in done.items()}
    checks = (_cameras, _held_out, _unseen, _remains, _moved, _disagreeing, _lenses)
    found = [one for check in checks for one in check(facts)]
    found += [Finding("poor", name, failure_text(name, error)) for name, error in (failed or {}).items()]
    found += [Finding("note", task, text) for task, manifest in done.items() for text in manifest.warnings]
    return sorted(found, key=lambda one: (LEVELS.index(one.level), -one.weight))


def failure_text(name: str, error: ScanError) -> str:
    """A sentence about a failed side product, without which the world is made."""
    cause = error.cause if name.endswith(error.where) else f"{error.where}: {error.cause}"
    return f"failed; the world is made without it: {cause}. {error.remedy}"


Facts = Mapping[str, Mapping[str, Any]]


def _cameras(facts: Facts) -> Iterator[Finding]:
    cameras = facts.get("score", {}).get("cameras", {"count": 0, "near_m": {}})
    near = cameras["near_m"]
    if near:
        share = len(near) / cameras["count"]
        yield Finding(
            "unusable" if share > LIMITS.max_inside else "poor",
            "score",
            f"{_count_text(len(near), cameras['count'])} taken from inside a surface or within a metre of one "
            f"({_named([f'{name}: {metres:.2f} m' for name, metres in near.items()])}): objects that moved with the "
            "camera, or the ego vehicle, are part of the world, or poses are wrong",
            share,
        )


def _held_out(facts: Facts) -> Iterator[Finding]:
    photos = facts.get("score", {}).get("photos", {})
    psnr = {name: one["psnr_gain_db"] for name, one in photos.items() if one.get("psnr_gain_db") is not None}
    bad = sorted((name for name, db in psnr.items() if db < LIMITS.min_psnr_db), key=lambda name: psnr[name])
    if bad:
        share = len(bad) / len(psnr)
        yield Finding(
            "unusable" if share > LIMITS.max_bad_photos else "poor",
            "score",
            f"{_count_text(len(bad), len(psnr), 'held-out photo')} matched with less than "
            f"{LIMITS.min_psnr_db:g} dB PSNR "
            f"({_named([f'{name}: {psnr[name]:.1f} dB' for name in bad])}): the world doesn't look like them; see "
            "the error images in the report",
            share,
        )
    blind = [name for name, one in photos.items() if one.get("coverage") == 0]
    if blind:
        yield Finding(
            "poor",
            "score",
            f"{_count_text(len(blind), len(photos), 'held-out photo')} of surfaces that no other photo saw "
            f"({_named(blind)}): the score includes them although the world is mostly grey or empty there",
            len(blind) / len(photos),
        )


def _unseen(facts: Facts) -> Iterator[Finding]:
    if not facts.get("views", {}).get("usable"):
        return
    painted = [facts[f"texture.{group}"] for group in SURFACES if f"texture.{group}" in facts]
    area = sum(one.get("area_m2", 0.0) for one in painted)
    seen = sum(one.get("seen_m2", 0.0) for one in painted) / area if area else 1.0
    if seen < LIMITS.min_seen:
        yield Finding(
            "poor" if seen < LIMITS.min_seen_poor else "note",
            "texture",
            f"{1 - seen:.0%} of the surface is not visible in any photo: it has the points' colours, or inpainted ones",
            1 - seen,
        )


def _remains(facts: Facts) -> Iterator[Finding]:
    left = facts.get("score", {}).get("residue_m2", [])
    bad = sorted((area for area in left if area > LIMITS.max_residue_m2), reverse=True)
    if bad:
        yield Finding(
            "poor",
            "score",
            f"{_count_text(len(bad), len(left), 'vehicle')} not removed completely: up to {bad[0]:.1f} m2 of "
            "surface remain of one",
            len(bad) / len(left),
        )


def _moved(facts: Facts) -> Iterator[Finding]:
    share = max((facts.get(step, {}).get("moving_share", 0.0) for step in ("dynamic_objects", "segment")), default=0.0)
    if share > LIMITS.max_moving:
        yield Finding(
            "note", "dynamic_objects", f"{share:.0%} of the points belong to moving objects and were removed", share
        )


def _disagreeing(facts: Facts) -> Iterator[Finding]:
    about = facts.get("photo_consistency", {})
    out, count = about.get("left_out", []), about.get("photos", 0)
    if count and len(out) / count > LIMITS.max_rejected:
        share = len(out) / count
        yield Finding(
            "unusable" if share > LIMITS.max_bad_photos else "poor",
            "photo_consistency",
            f"{_count_text(len(out), count)} rejected because the others contradict them "
            f"({_named(out)}): check their poses and times; `scan2sim inspect TILE` recognizes usual mistakes",
            share,
        )


def _lenses(facts: Facts) -> Iterator[Finding]:
    for name, one in facts.get("pose_refinement", {}).get("cameras", {}).items():
        change = one.get("focal_change_percent", 0.0)
        if abs(change) > LIMITS.max_focal_change_percent:
            yield Finding(
                "note",
                "pose_refinement",
                f"{name}: the photos fit a focal length that is {abs(change):.1f} % "
                f"{'longer' if change > 0 else 'shorter'} than the given one (k1 {one['k1_change']:+.3f}, k2 "
                f"{one['k2_change']:+.3f}), and the world uses it: check the calibration, or keep it by "
                "`pose_refinement.lens=false`",
                abs(change),
            )


def _count_text(some: int, count: int, what: str = "photo") -> str:
    """Text such as "3 of 25 photos are" or "1 of 1 photo is"."""
    return f"{some} of {count} {what}{'s' if count > 1 else ''} {'is' if some == 1 else 'are'}"


def _named(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMED_PHOTOS
    return ", ".join(names[:MAX_NAMED_PHOTOS]) + (f" and {more} more" if more > 0 else "")
