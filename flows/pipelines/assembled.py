"""Import of assembled clouds: their trajectory is checked against the surfaces, and corrected if that improves them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from scan2sim.flows.pipelines.graph import Task
from scan2sim.flows.pipelines.uncached import CHECKED, run_check
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.importers.clouds_and_photos import common_crs, import_las
from scan2sim.pipeline.io.tile_folder import check_target
from scan2sim.slam.steps.adjust_cloud import ADJUST_CLOUD, AdjustCloudParams, CloudCrs
from scan2sim.slam.trajectory.strip_adjustment import PoseSource


def check(
    clouds: Sequence[Path], trajectory: Path, pose_source: PoseSource, *, crs: str | None, units: str | None
) -> Task:
    """The task that checks a trajectory against the clouds that it assembled.

    Args:
        clouds, trajectory, crs, units: as in `import_clouds`.
        pose_source: "auto" or "fused".

    Raises:
        ScanError: a cloud can't be read, or has no CRS.
    """
    known, unit = common_crs(clouds, crs, units)
    inputs: dict[str, Any] = {f"cloud.{i}": cloud for i, cloud in enumerate(clouds)}
    return Task(
        ADJUST_CLOUD,
        AdjustCloudParams(pose_source=pose_source, unit=unit, context=CloudCrs(crs=known)),
        inputs | {"trajectory": trajectory},
    )


def import_clouds(
    clouds: Sequence[Path],
    out: Path,
    *,
    trajectory: Path | None = None,
    pose_source: PoseSource = "auto",
    crs: str | None = None,
    units: str | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Report = silent,
    **options: Any,
) -> Path:
    """Create a tile from clouds, as `pipeline.importers.clouds_and_photos.import_las`, with a checked trajectory.

    Args:
        pose_source: "given" uses cloud and trajectory as they are; "auto" checks whether surfaces that were scanned at
            different times agree, and corrects them if they agree clearly better then; "fused" always corrects them.
            Clouds in another order of `axes` can't be checked: they are used as they are.
        clouds, out, trajectory, crs, units, warn, report: as there.
        options: photos, cameras, images, embedded_images, orthophoto, footprints, conventions, classes, link, overwrite
            and name, as there.

    Returns:
        Path of the `tile.toml`; `trajectory_check.json` beside it has the result of the check.

    Raises:
        ScanError: as there.
    """
    given: dict[str, Any] = {"trajectory": trajectory, "crs": crs, "units": units, "warn": warn} | options
    if trajectory is None or pose_source == "given" or options.get("axes") is not None:
        return import_las(clouds, out, report=report, **given)
    check_target(out, bool(options.get("overwrite", False)))
    task = check(clouds, trajectory, pose_source, crs=crs, units=units)
    with tempfile.TemporaryDirectory() as folder:
        found = run_check(task, Path(folder), warn, report)
        return import_las(
            clouds, out, trajectory_check=found, **given,
            report=lambda part, text="": report(CHECKED + (1 - CHECKED) * part, text),
        )  # fmt: skip
