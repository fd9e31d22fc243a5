"""Map colours: colours the points of a robot's map by their intensity if they have no colours of their own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import PointCloud, Trajectory
from scan2sim.pipeline.io.file_checks import link_or_copy


class MapColoursParams(Params):
    """Settings of the points' colours.

    Attributes:
        intensity: colour points by their intensity, as shades of their class's colour, if the map has no colours.
    """

    intensity: bool = True


def map_colours(inputs: Inputs, params: MapColoursParams, out: Path, report: Report) -> Done:
    """Colour the classified points of `cloud`; `path` (optional) is that of the sensor.

    Points with colours are kept. Without colours and intensities there are none: surfaces are textured by class.
    Files: `cloud`; `source`, JSON with the `source` of its colours: "colours" (its own), "intensity" or "classes".
    """
    from scan2sim.pipeline.lidar.intensity import has_intensity
    from scan2sim.pipeline.lidar.intensity_colours import intensity_colours

    cloud, file = PointCloud.load(inputs["cloud"]), out / "cloud.npz"
    if cloud.coloured.any() or not (params.intensity and has_intensity(cloud)):
        link_or_copy(inputs["cloud"], file)
        source = "colours" if cloud.coloured.any() else "classes"
    else:
        report(0.2, "intensity")
        path = Trajectory.load(inputs["path"]) if "path" in inputs else None
        replace(cloud, rgb=intensity_colours(cloud, path)).save(file)
        source = "intensity"
    about = {"source": source}
    (out / "source.json").write_text(json.dumps(about), encoding="utf-8")
    return Done({"cloud": file, "source": out / "source.json"}, about)


MAP_COLOURS = Step("map_colours", 5, map_colours, MapColoursParams)
