"""Step `dense_stereo`: point cloud of posed photos by COLMAP's patch match stereo, which needs CUDA."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core import sandbox
from scan2sim.pipeline.core.errors import DataError, StepError
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Frame
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io.clouds import las

HOURS = 24.0
"""Time limit."""


class DenseStereoParams(Params):
    """Settings of dense stereo."""

    dense_size: Annotated[int, Field(ge=100, le=20_000)] = Field(
        2000, description="Longer side in pixels to which photos are reduced for dense stereo (without --cloud)."
    )


def dense_stereo(inputs: Inputs, params: DenseStereoParams, out: Path, report: Report) -> Done:
    """Point cloud of the photos in `images`, posed by the COLMAP model in `path` (local metres of `frame`).

    File: `cloud`, LAZ in the CRS of `frame`.

    Raises:
        StepError: there is no usable CUDA device. DataError: the photos have no common surfaces or no scale, or are
            panoramas.
    """
    _check_usable(inputs["images"], inputs["path"] / "reconstruction.json")
    report(0.0, "dense stereo")
    with tempfile.TemporaryDirectory(dir=out) as folder:
        fused = Path(folder) / "fused.ply"
        arguments = (inputs["path"] / "colmap", inputs["images"], Path(folder) / "workspace", fused, params.dense_size)
        try:
            count = sandbox.call("scan2sim.slam.reconstruction.colmap:dense_stereo", *arguments, timeout=HOURS * 3600)
        except StepError as error:
            raise StepError(
                "COLMAP (dense stereo)", error.cause, "Give --cloud, or check the CUDA device (nvidia-smi)"
            ) from None
        if not count:
            raise DataError(inputs["images"], "show no surface from two sides", "Take more photos, or give --cloud")
        written = json.loads(inputs["frame"].read_text(encoding="utf-8"))
        frame = Frame(written["crs"], tuple(written["origin"]), written["unit"])
        local = (
            replace(part, xyz=part.frame.to_crs(part.xyz).astype("float32"), frame=frame)
            for part in cloud_io.chunks(fused, Frame())
        )
        las.write_parts(out / "cloud.laz", local, software="")
    return Done({"cloud": out / "cloud.laz"}, {"summary": f"dense stereo: {count:,} points", "dense_points": count})


def _check_usable(images: Path, summary: Path) -> None:
    """Raise a DataError if the photos of a reconstruction, described in `summary`, have no scale, or are panoramas."""
    made = json.loads(summary.read_text(encoding="utf-8"))
    if not made["georeferenced"]:
        raise DataError(
            images, "GPS doesn't give the scale of its photos, so that a tile would have a wrong size",
            "Give --gps TRACK or --cloud; the warnings above say what is wrong with the GPS in the photos",
        )  # fmt: skip
    if any(lens["model"] == "equirectangular" for lens in made["lenses"].values()):
        raise DataError(images, "shows panoramas, from which COLMAP's dense stereo makes no cloud", "Give --cloud")


DENSE_STEREO = Step("dense_stereo", 1, dense_stereo, DenseStereoParams, memory=(4, 2))
