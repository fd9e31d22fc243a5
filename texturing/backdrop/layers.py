"""Layers: depth maps of many photos fused into one mesh of small quadrilaterals.

Photos are visited from the last to the first one: on a drive the last ones see most of what is far, and earlier ones
add what has left the image since. A photo adds cells (`CELL_PX` pixels) where, from its position, neither the world nor
what was added before shows anything. First come pixels of which at least `MIN_AGREEING` photos found the same depth and
few see through them: to the sky, or to something behind; then those with more contradictions; then gaps between them,
behind their surroundings, so that scenery that a photo shows doesn't become a hole in the sky. Outlines against the sky
are in the texture (`layer_texture`): a cell at the edge of a crown shows sky as well, in the dome's colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scan2sim.pipeline.core.types import F32, F64, I32, I64, Bools, Frame
from scan2sim.pipeline.core.voronoi_cell import Cell
from scan2sim.texturing.backdrop.photos import FARTHEST_M, Photo, fill

CELL_PX = 3
"""Side of a cell in pixels of the matched image."""
CELL_MIN_SHARE = 0.12
"""Share of a cell's pixels that must be used for it to be added."""
SETBACK = 1.02
"""Factor on distances, so that surfaces of the world are in front of layers at the same place."""
CELLS_MIN = 15
"""A photo that would add fewer cells adds none."""
MIN_AGREEING, MAX_SEEN_THROUGH = 2, 0.25
"""Minimum number of photos that agree on a pixel's depth, and maximum number that see through it relative to them."""
MAX_COMPARED = 30
"""Number of photos, the nearest ones, that a photo's depth is compared with."""
AGREEMENT, AGREEMENT_INVERSE = 0.1, 0.003
"""Largest difference of agreeing inverse depths, relative, and in 1/metres."""
THROUGH, THROUGH_INVERSE = 0.15, 0.005
"""Difference of inverse depth from which a photo sees something behind a pixel, relative, and in 1/metres."""
MAX_HIDING = 0.05
"""Maximum share of the photos in which a cell would hide a surface."""
MAX_SKY = 0.1
"""Maximum share of the photos that see the sky where a gap is filled."""
GAP_PX, GAP_SETBACK, FAR_GAP_SETBACK = 9, 1.02, 2.5
"""Gaps are filled at the largest distance within this many pixels, times this factor."""
CONNECTED_RATIO = 1.15
"""Ratio of depths up to which neighbouring cells share their corners."""
VEHICLE_DISTANCE_M = 25.0
"""Vehicles farther than this from all cameras are scenery; others are left out, as from the world's surfaces."""
VEHICLE_MIN_INVERSE = 1 / 100.0
VEHICLE_MIN_PARALLAX_PX = 3.0
"""Vehicles whose inverse depth (1/metres) or parallax (pixels of the matched image) is smaller may be driving ahead."""
CAMERA_DISTANCE_M = 2.5
"""Pixels nearer than this to a camera are not used."""


@dataclass(frozen=True)
class Cells:
    """Cells of one photo.

    Attributes:
        photo: index of the photo.
        rows, columns: (N,) positions in the grid of cells.
        corners: (N, 2, 2, 3) local positions of the corners, by lower and right.
    """

    photo: int
    rows: I64
    columns: I64
    corners: F64


def scenery(photos: Sequence[Photo]) -> list[F32]:
    """(H, W) for each photo with depth: 0 at vehicles to leave out, and what is too near, else 1."""
    from scipy.spatial import cKDTree

    from scan2sim.pipeline.camera.models import pixel_angle

    centres, found = np.array([photo.view.centre for photo in photos]), []
    for photo in photos:
        points = photo.points
        nearest = cKDTree(centres).query(points.reshape(-1, 3))[0].reshape(photo.sky.shape)
        left_out = nearest < CAMERA_DISTANCE_M
        at, ray = points[photo.movable], photo.rays[photo.movable]
        straight = np.ones(len(at))
        for centre in centres:
            other = at - centre
            straight = np.minimum(straight, (other * ray).sum(axis=1) / np.linalg.norm(other, axis=1))
        # what drives ahead at the same speed seems infinitely far away, or as far as its surroundings in the middle
        unsure = np.arccos(np.clip(straight, -1, 1)) < VEHICLE_MIN_PARALLAX_PX * pixel_angle(photo.camera)
        unsure |= photo.inverse[photo.movable] < VEHICLE_MIN_INVERSE
        left_out[photo.movable] |= unsure | (nearest[photo.movable] < VEHICLE_DISTANCE_M)
        found.append((~left_out).astype(np.float32))
    return found


def fuse(photos: Sequence[Photo], kept: Sequence[F32]) -> list[Cells]:
    """Cells of all photos (see the module).

    Args:
        photos: photos with depth, in the order in which they were taken.
        kept: result of `scenery`.
    """
    import open3d as o3d

    casting, added = o3d.t.geometry.RaycastingScene(), list[Cells]()
    for find in (_confirmed, _likely, _gaps, _far_gaps):
        for i in reversed(range(len(photos))):
            photo = photos[i]
            shown = np.full(photo.sky.shape, np.inf, np.float32)
            if added:
                origin = np.broadcast_to(photo.view.centre, photo.rays.shape)
                rays = np.concatenate([origin, photo.rays], axis=2).astype(np.float32)
                shown = casting.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
            wanted = ~photo.hit & ~photo.sky & (kept[i] > 0) & ~np.isfinite(shown)
            cells = find(photos, i, wanted, shown) if wanted.any() else None
            if cells is None or len(cells.rows) < CELLS_MIN:
                continue
            added.append(cells)
            corners = np.ascontiguousarray(cells.corners.reshape(-1, 3), np.float32)
            casting.add_triangles(corners, np.ascontiguousarray(_faces(len(cells.rows)), np.uint32))
    return added


def _confirmed(photos: Sequence[Photo], index: int, wanted: Bools, shown: F32) -> Cells:
    """Cells of pixels whose depth others confirm."""
    import cv2

    wanted = np.asarray(cv2.morphologyEx(wanted.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2))) > 0)
    votes = _votes(photos, index, photos[index].inverse, wanted)
    used = (votes.agreeing >= MIN_AGREEING) & (votes.through <= MAX_SEEN_THROUGH * votes.agreeing)
    wanted[wanted] = used & (votes.hiding <= MAX_HIDING * votes.seen)
    return _cells(photos[index], index, photos[index].inverse, wanted)


def _likely(photos: Sequence[Photo], index: int, wanted: Bools, shown: F32) -> Cells:
    """Cells of pixels whose depth at least as many others confirm as contradict."""
    votes = _votes(photos, index, photos[index].inverse, wanted)
    wanted[wanted] = (votes.agreeing >= 1) & (votes.through <= votes.agreeing) & (votes.hiding == 0)
    return _cells(photos[index], index, photos[index].inverse, wanted)


def _gaps(photos: Sequence[Photo], index: int, wanted: Bools, shown: F32, setback: float = GAP_SETBACK) -> Cells:
    """Cells of what remains, behind its surroundings: pixels of unknown depth where few photos see the sky."""
    import cv2

    photo, kernel = photos[index], np.ones((GAP_PX, GAP_PX))
    around = np.isfinite(shown)
    inverse = cv2.erode(np.where(around, 1 / shown, np.float32(1)).astype(np.float32), kernel)
    known = np.asarray(cv2.dilate(around.astype(np.uint8), kernel) > 0)
    behind = fill(np.where(known, inverse, 0)[..., None], known)[..., 0] / np.float32(setback)
    wanted &= cv2.dilate(photo.sky.astype(np.uint8), np.ones((3, 3))) == 0
    votes = _votes(photos, index, behind, wanted)
    wanted[wanted] = (votes.sky <= MAX_SKY * votes.seen) & (votes.hiding == 0)
    return _cells(photo, index, behind, wanted)


def _far_gaps(photos: Sequence[Photo], index: int, wanted: Bools, shown: F32) -> Cells:
    """The same, far enough not to hide surfaces in other photos."""
    return _gaps(photos, index, wanted, shown, FAR_GAP_SETBACK)


def within(cells: Cells, frame: Frame, cell: Cell) -> Cells:
    """The cells whose centre is within a tile's cell."""
    centre = cells.corners.mean(axis=(1, 2))[:, :2] + np.asarray(frame.origin)[:2]
    inside = cell.outside(centre) <= 0
    return Cells(cells.photo, cells.rows[inside], cells.columns[inside], cells.corners[inside])


def _faces(count: int) -> I32:
    """(2 * count, 3) triangles of quadrilaterals with four corners each, seen from the photo."""
    k = 4 * np.arange(count)
    return np.concatenate([np.stack([k, k + 2, k + 1], 1), np.stack([k + 1, k + 2, k + 3], 1)]).astype(np.int32)


@dataclass(frozen=True)
class Votes:
    """Numbers (N,) of other photos that see N pixels of a photo, by what they see there.

    Attributes:
        seen: all whose image contains the place.
        agreeing: that found the same depth.
        through: that see something behind it, the sky, or a surface that it would hide.
        sky: that see the sky.
        hiding: in which it would hide a surface.
    """

    seen: I32
    agreeing: I32
    through: I32
    sky: I32
    hiding: I32


def _votes(photos: Sequence[Photo], index: int, inverse: F32, wanted: Bools) -> Votes:
    """Compare the wanted pixels (H, W) of a photo, at an inverse depth (H, W), with other photos."""
    import cv2

    from scan2sim.pipeline.camera.projection import pixels

    photo = photos[index]
    points = photo.view.centre + photo.rays[wanted] / np.maximum(inverse[wanted], 1 / FARTHEST_M)[:, None]
    seen, agreeing, through, sky, hiding = np.zeros((5, len(points)), np.int32)
    distance = [np.linalg.norm(other.view.centre - photo.view.centre) for other in photos]
    nearest = [int(k) for k in np.argsort(distance, kind="stable") if k != index]
    for other in (photos[k] for k in nearest[:MAX_COMPARED]):
        uv, inside = pixels(other.camera, other.view.T_world_cam, points)
        uv = np.where(inside[:, None], uv, 0)  # NaN behind the camera
        column, row = np.clip(np.rint(uv).astype(int), 0, np.array(other.sky.shape[::-1]) - 1).T
        expected = 1 / np.maximum(np.linalg.norm(points - other.view.centre, axis=1), 0.1)
        found = other.inverse[row, column]
        is_sky = cv2.erode(other.sky.astype(np.uint8), np.ones((3, 3)))[row, column] > 0
        same = np.abs(found - expected) < np.maximum(AGREEMENT * expected, AGREEMENT_INVERSE)
        behind = found < expected - np.maximum(THROUGH * expected, THROUGH_INVERSE)
        hidden = other.hit[row, column] & (other.known[row, column] * expected > 1)
        seen += inside
        agreeing += inside & same & ~is_sky
        through += inside & (behind | hidden | is_sky)
        sky += inside & is_sky
        hiding += inside & hidden
    return Votes(seen, agreeing, through, sky, hiding)


def _cells(photo: Photo, index: int, inverses: F32, used: Bools) -> Cells:
    """Cells of the used pixels, at their median depth."""
    from scan2sim.pipeline.camera.models import unproject

    height, width = (n // CELL_PX for n in used.shape)

    def blocks(values: F32 | Bools) -> F32:
        cut = values[: height * CELL_PX, : width * CELL_PX].reshape(height, CELL_PX, width, CELL_PX)
        return np.asarray(cut.swapaxes(1, 2).reshape(height, width, -1), np.float32)

    chosen = blocks(used) > 0
    inverse = _medians(blocks(inverses), chosen)
    wanted = chosen.mean(axis=2) >= CELL_MIN_SHARE
    rows, columns = np.nonzero(wanted)
    at_corner = _corner_inverse(inverse, wanted)[rows, columns]
    corners = np.empty((len(rows), 2, 2, 3))
    for lower in (0, 1):
        for right in (0, 1):
            pixel = np.column_stack([columns + right, rows + lower]) * CELL_PX - 0.5
            ray = np.nan_to_num(unproject(photo.camera, pixel)) @ photo.view.T_world_cam[:3, :3].T
            distance = SETBACK / np.maximum(at_corner[:, lower, right], 1 / FARTHEST_M)
            corners[:, lower, right] = photo.view.centre + ray * distance[:, None]
    return Cells(index, rows, columns, corners)


def _medians(values: F32, chosen: Bools) -> F32:
    """(h, w) medians of those of the values (h, w, N) that are chosen; NaN without any."""
    ordered, count = np.sort(np.where(chosen, values, np.nan), axis=2), chosen.sum(axis=2, keepdims=True)
    lower, upper = (np.take_along_axis(ordered, k, axis=2) for k in (np.maximum(count - 1, 0) // 2, count // 2))
    return np.asarray(np.where(count > 0, (lower + upper) / 2, np.nan)[..., 0], np.float32)


def _corner_inverse(inverse: F32, wanted: Bools) -> F64:
    """(h, w, 2, 2) inverse depth at the corners of cells: the mean of those cells around it that are connected."""
    height, width = inverse.shape
    padded = np.pad(np.where(wanted, inverse, np.nan), 1, constant_values=np.nan)
    found = np.zeros((height, width, 2, 2))
    slack = 0.001
    for lower in (0, 1):
        for right in (0, 1):
            total, count = np.zeros((height, width)), np.zeros((height, width))
            for down in (0, 1):
                for across in (0, 1):
                    near = padded[lower + down :, right + across :][:height, :width]
                    connected = (near < inverse * CONNECTED_RATIO + slack) & (near > inverse / CONNECTED_RATIO - slack)
                    total += np.where(connected, near, 0)
                    count += connected
            found[..., lower, right] = total / np.maximum(count, 1)
    return found


def mesh(cells: Sequence[Cells], coordinates: Sequence[F32]) -> tuple[F32, I32, F32]:
    """Vertices (V, 3), faces (F, 3) and texture coordinates (F, 3, 2) of cells; shared corners are merged."""
    corners = np.concatenate([one.corners.reshape(-1, 3) for one in cells]).astype(np.float32)
    uv = np.concatenate([one.reshape(-1, 2) for one in coordinates])
    faces = _faces(len(corners) // 4)
    vertices, index = np.unique(corners.round(4), axis=0, return_inverse=True)
    return vertices, index.ravel()[faces].astype(np.int32), uv[faces].astype(np.float32)
