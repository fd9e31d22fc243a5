"""Import map: makes a tile of a robot's map."""

from __future__ import annotations

from pathlib import Path

from scan2sim.pipeline.core.step import Done, Inputs, Report, Step
from scan2sim.pipeline.importers import robot_map


class ImportMapParams(robot_map.MapParams):
    """How the map is read.

    Attributes:
        name: name of the tile.
    """

    name: str = "map"


def import_map(inputs: Inputs, params: ImportMapParams, out: Path, report: Report) -> Done:
    """Make a tile of the clouds `cloud.0000` ..., or of the textured `mesh`. File: `tile`, a folder.

    Inputs: `trajectory`, path of the sensor (optional); `beside.*`, files that the mesh refers to, which it finds
    itself.

    Raises:
        ScanError: as `pipeline.importers.robot_map.import_map` and `mesh_model.import_mesh`.
    """
    warnings: list[str] = []
    clouds = [inputs[name] for name in sorted(inputs) if name.startswith("cloud.")]
    options = robot_map.MapParams.model_validate(params.model_dump(exclude={"name"}))
    if "mesh" in inputs:
        from scan2sim.pipeline.importers.mesh_model import import_mesh

        tile = import_mesh(
            inputs["mesh"], out / "tile", options, trajectory=inputs.get("trajectory"), name=params.name,
            warn=warnings.append, report=report,
        )  # fmt: skip
        return Done({"tile": tile.parent}, warnings=warnings)
    tile = robot_map.import_map(
        clouds, out / "tile", options, trajectory=inputs.get("trajectory"), name=params.name, warn=warnings.append,
        report=report,
    )  # fmt: skip
    return Done({"tile": tile.parent}, warnings=warnings)


IMPORT_MAP = Step("import_map", robot_map.VERSION, import_map, ImportMapParams)
