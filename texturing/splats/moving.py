"""Pixels of photos that show what moved: vehicles, people and scanned points that moved, not vehicles at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera import depth_map
from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import Bools, Frame, PointCloud
from scan2sim.pipeline.dynamic_objects.instance_boxes import boxes, is_parked
from scan2sim.texturing.backdrop.photos import Photo
from scan2sim.texturing.whole_frame import BEYOND_MEASURED_M, BOX_BEHIND_M

MARGIN_PX = 3
"""Width of the seam around what moved that isn't used either."""
SCANNED_MARGIN_M = 0.3
"""Metres around points that moved that isn't used either: their object is larger than what was scanned of it."""


class MovingMask:
    """Masks of what moved, by the boxes of detected instances and the classes of photos.

    Args:
        instances: boxes on the ground, from the step `instances`; None: all vehicles and people count as moving.
        frame: the tile's frame.
        parked: parked vehicles are shown.
        points: points that moved, with normals and times; None: none.
    """

    def __init__(self, instances: Path | None, frame: Frame, parked: bool, points: PointCloud | None = None) -> None:
        self._points = None if points is None or not len(points) else depth_map.scene([], moving=points)
        self._still: Renderer | None = None
        self._moved: Renderer | None = None
        if instances is not None and parked:
            still = boxes(instances, frame, is_parked)
            moved = boxes(instances, frame, lambda about: not is_parked(about))
            self._still, self._moved = Renderer([Body(still)]), Renderer([Body(moved)])

    def of(self, photo: Photo) -> Bools:
        """(H, W) pixels of a prepared photo that must not be used: what moved, and what the photo's mask excludes.

        A pixel of the class vehicle or person belongs to the nearest instance whose box it is in, or near which it is;
        those of stationary instances are used. Without boxes, all of them moved.
        """
        return self._of_instances(photo) | self._scanned(photo)

    def _of_instances(self, photo: Photo) -> Bools:
        """(H, W) pixels of vehicles and people that moved, and of the photo's mask."""
        import cv2

        if self._still is None or self._moved is None:
            return photo.movable
        still = self._still.view(photo.camera, photo.view.T_world_cam)
        moved = self._moved.view(photo.camera, photo.view.T_world_cam)
        surface = np.minimum(photo.known, np.float32(1e6))
        in_moved = moved.hit & (moved.range < still.range) & (moved.range < surface + BOX_BEHIND_M)
        in_still = photo.movable & still.hit & ~in_moved
        kept = np.zeros(photo.movable.shape, bool)
        if in_still.any():
            seeds = in_still | (photo.movable & in_moved)
            away, nearest = cv2.distanceTransformWithLabels(
                (~seeds).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
            )
            is_still, distance = (np.zeros(int(nearest.max()) + 1, kind) for kind in (bool, np.float32))
            is_still[nearest[seeds]] = in_still[seeds]
            distance[nearest[seeds]] = np.where(in_still, still.range, moved.range)[seeds]
            metres = away * pixel_angle(photo.camera) * distance[nearest]
            kept = is_still[nearest] & (metres < BEYOND_MEASURED_M)
        excluded = (photo.movable & ~kept) | in_moved
        excluded = np.asarray(cv2.dilate(excluded.astype(np.uint8), np.ones((MARGIN_PX, MARGIN_PX))) > 0)
        return np.asarray(excluded | photo.masked)

    def _scanned(self, photo: Photo) -> Bools:
        """(H, W) pixels of points that moved and were scanned at about the time of the photo."""
        import cv2

        shape = photo.movable.shape
        if self._points is None or photo.view.time is None:
            return np.zeros(shape, bool)
        view, pixels = photo.view, shape[0] * shape[1]
        seen = depth_map.depth_map(view.camera, view.T_world_cam, self._points, time=view.time, pixels=pixels)
        range_ = np.asarray(cv2.resize(seen.range, shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)
        found: Bools = np.isfinite(range_) & (range_ < photo.known + BOX_BEHIND_M)
        if not found.any():
            return found
        away, nearest = cv2.distanceTransformWithLabels(
            (~found).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        distance = np.zeros(int(nearest.max()) + 1, np.float32)
        distance[nearest[found]] = range_[found]
        return np.asarray(away * pixel_angle(photo.camera) * distance[nearest] < SCANNED_MARGIN_M)
