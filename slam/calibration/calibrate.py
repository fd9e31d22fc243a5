"""Self-calibration: the lens that fits a whole drive best, by running odometry over a track log with several lenses.

Odometry with a wrong lens yields a better estimate (`lens.py`) unless tracking is lost; it is repeated with that
estimate until it converges. If the lens is unknown, it starts with a wide one, then tries longer ones: tracking is lost
sooner with a focal length that is too long than with one that is too short.
"""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.camera.lens import changed_lens, lens_difference
from scan2sim.pipeline.core.types import Camera
from scan2sim.slam.lens import LensEstimate, fit_lens
from scan2sim.slam.odometry.odometry import Odometry, OdometryParams
from scan2sim.slam.odometry.track_log import TrackLog, centred_pinhole, replay

ROUNDS_MAX = 8
"""Greatest number of odometry runs per starting lens."""
INITIAL_LENSES = ((0.45, 0.0), (0.45, -0.15), (0.9, 0.0), (1.8, 0.0))
"""Starting focal lengths, in widths of the image, and k1."""
LOST_SHARE_MAX = 0.3
"""Share of unsure frames above which odometry counts as lost."""
CONVERGED_SIGMAS = 0.3
"""Change of every lens parameter, in standard deviations, below which a lens has converged."""
FOCAL_SIGMA_MAX = 0.05
"""Greatest accepted relative standard deviation of the focal length."""
SEARCH_FRAMES = 60
"""Number of frames over which an unknown lens is first searched for."""


def calibrated(log: TrackLog, camera: Camera) -> LensEstimate | None:
    """Lens that fits a track log best, from an approximately known one.

    None if the camera turns too little to determine it, or tracking is lost.
    """
    for _ in range(ROUNDS_MAX):
        odometry = replay(log, camera, OdometryParams())
        found = fit_lens(camera, odometry.map.misfits)
        if found is None or not 0.1 < found.camera.fx / log.size[0] < 10:
            return None
        if np.all(np.abs(lens_difference(camera, found.camera)) < CONVERGED_SIGMAS * found.sigma):
            return found if found.sigma[0] < FOCAL_SIGMA_MAX and lost_share(odometry) < LOST_SHARE_MAX else None
        camera = found.camera
    return None


def lost_share(odometry: Odometry) -> float:
    """Share of unsure frames."""
    return float(np.mean([placed.unsure for placed in odometry.placed]))


def calibrated_from_scratch(log: TrackLog) -> LensEstimate | None:
    """Lens of a track log without any prior knowledge; None if it can't be determined."""
    part = most_turning_part(log)
    for widths, k1 in INITIAL_LENSES:
        start = changed_lens(centred_pinhole(*log.size, widths * log.size[0]), np.array([0, 0, 0, k1, 0]))
        found = calibrated(part, start)
        if found is not None:
            whole = None if len(part.times) == len(log.times) else calibrated(log, found.camera)
            return whole or found
    return None


def most_turning_part(log: TrackLog) -> TrackLog:
    """The `SEARCH_FRAMES` frames with the largest horizontal image motion."""
    moved = [0.0]
    for before, now in zip(range(len(log.times)), range(1, len(log.times)), strict=False):
        _, a, b = np.intersect1d(log.ids[before], log.ids[now], return_indices=True)
        shift = log.uv[now][b, 0] - log.uv[before][a, 0]
        moved.append(float(np.median(shift)) if len(shift) else 0.0)
    total = np.cumsum(moved)
    ends = np.minimum(np.arange(len(total)) + SEARCH_FRAMES, len(total) - 1)
    first = int(np.abs(total[ends] - total).argmax())
    return log.part(min(first, max(0, len(total) - SEARCH_FRAMES)), first + SEARCH_FRAMES)
