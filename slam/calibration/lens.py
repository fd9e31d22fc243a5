"""Lens: whether focal length, centre and distortion that a camera is said to have fit what it sees, or which do.

Where the car turns, a wrong lens contradicts itself: what crosses the picture turns by more, or less, than the picture
says. A window's graph is solved again with the lens as four numbers more; what that says of them is added up over all
windows. Straight ahead a lens is hardly told apart from what Lucas-Kanade's own small errors do, so only windows that
turn are asked. Distortion and focal length are hard to tell apart, too: there is none unless there clearly is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scan2sim.pipeline.camera.models import project_exactly, unproject
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.slam.geometry import log_so3
from scan2sim.slam.mapping.factor_graph import Graph, errors
from scan2sim.slam.solvers import lm

MODELS = ("pinhole", "opencv")
"""Of cameras that can be asked."""
TURN = np.radians(20)
"""Between the first and the last camera of a window that is asked."""
LIKELY = np.array([0.5, 0.3, 0.3, 0.3])
"""By how much each may well be wrong: the focal length's logarithm, the centre's place (in focal lengths), k1."""
ALIKE = 25.0
"""Lucas-Kanade's errors are alike from frame to frame and from point to point: a lens is known so many times less well
than as if they weren't. Found on rendered turns, whose lens is known."""
WORTH = np.array([0.02, 0.02, 0.02, 0.05])
"""From which on a user is told."""
CLEAR = 3.0
"""Standard deviations from which on something is no chance."""
ROUNDS = 5
"""Most often that a window is solved again with the lens that came out."""
STEP = 1e-5


@dataclass(frozen=True)
class Known:
    """A lens: `camera`, and `sigma` (4,), standard deviations of what `LIKELY` names."""

    camera: Camera
    sigma: F64


def changed(camera: Camera, by: F64) -> Camera:
    """The camera whose focal length, centre and k1 are changed by (4,) of what `LIKELY` names."""
    k1, *others = camera.distortion or (0.0,)
    k1 += float(by[3])
    bent = k1 != 0 or any(others)
    return replace(
        camera, model="opencv" if bent else "pinhole", fx=camera.fx * float(np.exp(by[0])),
        fy=camera.fy * float(np.exp(by[0])), cx=camera.cx + camera.fx * float(by[1]),
        cy=camera.cy + camera.fy * float(by[2]),
        distortion=(k1, *others, *[0.0] * (3 - len(others))) if bent else (),
    )  # fmt: skip


def difference(camera: Camera, other: Camera) -> F64:
    """(4,) what changes a camera into the other."""
    k1, other_k1 = ((one.distortion or (0.0,))[0] for one in (camera, other))
    centre = (other.cx - camera.cx) / camera.fx, (other.cy - camera.cy) / camera.fy
    return np.array([np.log(other.fx / camera.fx), *centre, other_k1 - k1])


def misfit(camera: Camera, graph: Graph) -> F64 | None:
    """(4, 5) what a graph says of its camera's lens: information of the four numbers, and that times what they are off.

    None where it turns too little to tell, or sees too little.
    """
    first, last = graph.poses[0, :3, :3], graph.poses[-1, :3, :3]
    if camera.model not in MODELS or np.linalg.norm(log_so3(first.T @ last)) < TURN:
        return None
    uv, _ = project_exactly(camera, graph.bearing)
    off = np.zeros(4)
    graph = replace(graph, fixed=np.arange(len(graph.poses)) < 1, shared_sigma=LIKELY / ALIKE, chords=())
    for _ in range(ROUNDS):
        free = _seen_by(changed(camera, off), graph, uv, off)
        if free is None:
            return None
        solved = lm.solve(free, iterations=15)
        off = off + solved.shared
        graph = replace(graph, poses=solved.poses, points=solved.points)
        if np.all(np.abs(solved.shared) < 0.05 * WORTH):
            break
    free = _seen_by(changed(camera, off), graph, uv, off)
    if free is None:
        return None
    noise = float(np.median(errors(free, free.poses, free.points))) / 1.18  # of two components each
    says = lm.information_of_shared(free) / (noise * ALIKE) ** 2
    return np.concatenate([says, (says @ off)[:, None]], axis=1)


def _seen_by(camera: Camera, graph: Graph, uv: F64, off: F64) -> Graph | None:
    """The graph of pixels (O, 2) as a camera `off` (4,) from the first sees them, its lens free; None: it can't."""
    bearing = unproject(camera, uv)
    moves = np.stack(
        [
            (unproject(changed(camera, h), uv) - unproject(changed(camera, -h), uv)) / (2 * STEP)
            for h in STEP * np.eye(4)
        ],
        axis=1,
    )
    if not np.isfinite(moves).all():
        return None
    bend = np.zeros((len(uv), 4, 6))  # another direction is another turn of the camera
    bend[:, :, 3:] = np.einsum("oij,osj->osi", graph.poses[graph.camera_of, :3, :3], np.cross(bearing[:, None], moves))
    return replace(graph, bearing=bearing, bend=bend, shared=np.zeros(4), believed=-off)


def better(camera: Camera, misfits: Sequence[F64]) -> Known | None:
    """The lens that fits windows' misfits best, and how well it is known; None without any."""
    if not len(misfits):
        return None
    total = np.sum(misfits, axis=0)
    says, right = total[:, :4] + np.diag(LIKELY**-2.0), total[:, 4]
    covariance = np.linalg.inv(says)
    off, sigma = covariance @ right, np.sqrt(np.diag(covariance))
    if not camera.distortion and abs(off[3]) < max(CLEAR * sigma[3], WORTH[3]):
        off[:3], off[3] = np.linalg.solve(says[:3, :3], right[:3]), 0.0
        sigma[:3], sigma[3] = np.sqrt(np.diag(np.linalg.inv(says[:3, :3]))), 0.0
    return Known(changed(camera, off), sigma)


def told(camera: Camera, found: Known | None) -> str | None:
    """What a user should read of a lens that was found; nothing where the camera's own fits."""
    if found is None:
        return None
    wrong = np.abs(difference(camera, found.camera)) > np.maximum(WORTH, CLEAR * found.sigma)
    if not wrong.any():
        return None
    now, sigma = found.camera, found.sigma
    fits = []
    if wrong[0] or wrong[3]:
        fits.append(f"a focal length of {now.fx:.0f} +- {sigma[0] * now.fx:.0f} pixels better than {camera.fx:.0f}")
    if wrong[1] or wrong[2]:
        fits.append(
            f"a centre at {now.cx:.0f}, {now.cy:.0f} (+- {sigma[1] * now.fx:.0f}, {sigma[2] * now.fx:.0f}) better than "
            f"{camera.cx:.0f}, {camera.cy:.0f}"
        )
    if wrong[3]:
        k1, better_k1 = ((one.distortion or (0.0,))[0] for one in (camera, now))
        fits.append(f"distortion k1 = {better_k1:.2f} +- {sigma[3]:.2f} better than {k1:.2f}")
    return (
        f"in turns, the pictures fit {', and '.join(fits)}: check --focal, --centre and --k1, and whether the pictures "
        "were cropped or scaled; --calibrate finds them"
    )
