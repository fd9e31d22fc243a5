"""What is wrong with a finished world, in words, worst first: told from the steps' facts and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from scan2sim.pipeline.core.cache import Manifest
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.errors import ScanError

Level = Literal["unusable", "poor", "note"]
LEVELS: tuple[Level, ...] = ("unusable", "poor", "note")

BAD = 15.0
"""dB after a gain a channel: below it a rendering has little in common with its photo."""
FAILED = 1 / 3
"""Share of the held-out photos that are bad, or of the photos that disagree, beyond which the world is unusable."""
INSIDE = 0.05
"""Share of the photos taken from inside or beside a surface beyond which the world is unusable."""
SEEN = (0.2, 0.6)
"""Shares of the surface seen by photos below which a world is poor, and below which it is worth a note."""
MOVED = 0.05
"""Share of the points that moved beyond which they are worth a note."""
REMAINS = 0.5
"""Square metres of surface where a vehicle was taken out beyond which the place is poor: a bonnet's half."""
LEFT_OUT = 0.1
"""Share of the photos left out beyond which a world is poor."""
NAMED = 3
"""Photos that a finding names."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes:
        level: what it does to the world: it can't be used as it is, parts of it are poor, or it is to be known.
        about: the step that found it.
        text: what is wrong, and what to do.
        weight: how bad it is among those of its level.
    """

    level: Level
    about: str
    text: str
    weight: float = 0.0


def findings(done: Mapping[str, Manifest], failed: Mapping[str, ScanError] | None = None) -> list[Finding]:
    """All findings of a run, worst first; those of a level and weight in the order of the steps.

    Args:
        done: results by node.
        failed: errors of side products, by name.
    """
    facts = {node: manifest.facts for node, manifest in done.items()}
    checks = (_cameras, _held_out, _unseen, _remains, _moved, _disagreeing)
    found = [one for check in checks for one in check(facts)]
    found += [Finding("poor", name, without(name, error)) for name, error in (failed or {}).items()]
    found += [Finding("note", node, text) for node, manifest in done.items() for text in manifest.warnings]
    return sorted(found, key=lambda one: (LEVELS.index(one.level), -one.weight))


def without(name: str, error: ScanError) -> str:
    """A sentence on a side product that failed: the world is made without it."""
    cause = error.cause if name.endswith(error.where) else f"{error.where}: {error.cause}"
    return f"failed, and the world is made without it: {cause}. {error.remedy}"


Facts = Mapping[str, Mapping[str, Any]]


def _cameras(facts: Facts) -> Iterator[Finding]:
    cameras = facts.get("score", {}).get("cameras", {"count": 0, "near_m": {}})
    near = cameras["near_m"]
    if near:
        share = len(near) / cameras["count"]
        yield Finding(
            "unusable" if share > INSIDE else "poor",
            "score",
            f"{_of(len(near), cameras['count'])} taken from inside a surface or within a metre of one "
            f"({_named([f'{name}: {metres:.2f} m' for name, metres in near.items()])}): what moved along with the "
            "camera, or the car that carried it, has become part of the world, or poses are wrong",
            share,
        )


def _held_out(facts: Facts) -> Iterator[Finding]:
    photos = facts.get("score", {}).get("photos", {})
    likeness = {name: one["psnr_gain_db"] for name, one in photos.items() if one.get("psnr_gain_db") is not None}
    bad = sorted((name for name, db in likeness.items() if db < BAD), key=lambda name: likeness[name])
    if bad:
        share = len(bad) / len(likeness)
        yield Finding(
            "unusable" if share > FAILED else "poor",
            "score",
            f"{_of(len(bad), len(likeness), 'held-out photo')} met with less than {BAD:g} dB "
            f"({_named([f'{name}: {likeness[name]:.1f} dB' for name in bad])}): the world doesn't look like them; see "
            "their pictures in the report",
            share,
        )
    blind = [name for name, one in photos.items() if one.get("coverage") == 0]
    if blind:
        yield Finding(
            "poor",
            "score",
            f"{_of(len(blind), len(photos), 'held-out photo')} of nothing that another photo saw ({_named(blind)}): "
            "it counts as what it is, mostly grey or empty",
            len(blind) / len(photos),
        )


def _unseen(facts: Facts) -> Iterator[Finding]:
    if not facts.get("views", {}).get("usable"):
        return
    painted = [facts[f"texture.{group}"] for group in SURFACES if f"texture.{group}" in facts]
    area = sum(one.get("area_m2", 0.0) for one in painted)
    seen = sum(one.get("seen_m2", 0.0) for one in painted) / area if area else 1.0
    if seen < SEEN[1]:
        yield Finding(
            "poor" if seen < SEEN[0] else "note",
            "texture",
            f"{1 - seen:.0%} of the surface was never seen by a photo: it has the points' colours, or made-up ones",
            1 - seen,
        )


def _remains(facts: Facts) -> Iterator[Finding]:
    left = facts.get("score", {}).get("remains_m2", [])
    bad = sorted((area for area in left if area > REMAINS), reverse=True)
    if bad:
        yield Finding(
            "poor",
            "score",
            f"{_of(len(bad), len(left), 'vehicle')} not wholly gone: up to {bad[0]:.1f} m2 of surface stand where "
            "one was taken out",
            len(bad) / len(left),
        )


def _moved(facts: Facts) -> Iterator[Finding]:
    share = max((facts.get(step, {}).get("moving_share", 0.0) for step in ("carve", "segment")), default=0.0)
    if share > MOVED:
        yield Finding("note", "carve", f"{share:.0%} of the points moved, and were left out", share)


def _disagreeing(facts: Facts) -> Iterator[Finding]:
    about = facts.get("agreement", {})
    out, count = about.get("left_out", []), about.get("photos", 0)
    if count and len(out) / count > LEFT_OUT:
        share = len(out) / count
        yield Finding(
            "unusable" if share > FAILED else "poor",
            "agreement",
            f"{_of(len(out), count)} left out, as the others disagree ({_named(out)}): check their poses and times",
            share,
        )


def _of(some: int, count: int, what: str = "photo") -> str:
    """Such as "3 of 25 photos are", "1 of 1 photo is"."""
    return f"{some} of {count} {what}{'s' if count > 1 else ''} {'is' if some == 1 else 'are'}"


def _named(names: Sequence[str]) -> str:
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
