"""What `bench.texture` compares textures on: scans made into one mesh, its photos, and which of them are held out.

A scene is a folder. `street_hard` takes mesh and surface points from `street_clean`, so that both are the same
surface to the texel; its photos, and the points that only hide (its moving car's trail among them), are its own.
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

KITTI = ROOT.parent / "shared" / "data" / "kitti_raw0009_f00-24"
SCENES = ("kitti", "street_clean", "street_hard")
WARM = "sample"
"""The committed tile: small enough to have every kernel compiled before times are taken."""
FACES = 200_000
LIMITS = {"max_edge": 0.5, "max_distance": 0.5, "max_spacing": 1.6}  # the terrain's: small holes get closed
HOLD_OUT = 8  # every 8th photo of each camera: of the 25 of KITTI those of frames 4, 12 and 20
STREET: dict[str, Any] = {"length": 40.0, "points": 1.6e6, "photos": 32, "photo_width": 1600, "seed": 0}


@dataclass(frozen=True)
class Scene:
    """Where the files of a scene are; `atlas` and `depth` are those of our steps `unwrap` and `visibility`."""

    folder: Path

    @property
    def tile(self) -> Path:
        """The scan's folder."""
        return self.folder / "tile"

    @property
    def mesh(self) -> Path:
        """The one `Mesh`."""
        return self.folder / "mesh.npz"

    @property
    def views(self) -> Path:
        """`views.json`, with those that are held out."""
        return self.folder / "views" / "views.json"

    @property
    def clouds(self) -> dict[str, Path]:
        """The thinned points of the surface, and those that only hide (`cloud.rest`) where there are any."""
        files = {f"cloud.{part}": self.folder / f"{part}.npz" for part in ("surface", "rest")}
        return {name: path for name, path in files.items() if path.is_file()}

    @property
    def atlas(self) -> Path:
        """Folder of `mesh.npz` (with uv and page) and `pages.json`."""
        return self.folder / "atlas"

    @property
    def depth(self) -> Path:
        """Folder of a depth map a view."""
        return self.folder / "visibility" / "depth"

    def photos(self, *, held_out: bool) -> dict[int, View]:
        """Views by index: those that are held out, or those that are used."""
        views, held = views_io.load(self.views), views_io.load_held_out(self.views)
        return {i: view for i, view in enumerate(views) if held[i] == held_out}


def fresh(folder: Path) -> Path:
    """The folder, made anew and empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def run(step: Step, inputs: Mapping[str, Path], folder: Path, **given: Any) -> dict[str, Path]:
    """A step with its defaults, but for what is given; its files."""
    return step.run(inputs, step.params(**given), fresh(folder), silent).files


def available(name: str) -> bool:
    """Whether the scene can be made here."""
    return name != "kitti" or KITTI.is_dir()


def make(name: str, scene: Scene) -> None:
    """Make a scene's scan (one that is there stays), mesh, points and views."""
    scene.folder.mkdir(parents=True, exist_ok=True)
    if not (scene.tile / "tile.toml").is_file():
        _scan(name, scene.tile)
    if name == "street_hard":
        _surface_of(scene, Scene(scene.folder.with_name("street_clean")))
    else:
        _surface(scene, 10 if name == "kitti" else None, 20_000 if name == WARM else FACES)


def _scan(name: str, tile: Path) -> None:
    if name == WARM:
        tile.symlink_to(ROOT / "data_samples" / "tile")
    elif name == "kitti":
        from scan2sim.pipeline.importers.kitti_raw import import_kitti_raw

        import_kitti_raw(KITTI, tile, poses=KITTI / "T_velo0_velo_icp_frames_0-24.txt", link=True)
    else:
        from scan2sim.data_samples.layout import Style
        from scan2sim.data_samples.photos import Effects
        from scan2sim.data_samples.street import generate

        hard = name == "street_hard"
        generate(tile, **STREET, style=Style(moving_car=hard), effects=Effects(exposure_ev=1.0 if hard else 0.0))


def _surface(scene: Scene, depth: int | None, faces: int) -> None:
    """Mesh everything that belongs to a surface as one: 10 cm voxels, Poisson, trim, islands, decimate."""
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
    """The surface of another scene, in this one's frame; what only hides, and the views, of this one."""
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
    """`surface`, and `rest` where the points have classes: one point a voxel, normals towards the scanner."""
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
