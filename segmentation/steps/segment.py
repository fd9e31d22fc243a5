"""Segment: a class for every point: the cloud's own, else from the photos and the points' shape (D3.2, section 4.2)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.classes import group_of, name_of
from scan2sim.pipeline.core.parameters import Share, Voxel
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import U8, PointCloud, Trajectory
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.file_checks import pass_on
from scan2sim.pipeline.steps.voxel import sample, voxel_groups
from scan2sim.segmentation.steps.label import classified

PHOTO, SHAPE, OWN = 1, 2, 3
"""What a point's class comes from: photos that see it (with its shape and neighbours), those alone, the cloud."""


class SegmentParams(Params):
    """Where classes come from.

    Attributes:
        overwrite: classify anew even if the cloud has some.
        min_classified: share of points with a class (other than never classified and unclassified)
            from which on the cloud's own are kept.
        size: metres of the voxels that photos are asked about.
        voxel: metres, detail of the classification by shape (`segmentation.geometric`).
        photos: use what the photos say; False classifies by shape alone.
    """

    overwrite: bool = False
    min_classified: Share = 0.2
    size: Voxel = 0.1
    voxel: Voxel = 0.2
    photos: bool = True


def segment(inputs: Inputs, params: SegmentParams, out: Path, report: Report) -> Done:
    """Keep the classes of `cloud`, or classify its points by `labels` (of the step `label`, for `views`) and shape.

    Inputs: `cloud`; `views` and `labels`; `path`, the scanner's, where it is known; `moving`, of `carve`: it hides what
    is behind it in photos.
    Files: `cloud`; `confidence`, .npz with `confidence` (N,) uint8, 255 sure, and `source` (N,) uint8
    (`PHOTO`, `SHAPE` or `OWN`).
    """
    report(0.0, "reading")
    cloud = PointCloud.load(inputs["cloud"])
    file, beside = out / "cloud.npz", out / "confidence.npz"
    own = classified(cloud.classification)
    evidence: dict[str, Any] = {}
    if cloud.classification is not None and own >= params.min_classified and not params.overwrite:
        pass_on(inputs["cloud"], file)
        classification, source = cloud.classification, "cloud"
        kinds, sure = np.full(len(cloud), OWN, np.uint8), np.full(len(cloud), 255, np.uint8)
    else:
        classification, sure, kinds, evidence = classify_points(cloud, inputs, params, report)
        report(0.95, "writing")
        replace(cloud, classification=classification).save(file)
        source = "photos and shape" if evidence else "shape"
    np.savez(beside, confidence=sure, source=kinds)
    count = np.bincount(classification, minlength=256)
    facts = {
        "source": source,
        "own_classes": round(own, 4),
        "points": {name_of(code): int(count[code]) for code in np.flatnonzero(count).tolist()},
    } | evidence
    warnings = []
    if source == "shape":
        why = "they were told anew" if own else "The cloud has none of its own: they were told"
        warnings.append(f"classes: {why} from shape alone, which confuses some things")
    elif source == "cloud" and not np.isin(group_of()[np.flatnonzero(count)], (1, 2)).any():
        warnings.append(
            "the cloud classifies neither buildings nor vegetation; --set segment.overwrite=true finds them"
        )
    elif evidence and evidence["sky_share"] > SKY_LIMIT:
        warnings.append(
            f"{evidence['sky_share']:.0%} of the sightings take points for sky: are poses and clocks of photos right?"
        )
    return Done({"cloud": file, "confidence": beside}, facts, warnings)


SKY_LIMIT = 0.15
"""Share of sightings that say sky above which a run warns."""


def classify_points(
    cloud: PointCloud, inputs: Inputs, params: SegmentParams, report: Report
) -> tuple[U8, U8, U8, dict[str, Any]]:
    """LAS codes, confidence (255: sure) and source of every point (N,), and facts where photos were used."""
    from scan2sim.pipeline.geometry.normals import oriented_normals
    from scan2sim.segmentation.geometric import classify

    n = len(cloud)
    views = views_io.load(inputs["views"]) if "views" in inputs else ()
    by_photos = params.photos and "labels" in inputs and any(inputs["labels"].glob("*.npy"))
    if not by_photos:
        classification = classify(cloud, lambda f, m="": report(0.05 + 0.85 * f, m), voxel=params.voxel)
        return classification, np.full(n, 128, np.uint8), np.full(n, SHAPE, np.uint8), {}
    report(0.05, "thinning")
    order, starts = voxel_groups(cloud.xyz, params.size)
    voxel = np.empty(n, np.int64)
    voxel[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, n)))
    thin = sample(cloud, params.size)
    report(0.15, "normals")
    thin = oriented_normals(thin, 12, Trajectory.load(inputs["path"]) if "path" in inputs else None)
    report(0.25, "shape")
    shape = classify(thin, lambda f, m="": report(0.25 + 0.25 * f, m), voxel=params.voxel)
    moving = PointCloud.load(inputs["moving"]) if "moving" in inputs else None
    code, sure, seen, evidence = _from_photos(thin, shape, views, inputs["labels"], moving, params, report)
    return code[voxel], sure[voxel], np.where(seen, PHOTO, SHAPE).astype(np.uint8)[voxel], evidence


def _from_photos(
    thin: PointCloud,
    shape: U8,
    views: Any,
    probabilities: Path,
    driven: PointCloud | None,
    params: SegmentParams,
    report: Report,
) -> tuple[U8, U8, U8, dict[str, Any]]:
    """LAS codes, confidence and whether a photo sees it, by voxel; and facts."""
    from scan2sim.segmentation.geometric import split_ground
    from scan2sim.segmentation.graph_smoothing import decide
    from scan2sim.segmentation.labels import code_of_index
    from scan2sim.segmentation.transient_points import moving
    from scan2sim.segmentation.votes import vote

    votes = vote(
        thin, views, probabilities, radius=0.8 * params.size, moving=driven,
        report=lambda f, m="": report(0.5 + 0.3 * f, m),
    )  # fmt: skip
    report(0.8, "smoothing")
    tells = json.loads((probabilities / "network.json").read_text(encoding="utf-8"))["tells"]
    height, ground = split_ground(thin.xyz)
    moved = moving(thin, height, ground)
    best, sure = decide(votes, shape, height, moved, thin, knows_low_vegetation="low_vegetation" in tells)
    seen = votes.weight > 0
    evidence = {"seen_share": round(float(seen.mean()), 4), "sky_share": round(votes.sky, 4)}
    evidence["moving_share"] = round(float(moved.mean()), 4)
    return code_of_index()[best], np.round(255 * sure).astype(np.uint8), seen.astype(np.uint8), evidence


SEGMENT = Step("segment", 8, segment, SegmentParams, memory=(0.5, 6))
