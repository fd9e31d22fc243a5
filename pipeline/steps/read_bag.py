"""Step `read_bag`: sweeps, photos, calibration and poses of a ROS bag as files."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.importers.bag.plan import BagParams
from scan2sim.pipeline.importers.bag.unpack import unpack


def read_bag(inputs: Inputs, params: BagParams, out: Path, report: Report) -> Done:
    """Unpack `bag` (a file or folder), with optional `intrinsics` (cameras, instead of CameraInfo) and `urdf`.

    Raises:
        ScanError: as `pipeline.importers.bag.unpack.unpack`.
    """
    warnings: list[str] = []
    beside = {"intrinsics": inputs.get("intrinsics"), "urdf": inputs.get("urdf")}
    found = unpack(inputs["bag"], out, params, **beside, warn=warnings.append, report=report)
    files = {"sweeps": found.sweeps, "photos": found.photos, "poses": found.poses, "gps": found.gps}
    m = found.metrics
    summary = f"{m['sweeps']:,} sweeps and {m['photos']:,} photos in {m['seconds']:,.1f} s; poses by {m['poses']}"
    given = {name: path for name, path in files.items() if path is not None}
    return Done(given, m | {"summary": summary}, warnings)


def can_read(params: BagParams) -> None:
    """Raise UnavailableError if the package `rosbags` isn't installed."""
    require("ROS bags", "rosbags", extra="bag")


READ_BAG = Step("read_bag", 1, read_bag, BagParams, check=can_read, memory=(0.6, 0))
