"""Step `read_bag`: sweeps, photos, calibration and poses of a ROS bag as files."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.step import Context, Done, Inputs, Report, Step
from scan2sim.pipeline.importers.bag.plan import BagParams
from scan2sim.pipeline.importers.bag.unpack import unpack


class Planned(Context):
    """How the topics were chosen.

    Attributes:
        warnings: of the choice; the step's parameters name the topics, so that it doesn't choose again.
    """

    warnings: tuple[str, ...] = ()


class ReadBagParams(BagParams):
    """Which topics of a bag are imported, and how."""

    context: Planned = Planned()


def read_bag(inputs: Inputs, params: ReadBagParams, out: Path, report: Report) -> Done:
    """Unpack `bag` (a file or folder), with optional `intrinsics` (cameras, instead of CameraInfo) and `urdf`.

    Raises:
        ScanError: as `pipeline.importers.bag.unpack.unpack`.
    """
    warnings = list(params.context.warnings)
    beside = {"intrinsics": inputs.get("intrinsics"), "urdf": inputs.get("urdf")}
    found = unpack(inputs["bag"], out, params, **beside, warn=warnings.append, report=report)
    files = {"sweeps": found.sweeps, "photos": found.photos, "poses": found.poses, "gps": found.gps}
    m = found.metrics
    summary = f"{m['sweeps']:,} sweeps and {m['photos']:,} photos in {m['seconds']:,.1f} s; poses by {m['poses']}"
    given = {name: path for name, path in files.items() if path is not None}
    return Done(given, m | {"summary": summary}, list(dict.fromkeys(warnings)))


def can_read(params: ReadBagParams) -> None:
    """Raise UnavailableError if the package `rosbags` isn't installed."""
    require("ROS bags", "rosbags", extra="bag")


READ_BAG = Step("read_bag", 2, read_bag, ReadBagParams, check=can_read, memory=(0.6, 0))
