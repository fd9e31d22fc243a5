"""Segment: a class for every point, the cloud's own where it has them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from pydantic import Field

from pipeline.step import Done, Inputs, Params, Report, Step


class SegmentParams(Params):
    """Where classes come from.

    Attributes:
        overwrite: classify by shape even if the cloud has classes.
        min_classified: share of points with a class (other than never classified and unclassified)
            from which on the cloud's own are kept.
        voxel: metres, detail of the classification by shape (`segmentation.geometric`).
    """

    overwrite: bool = False
    min_classified: float = Field(0.2, ge=0, le=1)
    voxel: float = Field(0.2, gt=0)


def segment(inputs: Inputs, params: SegmentParams, out: Path, report: Report) -> Done:
    """Keep the classes of `cloud`, or give it classes by shape where it has none."""
    from dataclasses import replace

    import numpy as np

    from pipeline.classes import CLASSES, UNKNOWN, group_of
    from pipeline.types import PointCloud

    report(0.0, "reading")
    cloud = PointCloud.load(inputs["cloud"])
    file = out / "cloud.npz"
    own = 0.0 if cloud.label is None else float(np.mean(~np.isin(cloud.label, UNKNOWN)))
    if cloud.label is not None and own >= params.min_classified and not params.overwrite:
        try:
            os.link(inputs["cloud"], file)
        except OSError:  # another disk, or a file system without links
            shutil.copyfile(inputs["cloud"], file)
        label, source = cloud.label, "cloud"
    else:
        from segmentation.geometric import classify

        label = classify(cloud, lambda f, m="": report(0.05 + 0.85 * f, m), voxel=params.voxel)
        report(0.9, "writing")
        replace(cloud, label=label).save(file)
        source = "geometry"
    count = np.bincount(label, minlength=256)
    names = {c.code: c.name for c in CLASSES}
    facts = {
        "source": source,
        "own_classes": round(own, 4),
        "points": {names.get(code, str(code)): int(count[code]) for code in np.flatnonzero(count).tolist()},
    }
    warnings = []
    group = group_of()
    if source == "geometry":
        why = "they were told anew" if own else "The cloud has none of its own: they were told"
        warnings.append(f"classes: {why} from shape, which confuses some things")
    elif not np.isin(group[np.flatnonzero(count)], (1, 2)).any():
        warnings.append(
            "the cloud classifies neither buildings nor vegetation; --set segment.overwrite=true finds them"
        )
    return Done({"cloud": file}, facts, warnings)


SEGMENT = Step("segment", 1, segment, SegmentParams)
