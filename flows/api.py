"""The public Python API: `scan2sim.run`, `survey`, `read_world`, `camera` and the importers, for notebooks and scripts.

The commands of the same names call the same functions. Everything else may change between minor versions.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scan2sim.flows.importers import (
    import_bag,
    import_clouds,
    import_images,
    import_kitti_odometry,
    import_kitti_raw,
    import_map,
    import_nuscenes,
    import_pandaset,
    import_photogrammetry,
    import_sweeps,
)
from scan2sim.pipeline.core.errors import (
    BusyError,
    DataError,
    IncompleteError,
    InputError,
    LowConfidenceError,
    ScanError,
    SettingError,
    SpaceError,
    StepError,
    UnavailableError,
)
from scan2sim.pipeline.core.types import Camera

if TYPE_CHECKING:
    from scan2sim.flows.pipelines.settings import Settings
    from scan2sim.pipeline.io.worlds.scene import Scene
    from scan2sim.texturing.world_camera import WorldCamera

__all__ = [
    "BusyError",
    "Camera",
    "DataError",
    "IncompleteError",
    "InputError",
    "LowConfidenceError",
    "ScanError",
    "SettingError",
    "SpaceError",
    "StepError",
    "UnavailableError",
    "World",
    "camera",
    "export",
    "import_bag",
    "import_clouds",
    "import_images",
    "import_kitti_odometry",
    "import_kitti_raw",
    "import_map",
    "import_nuscenes",
    "import_pandaset",
    "import_photogrammetry",
    "import_sweeps",
    "read_world",
    "run",
    "survey",
]


@dataclass(frozen=True)
class World:
    """A finished world on disk, of one tile or of a survey.

    Attributes:
        folder: absolute path of the output folder of `run` or `survey`, or of a copy of the folder `world` in it.
    """

    folder: Path

    def __post_init__(self) -> None:
        """Keep the folder when the process changes its working folder, as notebooks do."""
        object.__setattr__(self, "folder", Path(self.folder).absolute())

    @cached_property
    def scene(self) -> Scene:
        """Name, coordinate frame (`scene.frame.crs`, `.origin`) and tiles, with their textured surfaces.

        Example:
            `for tile in world.scene.tiles: print(tile.name, tile.groups["building"]["triangles"])`
        """
        from scan2sim.pipeline.io.worlds.scene import read_scene

        return read_scene(self.folder)

    @property
    def sdf(self) -> Path:
        """The Gazebo world (SDF 1.9)."""
        return self.scene.tiles[0].folder.parents[1] / f"{self.scene.name}.sdf"

    @property
    def report(self) -> dict[str, Any]:
        """Metrics and warnings: the content of `report.json`, of a survey `survey.json`.

        Raises:
            InputError: the run wrote no report.
        """
        for name in ("report.json", "survey.json"):
            if (self.folder / name).is_file():
                return dict(json.loads((self.folder / name).read_text(encoding="utf-8")))
        raise InputError(self.folder, "has no report.json and no survey.json", "Run the tile or the survey again")


def run(
    tile: str | Path,
    out: str | Path,
    settings: Mapping[str, Any] | None = None,
    *,
    hold_out: int = 0,
    jobs: int = 0,
    progress: bool = True,
) -> World:
    """Make the world of a tile; steps that an earlier run into the same folder has finished are not computed again.

    Args:
        tile: a `tile.toml`, or its folder; or a robot's map (a cloud, or a folder of clouds).
        out: folder for the world, the report and cached results; created if it does not exist.
        settings: `{"decimate": {"target": 50000}}` or `{"decimate.building.target": 50000}`; all of them are in
            docs/reference/settings.md.
        hold_out: keep every Nth photo out of texturing, and every Nth sweep of a lidar out of the cloud, to measure
            quality against them; 0: none.
        jobs: steps that run at the same time; 0: by the number of cores.
        progress: show progress and results on the terminal.

    Returns:
        The finished world.

    Raises:
        IncompleteError: the world is finished, `read_world(out)` opens it; side products (roads, pictures, ...) failed.
        ScanError: bad input or a failed step, with cause and remedy; results of earlier runs stay.
    """
    from scan2sim.flows.commands import display, option_ranges
    from scan2sim.flows.commands.robot_map import is_map, tile_of_map
    from scan2sim.flows.commands.run import run_tile
    from scan2sim.pipeline.importers.robot_map import MapParams

    option_ranges.check_arguments("run", hold_out=hold_out, jobs=jobs)  # with -1 jobs, no step would ever start
    with display.shown(progress):
        path = Path(tile)
        path = tile_of_map(path, Path(out), MapParams()) if is_map(path) else path
        run_tile(path, Path(out), _settings(settings, hold_out), jobs=jobs)
    return read_world(out)


def survey(
    source: str | Path,
    out: str | Path,
    settings: Mapping[str, Any] | None = None,
    *,
    length: float | None = None,
    buffer: float | None = None,
    hold_out: int = 0,
    jobs: int = 0,
    progress: bool = True,
) -> World:
    """Make the worlds of all tiles of a survey, whose borders match, and one world of all of them.

    Args:
        source: a `survey.toml`, a `tile.toml` of a long road (it is cut into tiles), a `drive.toml`, or its folder.
        out: folder for worlds, reports and cached results, or its s3:// URL.
        settings: as for `run`.
        length: metres of road per tile, where the road is cut here; default: 100.
        buffer: metres by which the clouds of tiles overlap, where the road is cut here; default: 5.
        hold_out: as for `run`.
        jobs: as for `run`.
        progress: as for `run`.

    Returns:
        The finished world; of a URL, in the copy on this machine.

    Raises:
        StepError: tiles failed; all others are finished, `read_world(out)` opens their world.
        IncompleteError: the world is finished, `read_world(out)` opens it; side products failed.
        ScanError: bad input, with cause and remedy; results of earlier runs stay.
    """
    from scan2sim.flows.commands import display, option_ranges
    from scan2sim.flows.commands.survey import run_source

    option_ranges.check_arguments("survey", length=length, buffer=buffer, hold_out=hold_out, jobs=jobs)
    with display.shown(progress):
        path = run_source(str(source), str(out), _settings(settings, hold_out), length=length, buffer=buffer, jobs=jobs)
    return read_world(path.parent)


def export(
    world: World | str | Path,
    formats: str | Sequence[str],
    out: str | Path,
    *,
    budget: str | None = None,
    levels: int | None = None,
    robot: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    **options: Any,
) -> Path:
    """Convert a finished world to other formats, for other simulators: `scan2sim export`, docs/simulators.md.

    Args:
        world: the world, or the output folder of `run` or `survey`.
        formats: "gazebo", "glb", ...: one, several separated by commas, or a list.
        out: folder for the converted world.
        budget: limits of each tile, such as "triangles=200k,texture=64MP"; default: none.
        levels: levels of detail of each tile, 1 to 6; default: 3 for tiles3d, else 1.
        robot: add a small robot with camera and lidar, on the road.
        overwrite: replace an existing export.
        progress: show progress and warnings on the terminal.
        options: further options of the command, with underscores: `pages="jpeg"`, `double_sided=False`.

    Returns:
        The folder.

    Raises:
        SettingError: unknown format or option, or `out` is not empty. InputError: there is no finished world.
        UnavailableError: a format's package is missing.
    """
    from scan2sim.flows.commands import display, option_ranges
    from scan2sim.flows.commands.export import export_world
    from scan2sim.pipeline.io.world_formats import SceneParams

    option_ranges.check_arguments("export", levels=levels)
    params = SceneParams.of("export", options, remedy="`scan2sim export --help` describes the options")
    folder = world.folder if isinstance(world, World) else Path(world)
    with display.shown(progress):
        return export_world(
            folder, formats, Path(out).absolute(), params, budget=budget, levels=levels, robot=robot,
            overwrite=overwrite,
        )  # fmt: skip


def camera(world: World | str | Path, *, farthest: float = 300.0) -> WorldCamera:
    """A camera in a finished world, without a simulator: colour, depth, classes and instances from any pose.

    Colours are those of the world's splats; tiles without splats show their textured surfaces.

    Args:
        world: the world, or the output folder of `run` or `survey`.
        farthest: distance from the camera in metres beyond which tiles aren't drawn; the nearest one always is.

    Example:
        `image = scan2sim.camera("my_world").render(T_world_cam, lens)`, with a pose (4, 4) in world metres (camera axes
        x right, y down, z ahead) and a `scan2sim.Camera`, the lens; `image.rgb`, `image.depth(lens)`, `image.code`,
        `image.instance` (ids of `instances` of what this function returns).

    Raises:
        InputError: the folder contains no world.
    """
    from scan2sim.texturing.world_camera import WorldCamera

    scene = world.scene if isinstance(world, World) else World(Path(world)).scene
    return WorldCamera(scene, farthest=farthest)


def read_world(folder: str | Path) -> World:
    """Open a finished world: the output folder of `run` or `survey`, or of the commands of the same names.

    Raises:
        InputError: there is no finished world in the folder.
    """
    world = World(Path(folder))
    _ = world.scene
    return world


def _settings(values: Mapping[str, Any] | None, hold_out: int) -> Settings:
    from scan2sim.flows.pipelines.settings import Settings

    held_out = {f"{step}.hold_out": hold_out for step in ("views", "sweeps")} if hold_out else {}
    return Settings.of({**(values or {}), **held_out})
