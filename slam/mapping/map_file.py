"""Mapped: what odometry leaves to the steps after it, kept in a file: where frames are, and the map."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera, Frame, GpsTrack
from scan2sim.slam.mapping.local_map import Keyframe, Landmarks, LocalMap, MapParams
from scan2sim.slam.odometry.checkpoint import WrongState, load, save
from scan2sim.slam.odometry.odometry import Odometry, Placed
from scan2sim.slam.odometry.virtual_cameras import Facets

VALUES = (Camera, Frame, GpsTrack, Keyframe, Landmarks, Placed)
"""What the file consists of, besides arrays and numbers."""


class Mapped:
    """Frames and map of a video.

    Attributes:
        names: of the frames.
        placed: where each is, by its keyframe.
        camera: of the frames.
        gps: the track in the frames' times, smoothed, or None.
        map: keyframes and points; what has left the window too, where odometry was told to keep it.
    """

    STATE = ("names", "placed", "camera", "gps", "_params", "_solver")
    PARTS = ("map",)

    def __init__(self) -> None:
        self.names: list[str] = []
        self.placed: list[Placed] = []
        self.camera = Camera("equirectangular", 2, 1)
        self.gps: GpsTrack | None = None
        self._params: dict[str, Any] = {}
        self._solver = "lm"

    @cached_property
    def map(self) -> LocalMap:
        """Empty at first: its camera and parameters are read before it."""
        params = MapParams.model_validate(self._params)
        return LocalMap(self.camera, params, Facets(self.camera).pixel, gps=self.gps, backend=self._solver, keep=True)

    @classmethod
    def of(cls, odometry: Odometry, names: Sequence[str]) -> Self:
        """What an odometry has come to."""
        new = cls()
        new.names, new.placed, new.camera, new.gps = list(names), odometry.placed, odometry.map.camera, odometry.gps
        new._params = {name: getattr(odometry.params, name) for name in MapParams.model_fields}
        new._solver = odometry.map.backend
        new.__dict__["map"] = odometry.map
        return new

    @classmethod
    def read(cls, path: Path) -> Self:
        """What `write` wrote.

        Raises:
            InputError: it is something else.
        """
        new = cls()
        try:
            load(path, new, VALUES)
        except WrongState as error:
            raise InputError(path, f"is no map of a video ({error})", "Track the video again") from error
        return new

    def write(self, path: Path) -> Path:
        """Into one file; returns it."""
        save(path, self, VALUES)
        return path

    def pose_of(self, placed: Placed) -> F64:
        """(4, 4) camera to world, as the map knows it now."""
        return self.map.keyframes[placed.keyframe].T_world_cam @ placed.T_key_cam
