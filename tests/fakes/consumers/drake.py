"""Drake's SDF parser in strict mode: unknown elements and missing files are errors.

Shapes of actors, which only Gazebo's worlds name, have no `model.sdf` and aren't parsed.

Elements used only by Gazebo (`GAZEBO_ELEMENTS`) are removed from a copy first; they are valid SDF that Drake ignores.
"""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from tests.fakes.world_checks import Fault
from tests.fakes.world_checks.reference import WorldReference

FORMAT = "gazebo"
GAZEBO_ELEMENTS = ("plugin", "sensor", "cast_shadows", "laser_retro", "visibility_flags")


def missing() -> str:
    """Reason why it can't run here, or an empty string."""
    return "" if importlib.util.find_spec("pydrake") else "pydrake isn't installed (pip install drake)"


def check(export: Path, reference: WorldReference) -> dict[str, Any]:
    """Parse every model, including its meshes, with warnings as errors."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.systems.framework import DiagramBuilder

    with tempfile.TemporaryDirectory() as work:
        models = Path(work) / "models"
        shutil.copytree(export / "models", models, copy_function=lambda a, b: Path(b).symlink_to(Path(a).resolve()))
        plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.001)
        parser = Parser(plant)
        parser.SetStrictParsing()
        described = sorted(models.glob("*/model.sdf"))
        for model in described:
            parser.package_map().Add(model.parent.name, model.parent)
            _strip(model)
        try:
            for model in described:
                parser.AddModels(model)
        except RuntimeError as why:
            raise Fault(str(why)) from None
        return {"models": plant.num_model_instances() - 2, "bodies": plant.num_bodies() - 1}


def _strip(path: Path) -> None:
    """Replace a linked SDF by a copy without elements used only by Gazebo."""
    tree = ET.parse(path)
    for parent in tree.iter():
        for child in [one for one in parent if one.tag in GAZEBO_ELEMENTS]:
            parent.remove(child)
    path.unlink()
    tree.write(path)
