"""`scan2sim import`: a tile from a user's files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App, Classes, Crs, Link, Name, Overwrite, TileOut
from scan2sim.flows.commands.display import progress
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.sweeps import scanner_path
from scan2sim.flows.pipelines.sweeps import Sweeps, path, placed
from scan2sim.pipeline.core.classes import parse
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.importers.kitti_odometry import import_kitti_odometry
from scan2sim.pipeline.importers.kitti_raw import import_kitti_raw
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.steps.import_sweeps import tile_of

app = App("Make a tile from your files.")
Cameras = Annotated[list[str] | None, typer.Option("--camera", help="Its folder; several times for several.")]
MaxRange = Annotated[float, typer.Option(help="Metres; returns from further away are left out.")]


@app.command("kitti-raw")
def import_kitti(
    drive: Annotated[Path, typer.Argument(help="A drive's folder (..._sync), or one that holds it.")],
    out: TileOut,
    poses: Annotated[Path | None, typer.Option(help="Sweep poses instead of OXTS: row-major 3x4 a line.")] = None,
    camera: Cameras = None,
    max_range: MaxRange = 50.0,
    rigid: Annotated[bool, typer.Option("--rigid", help="Sweeps are motion-compensated already.")] = False,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI raw: merge sweeps by OXTS or a pose file, colour points from the photos."""
    with progress("import") as report:
        path = import_kitti_raw(
            drive, out, poses=poses, cameras=camera or ["image_02"], max_range=max_range, deskew=not rigid,
            name=name, link=link, overwrite=overwrite, report=report,
        )  # fmt: skip
    _imported(path)


@app.command("kitti-odometry")
def import_kitti_sequence(
    sequence: Annotated[Path, typer.Argument(help="A sequence's folder: velodyne, image_2, calib.txt, times.txt.")],
    out: TileOut,
    poses: Annotated[Path | None, typer.Option(help="Of camera 0, 3x4 a line; default: poses.txt in it.")] = None,
    camera: Cameras = None,
    max_range: MaxRange = 50.0,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI odometry: merge a sequence's sweeps by its poses, colour points from the photos."""
    with progress("import") as report:
        path = import_kitti_odometry(
            sequence, out, poses=poses, cameras=camera or ["image_2"], max_range=max_range, name=name, link=link,
            overwrite=overwrite, report=report,
        )  # fmt: skip
    _imported(path)


def _import_model(kind: str, about: str) -> None:
    """`scan2sim import KIND`: the same options for every program's posed photos."""

    def command(
        model: Annotated[Path, typer.Argument(help="The program's file or folder, as above.")],
        images: Annotated[Path, typer.Argument(help="Folder of the photos.")],
        out: TileOut,
        cloud: Annotated[Path | None, typer.Option(help="Dense cloud; default: the sparse points.")] = None,
        crs: Annotated[
            str | None, typer.Option(help="To bring it to; or that it is in, where it isn't georeferenced.")
        ] = None,
        gps: Annotated[bool, typer.Option("--gps", help="Place it by the GPS in the photos' EXIF.")] = False,
        upright: Annotated[bool, typer.Option("--upright", help="Turn it so that photos stand upright.")] = False,
        scale: Annotated[float, typer.Option(help="Metres per unit of the model.")] = 1.0,
        classes: Classes = "",
        name: Name = None,
        link: Link = False,
        overwrite: Overwrite = False,
    ) -> None:

        warnings: list[str] = []
        with progress("import") as report:
            path = import_model(
                kind, model, images, out, cloud=cloud, crs=crs, gps=gps, up="photos" if upright else None, scale=scale,
                classes=parse(classes), name=name, link=link, overwrite=overwrite, warn=warnings.append, report=report,
            )  # fmt: skip
        _imported(path, warnings)

    app.command(kind, help=about)(command)


_import_model("colmap", "COLMAP: a folder of cameras, images and points3D, .txt or .bin (often sparse/0).")
_import_model("opensfm", "OpenSfM or OpenDroneMap: a reconstruction.json, or the project's folder.")
_import_model("metashape", "Agisoft Metashape: a cameras.xml (Export Cameras, Agisoft XML); needs a --cloud.")
_import_model("bundler", "Bundler: a bundle.out, with its list.txt beside it.")
_import_model("nvm", "VisualSFM: a .nvm file (NVM_V3).")


@app.command("las", hidden=True)  # what it was called when it read LAS and PLY alone
@app.command("clouds")
def import_plain_clouds(
    clouds: Annotated[
        list[Path], typer.Argument(help="LAS, LAZ, COPC, PLY, E57, PCD, XYZ, CSV files, or an ept.json.")
    ],
    out: TileOut,
    photos: Annotated[Path | None, typer.Option(help="CSV of photos and poses (docs/formats.md).")] = None,
    cameras: Annotated[Path | None, typer.Option(help="CSV of cameras, where the photos' lacks them.")] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of the photos; default: the CSV's.")] = None,
    crs: Crs = None,
    units: Annotated[str | None, typer.Option(help="m, ft or us-ft, where the CRS doesn't say.")] = None,
    trajectory: Annotated[Path | None, typer.Option(help="CSV of the scanner's path: time,x,y,z.")] = None,
    orthophoto: Annotated[
        Path | None, typer.Option(help="GeoTIFF, or JPEG, PNG with a world file: drapes what it covers.")
    ] = None,
    footprints: Annotated[
        Path | None, typer.Option(help="GeoJSON or GeoPackage of buildings: where walls stand.")
    ] = None,
    classes: Classes = "",
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """Plain clouds, with a CSV of photos if there are any."""
    warnings: list[str] = []
    with progress("import") as report:
        path = import_las(
            clouds, out, photos=photos, cameras=cameras, images=images, crs=crs, units=units, trajectory=trajectory,
            classes=parse(classes), orthophoto=orthophoto, footprints=footprints, name=name, link=link,
            overwrite=overwrite, warn=warnings.append, report=report,
        )  # fmt: skip
    _imported(path, warnings)


@app.command("sweeps")
@options(Sweeps, folder="SWEEPS")
def import_sweeps_and_poses(
    sweeps: Sweeps,
    poses: Annotated[
        Path | None, typer.Argument(metavar="[TRAJECTORY]", help="Of `slam` for example: .csv, .tum, .kitti; z-up.")
    ] = None,
    *,
    out: TileOut,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """A scanner's sweeps placed by a trajectory, by GPS and each other, with photos if there are any."""
    warnings: list[str] = []
    files, params = placed(sweeps, Path(), sweeps.poses)
    nodes = path(sweeps, Path(), sweeps.poses)
    if nodes:
        files["poses"] = scanner_path(nodes, out.with_name(f"{out.name}-path"))
    inputs = {key: file for key, file in files.items() if isinstance(file, Path)}
    with progress("import") as report:
        tile = tile_of(
            inputs, params, out, link=link, overwrite=overwrite, name=name, warn=warnings.append, report=report
        )
    _imported(tile, warnings)


def _imported(path: Path, warnings: Sequence[str] = ()) -> None:
    for warning in warnings:
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    typer.echo(f"Tile: {path}")
