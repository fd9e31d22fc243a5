"""Scenes of `bench.texture`: a scan meshed as a single surface, its photos, and the held-out ones.

A scene is a folder. `street_hard` takes its mesh and surface points from `street_clean`, so that both have exactly the
same surface; its photos and its occluding points (including the moving car's trail) are its own.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.paths import ROOT
from scan2sim.flows.pipelines.tile import scanner_path
from scan2sim.pipeline.core.classes import GROUPS
from scan2sim.pipeline.core.step import Step, silent
from scan2sim.pipeline.core.types import Frame, Mesh, PointCloud, Tile, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.ingest import INGEST
from scan2sim.pipeline.steps.islands import ISLANDS
from scan2sim.pipeline.steps.path import PATH
from scan2sim.pipeline.steps.poisson import POISSON
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.steps.views import VIEWS
from scan2sim.pipeline.steps.voxel import VOXEL
from tests.fakes.steps import step_params

KITTI = ROOT.parent / "shared" / "data" / "kitti_raw0009_f00-24"
SCENES = ("kitti", "street_clean", "street_hard")
WARM_UP = "sample"
"""The demo tile, small enough to warm up: compile all kernels before times are measured."""
FACES = 200_000
LIMITS = {"max_edge": 0.5, "max_distance": 0.5, "max_spacing": 1.6}  # those of terrain: small holes are closed
HOLD_OUT = 8  # every 8th photo of each camera: frames 4, 12 and 20 of KITTI's 25
STREET: dict[str, Any] = {"length": 40.0, "points": 1.6e6, "photos": 32, "photo_width": 1600, "seed": 0}


@dataclass(frozen=True)
class Scene:
    """Files of a scene; `atlas` and `depth` are results of the steps `unwrap` and `visibility`."""

    folder: Path

    @property
    def tile(self) -> Path:
        """Folder of the scan."""
        return self.folder / "tile"

    @property
    def mesh(self) -> Path:
        """File of the single `Mesh`."""
        return self.folder / "mesh.npz"

    @property
    def views(self) -> Path:
        """Folder with `views.json`, including held-out views."""
        return self.folder / "views" / "views"

    @property
    def clouds(self) -> dict[str, Path]:
        """Thinned points of the surface, and points that only occlude (`cloud.rest`) if there are any."""
        files = {f"cloud.{part}": self.folder / f"{part}.npz" for part in ("surface", "rest")}
        return {name: path for name, path in files.items() if path.is_file()}

    @property
    def atlas(self) -> Path:
        """Folder with `mesh.npz` (with uv and page) and `pages.json`."""
        return self.folder / "atlas"

    @property
    def depth(self) -> Path:
        """Folder with a depth map per view."""
        return self.folder / "visibility" / "depth"

    def photos(self, *, held_out: bool) -> dict[int, View]:
        """Views by index: either the held-out or the used ones."""
        views, held = views_io.load(self.views), views_io.load_held_out(self.views)
        return {i: view for i, view in enumerate(views) if held[i] == held_out}


def fresh(folder: Path) -> Path:
    """An empty folder; existing content is deleted."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def run(step: Step, inputs: Mapping[str, Path], folder: Path, **given: Any) -> dict[str, Path]:
    """Run a step with default settings except the given ones; returns its files."""
    return step.run(inputs, step_params(step.params, **given), fresh(folder), silent).files


def available(name: str) -> bool:
    """Whether the scene's data are available."""
    return name != "kitti" or KITTI.is_dir()


def make(name: str, scene: Scene) -> None:
    """Create a scene's scan (unless it exists), mesh, points and views."""
    scene.folder.mkdir(parents=True, exist_ok=True)
    if not (scene.tile / "tile.toml").is_file():
        _scan(name, scene.tile)
    if name == "street_hard":
        _surface_of(scene, Scene(scene.folder.with_name("street_clean")))
    else:
        _surface(scene, 10 if name == "kitti" else None, 20_000 if name == WARM_UP else FACES)


def _scan(name: str, tile: Path) -> None:
    if name == WARM_UP:
        tile.symlink_to(ROOT / "data_samples" / "tile")
    elif name == "kitti":
        from scan2sim.flows.pipelines.kitti import import_kitti_raw

        poses = KITTI / "T_velo0_velo_icp_frames_0-24.txt"
        import_kitti_raw(KITTI, tile, poses=poses, pose_source="given", link=True)
    else:
        from scan2sim.data_samples.layout import Style
        from scan2sim.data_samples.photos import Effects
        from scan2sim.data_samples.street import generate

        hard = name == "street_hard"
        generate(tile, **STREET, style=Style(moving_car=hard), effects=Effects(exposure_ev=1.0 if hard else 0.0))


def _surface(scene: Scene, depth: int | None, faces: int) -> None:
    """Mesh all surface points as one: 10 cm voxels, Poisson, trim, islands, decimate."""
    tile, steps = read_tile(scene.tile), scene.folder / "steps"
    thin = _thinned(tile, steps)
    for part, path in thin.items():
        shutil.copyfile(path, scene.folder / f"{part}.npz")
    surface = {"cloud": thin["surface"]}
    files = run(POISSON, surface, steps / "poisson", depth=depth)
    files = run(TRIM, files | surface, steps / "trim", **LIMITS)
    files = run(ISLANDS, files, steps / "islands")
    files = run(DECIMATE, files, steps / "decimate", target=faces)
    shutil.copyfile(files["mesh"], scene.mesh)
    shutil.rmtree(steps)
    _views(scene, tile)


def _surface_of(scene: Scene, other: Scene) -> None:
    """Use another scene's surface in this one's frame; occluding points and views are its own."""
    tile, steps = read_tile(scene.tile), scene.folder / "steps"
    shutil.copyfile(_thinned(tile, steps)["rest"], scene.folder / "rest.npz")
    shutil.rmtree(steps)
    Mesh.load(other.mesh).moved_to(tile.frame).save(scene.mesh)
    _moved(PointCloud.load(other.folder / "surface.npz"), tile.frame).save(scene.folder / "surface.npz")
    _views(scene, tile)


def _moved(cloud: PointCloud, frame: Frame) -> PointCloud:
    local = frame.to_local(cloud.frame.to_crs(cloud.xyz))
    return replace(cloud, frame=frame, xyz=local.astype("float32"))


def _thinned(tile: Tile, steps: Path) -> dict[str, Path]:
    """`surface`, and `rest` if the points have classes: one point per voxel, normals towards the scanner."""
    frame = {"crs": tile.frame.crs, "origin": tile.frame.origin, "unit": tile.frame.unit}
    whole = run(INGEST, {f"cloud.{i:04d}": path for i, path in enumerate(tile.clouds)}, steps / "ingest", **frame)
    scanner = run(PATH, {}, steps / "path", **scanner_path(tile))
    classification = PointCloud.load(whole["cloud"]).classification
    parts = {"surface": whole["cloud"]}
    if classification is not None and classification.max() > 1:
        split = run(SPLIT, whole, steps / "split")
        joined = PointCloud.join([PointCloud.load(split[group]) for group in GROUPS])
        joined.save(steps / "surface.npz")
        parts = {"surface": steps / "surface.npz", "rest": split["rest"]}
    return {
        part: run(VOXEL, {"cloud": path} | scanner, steps / f"voxel_{part}")["cloud"] for part, path in parts.items()
    }


def _views(scene: Scene, tile: Tile) -> None:
    photos = {f"photo.{i}": view.photo for i, view in enumerate(tile.views)}
    poses = tuple(views_io.to_json(view, with_paths=False) for view in tile.views)
    run(VIEWS, photos | scene.clouds, scene.folder / "views", hold_out=HOLD_OUT, poses=poses)
