"""Colours of lidar points: from photos taken beside their sweep, with occlusion, else from coloured points nearby."""

from __future__ import annotations

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F32, F64, U8, UNCOLOURED, Bools, Camera, View
from scan2sim.pipeline.geometry.voxel_grid import thin_voxels
from scan2sim.pipeline.io.images.image import read_rgb

MAX_COLOUR_DISTANCE_M = 0.2  # from an uncoloured point to the coloured point whose colour it gets
COLOUR_VOXEL_M = 0.1
OCCLUSION_BIN_RAD = np.radians([0.3, 0.5])  # horizontal and vertical size of the bins of the occlusion test
OCCLUSION_DISTANCE_RATIO = 1.3  # a point this much farther than the nearest is hidden; less occurs on the road itself
MIN_PHOTO_DISTANCE_M = 0.5  # points nearer to the camera get no colour from it


def colour_from_photo(world: F64, view: View, rgb: U8, seen: Bools, *, mask: U8 | None = None, remedy: str) -> None:
    """Set `rgb` and `seen` (N,) of points (N, 3) that are visible in the photo and not coloured yet.

    The points are those of the sweep taken beside the photo: points well behind others of them are occluded.

    Args:
        world: (N, 3) points of the sweep.
        view: the photo.
        rgb: (N, 3) colours, changed in place.
        seen: (N,) whether a point has a colour, changed in place.
        mask: (H, W), 0 where the photo must not be used.
        remedy: remedy of the error if the photo's size differs from its camera's.

    Raises:
        InputError: the photo can't be read, or has another size.
    """
    from scan2sim.pipeline.camera.models import inside, project

    image, camera = read_rgb(view.photo), view.camera
    if image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(view.photo, f"is {size}, but its calibration is for {camera.width}x{camera.height}", remedy)
    local = (world - view.centre) @ view.T_world_cam[:3, :3]
    uv, valid = project(camera, local)
    distance = np.linalg.norm(local, axis=1)
    good = valid & inside(camera, uv) & (distance > MIN_PHOTO_DISTANCE_M)
    good[good] = ~_occluded(uv[good], distance[good], camera)
    good &= ~seen
    u, v = np.clip(np.rint(uv[good]).astype(int), 0, [camera.width - 1, camera.height - 1]).T
    if mask is not None:
        usable = mask[v, u] > 0
        good[good], u, v = usable, u[usable], v[usable]
    rgb[good] = image[v, u]
    seen |= good


def _occluded(uv: F64, distance: F64, camera: Camera) -> Bools:
    """Whether each point (N,) at pixels (N, 2) is well behind others of the sweep in its own or an adjacent bin column.

    The height of a bin is the spacing of scan lines, so that lines on the road don't occlude each other.
    """
    from scan2sim.pipeline.camera.models import pixel_angle

    bins = np.maximum(OCCLUSION_BIN_RAD / pixel_angle(camera), 1.0)  # pixels
    width, height = np.ceil([camera.width, camera.height] / bins).astype(int)
    u, v = np.clip(np.floor((uv + 0.5) / bins).astype(int), 0, [width - 1, height - 1]).T
    nearest = np.full((height, width + 2), np.inf)
    np.minimum.at(nearest, (v, u + 1), distance)
    occluder = np.minimum(nearest[v, u], np.minimum(nearest[v, u + 1], nearest[v, u + 2]))
    return np.asarray(distance > OCCLUSION_DISTANCE_RATIO * occluder + MIN_PHOTO_DISTANCE_M, bool)


def fill_colours(xyz: F32, rgb: U8, seen: Bools, distance: F32) -> U8:
    """Colours (N, 3) in which points that aren't `seen` get that of the nearest seen point nearby, or grey.

    Of the seen points in a 10 cm voxel only the one with the smallest `distance` from its camera is used.
    """
    from scipy.spatial import cKDTree

    out = rgb.copy()
    out[~seen] = UNCOLOURED
    index = np.flatnonzero(seen)
    if len(index) in (0, len(xyz)):
        return out
    index = index[thin_voxels(xyz[index], COLOUR_VOXEL_M, distance[index])]
    tree = cKDTree(xyz[index])
    unseen = np.flatnonzero(~seen)
    for chunk in np.array_split(unseen, max(1, len(unseen) // 2_000_000)):
        gap, nearest = tree.query(xyz[chunk], distance_upper_bound=MAX_COLOUR_DISTANCE_M, workers=-1)
        close = np.isfinite(gap)
        out[chunk[close]] = rgb[index[nearest[close]]]
    return out
