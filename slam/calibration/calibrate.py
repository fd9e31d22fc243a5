"""Calibrate: the lens that a whole drive fits best, by odometry over what was followed, with one lens after another.

Odometry with a lens that is wrong says what a better one is (`lens.py`), as long as it isn't lost; with that, it is run
again, until nothing changes. Where the lens isn't known at all, this begins with a wide one, then with longer ones:
odometry loses itself sooner with a lens that is too long than with one that is too short.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.types import Camera
from scan2sim.slam.calibration.lens import WORTH, Known, better, changed, difference
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.track_log import Recording, plain, replay

ROUNDS = 8
"""Most often that odometry is run, with one lens after another."""
STARTS = ((0.45, 0.0), (0.45, -0.15), (0.9, 0.0), (1.8, 0.0))
"""Focal lengths that are begun with, in widths of the picture, and k1."""
LOST = 0.3
"""Of the frames, from which on odometry has lost itself."""
TELLS = 0.05
"""Of the focal length, how well it must come to be known."""
STRETCH = 60
"""Frames in which a lens that isn't known is looked for."""


def calibrated(recording: Recording, camera: Camera) -> Known | None:
    """The lens that a recording fits best, from one that is about right.

    None where the recording doesn't turn enough to tell, or odometry loses itself.
    """
    for _ in range(ROUNDS):
        odometry = replay(recording, camera, OdometryParams())
        found = better(camera, odometry.map.misfits)
        if found is None or not 0.1 < found.camera.fx / recording.size[0] < 10:
            return None
        if np.all(np.abs(difference(camera, found.camera)) < 0.1 * WORTH):
            return found if found.sigma[0] < TELLS and lost(odometry) < LOST else None
        camera = found.camera
    return None


def lost(odometry: Odometry) -> float:
    """The share of frames that are unsure."""
    return float(np.mean([placed.unsure for placed in odometry.placed]))


def looked_for(recording: Recording) -> Known | None:
    """The lens of a recording of which nothing is known; None: it isn't told."""
    part = turning(recording)
    for share, k1 in STARTS:
        found = calibrated(part, changed(plain(*recording.size, share * recording.size[0]), np.array([0, 0, 0, k1])))
        if found is not None:
            whole = None if len(part.times) == len(recording.times) else calibrated(recording, found.camera)
            return whole or found
    return None


def turning(recording: Recording) -> Recording:
    """The frames in which what is seen crosses the picture farthest."""
    moved = [0.0]
    for before, now in zip(range(len(recording.times)), range(1, len(recording.times)), strict=False):
        _, a, b = np.intersect1d(recording.ids[before], recording.ids[now], return_indices=True)
        across = recording.uv[now][b, 0] - recording.uv[before][a, 0]
        moved.append(float(np.median(across)) if len(across) else 0.0)
    way = np.cumsum(moved)
    ends = np.minimum(np.arange(len(way)) + STRETCH, len(way) - 1)
    first = int(np.abs(way[ends] - way).argmax())
    return recording.part(min(first, max(0, len(way) - STRETCH)), first + STRETCH)
