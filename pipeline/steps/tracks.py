"""Tracks step (`tracks`): follows vehicles and people through the sweeps (docs/scenarios.md)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import Frame, PointCloud, Trajectory
from scan2sim.pipeline.tracking.tracks import Track, write_tracks

if TYPE_CHECKING:
    from scan2sim.pipeline.tracking.assemble import Candidate

FILES = {
    "tracks": "tracks.json",
    "tracks_geojson": "tracks.geojson",
    "tracks_kitti": "tracks_kitti.txt",
    "tracks_nuscenes": "tracks_nuscenes.json",
}


class TracksParams(Params):
    """Tracking of vehicles and people.

    Attributes:
        when: "auto": if the scanner's path and the points' times are known; "never".
    """

    when: Literal["auto", "never"] = "auto"


def tracks(inputs: Inputs, params: TracksParams, out: Path, report: Report) -> Done:
    """Follow road users through the sweeps of the classified `cloud`, with the `moving` points that were removed.

    Inputs: `cloud`, `moving`, `path` of the scanner, `instances` (GeoJSON of step `instances`), `views` (optional).
    Files: `tracks`, JSON for `pipeline.tracking.tracks.read_tracks`; `tracks_geojson`; `tracks_kitti`, labels in the
    photos of the first camera, empty without photos; `tracks_nuscenes`. Metrics: numbers of `moving` and `parked`
    tracks and of `sweeps`; `tracks`, a list of the moving ones; `none`, the reason why there are none.
    """
    from scan2sim.pipeline.io import views as views_io
    from scan2sim.pipeline.io.geodata import track_geojson
    from scan2sim.pipeline.tracking.assemble import assemble
    from scan2sim.pipeline.tracking.scoring_formats import write_kitti, write_nuscenes

    report(0.0, "reading")
    cloud, path = PointCloud.load(inputs["cloud"]), Trajectory.load(inputs["path"])
    found: list[Track] = []
    metrics: dict[str, object] = {}
    known = np.isfinite(path.times)
    if cloud.time is None or not known.sum() > 1 or cloud.classification is None:
        metrics["none"] = "the points have no times" if cloud.time is None else "the path has no times"
    else:
        path = Trajectory(path.times[known], path.positions[known])
        report(0.3, "following objects")
        moving = PointCloud.load(inputs["moving"])
        found, numbers = assemble(cloud, moving, path, _candidates(inputs["instances"], cloud.frame))
        metrics |= {**numbers, "tracks": [_facts(track) for track in found if track.moving]}
    report(0.9, "writing")
    write_tracks(out / FILES["tracks"], found, cloud.frame)
    track_geojson.write(out / FILES["tracks_geojson"], found, cloud.frame)
    views = views_io.load(inputs["views"]) if "views" in inputs else ()
    first = [view for view in views if view.camera == views[0].camera and view.camera.model in ("pinhole", "opencv")]
    write_kitti(out / FILES["tracks_kitti"], found, first)
    write_nuscenes(out / FILES["tracks_nuscenes"], found, cloud.frame)
    return Done({name: out / file for name, file in FILES.items()}, metrics)


def _candidates(path: Path, frame: Frame) -> list[Candidate]:
    """Instances in local coordinates."""
    from scan2sim.pipeline.tracking.assemble import Candidate

    out = []
    for feature in json.loads(path.read_text(encoding="utf-8"))["features"]:
        ring = np.array(feature["geometry"]["coordinates"][0][:4], np.float64)
        corners = frame.to_local(np.column_stack([ring, np.zeros(4)]))[:, :2]
        facts = feature["properties"]
        along = corners[0] - corners[1]
        yaw = float(np.arctan2(along[1], along[0]))
        out.append(
            Candidate(
                corners.mean(axis=0), yaw, facts["length_m"], facts["width_m"], facts["kind"], facts["moved"]
            )
        )  # fmt: skip
    return out


def _facts(track: Track) -> dict[str, object]:
    speeds = track.speeds()
    return {
        "id": track.id,
        "category": track.category,
        "size_m": [round(value, 2) for value in track.size],
        "seconds": round(float(track.times[-1] - track.times[0]), 2),
        "speed_mps": round(float(np.median(speeds)), 2),
        "sigma_m": round(float(np.median(track.sigma[:, 0])), 3),
    }


TRACKS = Step("tracks", 1, tracks, TracksParams)
