"""What importers of a moving scanner's sweeps share: sweeps as KITTI has them, colours from photos, thinning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, U8, UNCOLOURED, Bools, Camera
from scan2sim.pipeline.io.images.image import read_rgb

COLOUR_REACH = 0.2  # metres over which a point that its own photo doesn't show borrows a colour
COLOUR_VOXEL = 0.1
BIN = np.radians([0.3, 0.5])  # across and down, within which what is nearer hides what is farther
BEHIND = 1.3  # times as far: the road itself recedes by so much within a bin
NEAREST = 0.5  # metres: what is nearer to the lens gets no colour from it


def read_bin(path: Path) -> tuple[F32, F32]:
    """(N, 3) points in scanner axes and (N,) reflectance of a sweep as KITTI has it: float32 x, y, z, reflectance.

    Raises:
        InputError: it isn't one.
    """
    data = np.fromfile(path, np.float32)
    if data.size == 0 or data.size % 4:
        raise InputError(path, f"is no Velodyne sweep ({data.size * 4} bytes)", "Copy it again")
    data = data.reshape(-1, 4)
    data = data[np.isfinite(data).all(axis=1)]
    return data[:, :3], np.clip(data[:, 3], 0, 1)


def phase_of(xyz: F32) -> F64:
    """(N,) when within a sweep each point was measured, 0 to 1: by a scanner (z up, x ahead) as KITTI's.

    It turns clockwise, starts and ends looking back, and faces forward in the middle.
    """
    return 0.5 - np.arctan2(xyz[:, 1], xyz[:, 0], dtype=np.float64) / (2 * np.pi)


def colour(
    world: F64,
    T_world_cam: F64,
    camera: Camera,
    photo: Path,
    rgb: U8,
    seen: Bools,
    *,
    mask: U8 | None = None,
    remedy: str = "Give the camera that took it",
) -> None:
    """Fill `rgb` and `seen` (N,) of points (N, 3) that fall into the photo and no earlier one has shown.

    The points are those of the sweep taken beside it: what lies well behind others of them in the photo is hidden.

    Args:
        mask: (H, W), 0 where the photo must not be used.
        remedy: what to do about a photo of another size than its camera's.

    Raises:
        InputError: the photo can't be read, or has another size.
    """
    from scan2sim.pipeline.camera.models import inside, project

    image = read_rgb(photo)
    if image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(photo, f"is {size}, but its calibration says {camera.width}x{camera.height}", remedy)
    local = (world - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    uv, valid = project(camera, local)
    distance = np.linalg.norm(local, axis=1)
    good = valid & inside(camera, uv) & (distance > NEAREST)
    good[good] = ~_hidden(uv[good], distance[good], camera)
    good &= ~seen
    u, v = np.clip(np.rint(uv[good]).astype(int), 0, [camera.width - 1, camera.height - 1]).T
    if mask is not None:
        shown = mask[v, u] > 0
        good[good], u, v = shown, u[shown], v[shown]
    rgb[good] = image[v, u]
    seen |= good


def _hidden(uv: F64, distance: F64, camera: Camera) -> Bools:
    """(N,) which points at pixels (N, 2) lie well behind others of the sweep in the same or the next column of bins.

    Bins are as high as scan lines are apart: the road's own points, one line behind the other, hide none.
    """
    from scan2sim.pipeline.camera.models import pixel_angle

    bins = np.maximum(BIN / pixel_angle(camera), 1.0)  # pixels
    width, height = np.ceil([camera.width, camera.height] / bins).astype(int)
    u, v = np.clip(np.floor((uv + 0.5) / bins).astype(int), 0, [width - 1, height - 1]).T
    nearest = np.full((height, width + 2), np.inf)
    np.minimum.at(nearest, (v, u + 1), distance)
    around = np.minimum(nearest[v, u], np.minimum(nearest[v, u + 1], nearest[v, u + 2]))
    return np.asarray(distance > BEHIND * around + NEAREST, bool)


def borrow_colours(xyz: F32, rgb: U8, seen: Bools, distance: F32) -> U8:
    """Colours (N, 3) where points that are not `seen` take that of the nearest seen one within reach, or grey.

    Of the seen points in a 10 cm voxel only the one at the smallest `distance` from its camera counts.
    """
    from scipy.spatial import cKDTree

    out = rgb.copy()
    out[~seen] = UNCOLOURED
    index = np.flatnonzero(seen)
    if len(index) in (0, len(xyz)):
        return out
    index = index[thin(xyz[index], COLOUR_VOXEL, distance[index])]
    tree = cKDTree(xyz[index])
    rest = np.flatnonzero(~seen)
    for some in np.array_split(rest, max(1, len(rest) // 2_000_000)):
        gap, nearest = tree.query(xyz[some], distance_upper_bound=COLOUR_REACH, workers=-1)
        close = np.isfinite(gap)
        out[some[close]] = rgb[index[nearest[close]]]
    return out


def thin(xyz: F32, size: float, rank: npt.NDArray[np.floating]) -> npt.NDArray[np.intp]:
    """Indices of one point for each voxel of `size` metres: that of the smallest `rank` (N,)."""
    order = np.argsort(rank, kind="stable")
    cells = np.floor(xyz[order] / size).astype(np.int64)
    cells -= cells.min(axis=0)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_index=True)
    return order[first]
