"""Pixels of photos that show what moved: vehicles and people, but not vehicles that stand still."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.camera.models import pixel_angle
from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.types import Bools, Frame
from scan2sim.texturing.backdrop.photos import Photo
from scan2sim.texturing.whole_frame import BEYOND_MEASURED_M, BOX_BEHIND_M, instance_boxes

MARGIN_PX = 3
"""Width of the seam around what moved that isn't used either."""


class MovingMask:
    """Masks of what moved, by the boxes of detected instances and the classes of photos.

    Args:
        instances: boxes on the ground, from the step `instances`; None: all vehicles and people count as moving.
        frame: the tile's frame.
        parked: vehicles that stand still are shown.
    """

    def __init__(self, instances: Path | None, frame: Frame, parked: bool) -> None:
        self._still: Renderer | None = None
        self._moved: Renderer | None = None
        if instances is not None and parked:
            still = instance_boxes(instances, frame, lambda about: about["kind"] != "person" and not about["moved"])
            moved = instance_boxes(instances, frame, lambda about: about["kind"] == "person" or about["moved"])
            self._still, self._moved = Renderer([Body(still)]), Renderer([Body(moved)])

    def of(self, photo: Photo) -> Bools:
        """(H, W) pixels of a prepared photo that must not be used: what moved, and what the photo's mask excludes.

        A pixel of the class vehicle or person belongs to the nearest instance whose box it is in, or near which it is;
        those of instances that stand still are used. Without boxes, all of them moved.
        """
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
