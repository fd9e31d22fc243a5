"""Step `adjust_cloud`: checks a trajectory against the cloud that was assembled by it, and corrects it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import Field

from scan2sim.pipeline.core.errors import ScanError
from scan2sim.pipeline.core.step import Context, Done, Inputs, Report, Step
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io import trajectory_check
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.slam.steps.strip_adjustment import PoseSourceParams, write_check
from scan2sim.slam.trajectory import cloud_sections
from scan2sim.slam.trajectory.cloud_sections import UncheckableError
from scan2sim.slam.trajectory.strip_adjustment import adjust

HEIGHTS_M = 0.2, 8.0
"""Usual heights of a scanner on a vehicle, a robot or a person above the ground."""
HEIGHT_WARNING = (
    "the trajectory is {:.1f} m above the lowest points beside it: if the scanner wasn't, its heights are of another "
    "datum (above the ellipsoid instead of sea level, for example). Convert them to that of the clouds"
)
CUT = 0.5
"""Progress when the cloud is cut into sections."""


class CloudCrs(Context):
    """CRS of the clouds, to which an SBET file is projected."""

    crs: str = crs_io.LOCAL


class AdjustCloudParams(PoseSourceParams):
    """Settings of the check of a cloud's trajectory.

    Attributes:
        unit: metres per unit of the coordinates.
    """

    unit: float = Field(1.0, gt=0, description="Metres per unit of the coordinates.")
    context: CloudCrs = CloudCrs()


def adjust_cloud(inputs: Inputs, params: AdjustCloudParams, out: Path, report: Report) -> Done:
    """Check the `trajectory` of clouds (`cloud.0`, `cloud.1`, ...) against the surfaces in them.

    Returns:
        `check`: folder with the files of `pipeline.io.trajectory_check`.

    Raises:
        ScanError: a file can't be read.
    """
    clouds = [path for name, path in sorted(inputs.items()) if name.startswith("cloud.")]
    frame = Frame(params.context.crs, unit=params.unit)
    path = trajectory_io.read(inputs["trajectory"], frame, ordered=False, timed=True)
    path = replace(path, unsure=None, covariance=None)
    try:
        if len(path) < 2:
            raise UncheckableError("the trajectory has only one position")
        found = cloud_sections.match(clouds, path, frame)
        path = replace(path, times=path.times + found.offset)
        sections = cloud_sections.read(clouds, path, frame, lambda part, text="": report(CUT * part, text))
    except UncheckableError as error:
        return _unchecked(out, str(error), [])
    except ScanError:
        raise
    except Exception as error:  # the check must not cost the import
        if params.pose_source == "fused":
            raise
        why = f"{type(error).__name__}: {error}"
        return _unchecked(
            out, why, [f"the poses couldn't be checked against the cloud ({why}): they are used as given"]
        )
    adjusted = replace(
        adjust(
            sections.times, sections.poses, sections.at, params.pose_source, after_gap=sections.after_gap,
            report=lambda part, text="": report(CUT + (1 - CUT) * part, text),
        ),
        data="sections",
    )  # fmt: skip
    notes = dict[str, Any]()
    if found.offset:
        notes["clock_offset_s"] = found.offset
    warnings = adjusted.warnings()
    if found.height < HEIGHTS_M[0] or found.height > HEIGHTS_M[1]:
        notes["scanner_height_m"] = round(found.height, 2)
        warnings.append(HEIGHT_WARNING.format(found.height))
    check = write_check(out / "check", sections.times, sections.poses, adjusted, notes)
    return Done({"check": check}, adjusted.figures(sections.times) | notes, warnings)


def _unchecked(out: Path, why: str, warnings: list[str]) -> Done:
    """The result of a check that wasn't possible."""
    figures: dict[str, Any] = {"pose_source": "given", "summary": f"poses as given, not checked: {why}"}
    check = trajectory_check.write(out / "check", figures | {"warnings": warnings}, None)
    return Done({"check": check}, figures, warnings)


ADJUST_CLOUD = Step("adjust_cloud", 1, adjust_cloud, AdjustCloudParams, memory=(1.0, 0))
