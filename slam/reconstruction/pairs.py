"""Which photos are matched: all pairs, those that follow each other, and neighbours by GPS."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from scan2sim.slam.reconstruction.photos import Photo

OVERLAP = 10
"""Following photos that each is matched with, and about as many at distances of powers of two."""
PARALLEL = 2
"""Photos before and after, of each camera that runs in parallel, that each photo is matched with."""
NEIGHBOURS = 8
"""Nearest photos by GPS that each is matched with."""
Pair = tuple[str, str]


def all_pairs(photos: Sequence[Photo]) -> Iterator[Pair]:
    """Names of all pairs of photos."""
    for i, one in enumerate(photos):
        for other in photos[i + 1 :]:
            yield one.name, other.name


def sequential_pairs(names: Sequence[str]) -> Iterator[Pair]:
    """Pairs of photos that follow each other up to `OVERLAP` photos apart, and at distances of powers of two."""
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(OVERLAP))})
    for i, name in enumerate(names):
        yield from ((name, names[i + step]) for step in steps if i + step < len(names))


def following_pairs(photos: Sequence[Photo]) -> list[Pair]:
    """Names of pairs of photos that follow each other, by time if known.

    Folders are cameras that run in parallel, or continue each other, as memory cards number them (100MEDIA, 101MEDIA).
    """
    groups: dict[str, list[Photo]] = defaultdict(list)
    for photo in photos:
        groups[photo.name.rpartition("/")[0]].append(photo)
    timed = all(photo.time is not None for photo in photos)
    runs = [_by_time(group) if timed else group for group in groups.values()]
    found = [pair for run in runs for pair in sequential_pairs([photo.name for photo in run])]
    if len(runs) > 1:
        found += _simultaneous(photos, len(runs)) if timed else _between(runs)
    return unique(found)


def near_pairs(photos: Sequence[Photo]) -> list[Pair]:
    """Names of pairs of photos that are nearest to each other by the GPS in their EXIF: strips of a flight, loops."""
    from scipy.spatial import cKDTree

    located = [photo for photo in photos if photo.position is not None]
    if len(located) < 2:
        return []
    degrees = np.array([photo.position for photo in located])
    plane = np.column_stack([degrees[:, 0], degrees[:, 1] * np.cos(np.radians(degrees[:, 0].mean()))])
    _, nearest = cKDTree(plane).query(plane, min(NEIGHBOURS + 1, len(located)))
    pairs = ((i, j) for i, row in enumerate(nearest.tolist()) for j in row if i != j)
    return unique((located[min(pair)].name, located[max(pair)].name) for pair in pairs)


def unique(pairs: Iterable[Pair]) -> list[Pair]:
    """Pairs in order, each once, in either direction."""
    found: dict[frozenset[str], Pair] = {}
    for pair in pairs:
        found.setdefault(frozenset(pair), pair)
    return list(found.values())


def _simultaneous(photos: Sequence[Photo], runs: int) -> Iterator[Pair]:
    """Pairs of photos in different folders that were taken shortly after each other."""
    names = [photo.name for photo in _by_time(photos)]
    window = max(OVERLAP, runs * PARALLEL)
    for i, name in enumerate(names):
        for other in names[i + 1 : i + 1 + window]:
            if name.rpartition("/")[0] != other.rpartition("/")[0]:
                yield name, other


def _between(runs: Sequence[Sequence[Photo]]) -> Iterator[Pair]:
    """Pairs of photos with about the same number in different folders, and of the end of a folder with the next one."""
    for k, run in enumerate(runs):
        for i, photo in enumerate(run):
            for other in runs[k + 1 :]:
                near = range(max(0, i - PARALLEL), min(len(other), i + PARALLEL + 1))
                yield from ((photo.name, other[j].name) for j in near)
        for photo in run[-OVERLAP // 2 :] if k + 1 < len(runs) else ():
            yield from ((photo.name, other.name) for other in runs[k + 1][: OVERLAP // 2])


def _by_time(photos: Sequence[Photo]) -> list[Photo]:
    return sorted(photos, key=lambda photo: photo.time or 0.0)
