"""Map checkpoint: frame poses and the map of a video, the file that odometry passes to the following steps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, Camera, Frame, GpsTrack
from scan2sim.slam.mapping.local_map import Keyframe, Landmarks, LocalMap, MapParams
from scan2sim.slam.odometry.checkpoint import InvalidCheckpoint, load, save
from scan2sim.slam.odometry.odometry import Odometry, Placed
from scan2sim.slam.virtual_cameras import VirtualViews

VALUES = (Camera, Frame, GpsTrack, Keyframe, Landmarks, Placed)
"""Types that occur in the file. Their names and fields, and all names in `STATE`, are keys of the file format."""


class MapCheckpoint:
    """Frame poses and map of a video.

    Attributes:
        names: names of the frames.
        placed: poses of the frames, relative to keyframes.
        camera: camera of the frames.
        gps: smoothed GPS track in the frames' times, or None.
        map: keyframes and points; with `keep`, also those that have left the window.
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
        """The map; created empty by its first use, which must follow the restoring of camera and parameters."""
        params, pixel = MapParams.model_validate(self._params), VirtualViews(self.camera).pixel
        return LocalMap(self.camera, params, pixel, gps=self.gps, backend=self._solver, keep=True)

    @classmethod
    def of(cls, odometry: Odometry, names: Sequence[str]) -> Self:
        """Checkpoint of an odometry's result; `names`: names of the frames."""
        new = cls()
        new.names, new.placed, new.camera, new.gps = list(names), odometry.placed, odometry.map.camera, odometry.gps
        new._params = {name: getattr(odometry.params, name) for name in MapParams.model_fields}
        new._solver = odometry.map.backend
        new.__dict__["map"] = odometry.map
        return new

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file written by `write`.

        Raises:
            InputError: the file isn't a map checkpoint, or is damaged.
        """
        new = cls()
        try:
            load(path, new, VALUES)
        except InvalidCheckpoint as error:
            raise InputError(path, f"isn't a valid map checkpoint ({error})", "Track the video again") from error
        return new

    def write(self, path: Path) -> Path:
        """Write the checkpoint to one file; returns its path."""
        save(path, self, VALUES)
        return path

    def pose_of(self, placed: Placed) -> F64:
        """(4, 4) camera to world, by the current pose of its keyframe."""
        return self.map.keyframes[placed.keyframe].T_world_cam @ placed.T_key_cam
