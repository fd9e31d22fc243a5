"""`scan2sim import`: creates a tile from a user's files."""

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
from scan2sim.pipeline.core.classes import parse_mapping
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.importers.kitti_odometry import import_kitti_odometry
from scan2sim.pipeline.importers.kitti_raw import import_kitti_raw
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.steps.import_sweeps import build_tile

app = App("Import recordings: create a tile from point clouds, photos, sweeps or data sets.")
KITTI_CAMERA_HELP = "Image folder of a camera, such as {}, to take photos from; repeatable; default: {}."
MaxRange = Annotated[float, typer.Option(help="Largest range of a lidar return in metres; farther ones are dropped.")]


@app.command("kitti-raw")
def import_kitti(
    drive: Annotated[
        Path, typer.Argument(metavar="DRIVE", help="Folder of a drive (..._sync), or a folder that contains it.")
    ],
    out: TileOut,
    poses: Annotated[
        Path | None, typer.Option(help="File of sweep poses to use instead of OXTS: a row-major 3x4 matrix per line.")
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option("--camera", help=KITTI_CAMERA_HELP.format("image_03", "image_02"))
    ] = None,
    max_range: MaxRange = 50.0,
    rigid: Annotated[
        bool, typer.Option("--rigid", help="The sweeps are motion-compensated already: don't deskew them.")
    ] = False,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI raw: merge the sweeps by OXTS or a pose file, colour the points from the photos."""
    with progress("import") as report:
        path = import_kitti_raw(
            drive, out, poses=poses, cameras=camera or ["image_02"], max_range=max_range, deskew=not rigid,
            name=name, link=link, overwrite=overwrite, report=report,
        )  # fmt: skip
    _print_imported(path)


@app.command("kitti-odometry")
def import_kitti_sequence(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE", help="Folder of a sequence, with velodyne, image_2, calib.txt and times.txt."
        ),
    ],
    out: TileOut,
    poses: Annotated[
        Path | None, typer.Option(help="File of poses of camera 0, a 3x4 matrix per line; default: its poses.txt.")
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option("--camera", help=KITTI_CAMERA_HELP.format("image_3", "image_2"))
    ] = None,
    max_range: MaxRange = 50.0,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI odometry: merge the sweeps of a sequence by its poses, colour the points from the photos."""
    with progress("import") as report:
        path = import_kitti_odometry(
            sequence, out, poses=poses, cameras=camera or ["image_2"], max_range=max_range, name=name, link=link,
            overwrite=overwrite, report=report,
        )  # fmt: skip
    _print_imported(path)


def _import_model(kind: str, about: str) -> None:
    """Declare `scan2sim import KIND`, which imports posed photos of a photogrammetry program."""

    def command(
        model: Annotated[
            Path, typer.Argument(metavar="MODEL", help="File or folder of the photogrammetry program (see above).")
        ],
        images: Annotated[Path, typer.Argument(metavar="IMAGES", help="Folder of the photos.")],
        out: TileOut,
        cloud: Annotated[
            Path | None, typer.Option(help="File of the dense point cloud; default: the model's sparse points.")
        ] = None,
        crs: Annotated[
            str | None,
            typer.Option(
                help='CRS to convert to ("EPSG:32633"); for a model without georeference, the CRS that it is in.'
            ),
        ] = None,
        gps: Annotated[
            bool, typer.Option("--gps", help="Georeference the model by the GPS positions in the photos' EXIF.")
        ] = False,
        upright: Annotated[
            bool, typer.Option("--upright", help="Rotate the model so that the photos are upright (z up).")
        ] = False,
        scale: Annotated[float, typer.Option(help="Scale of the model, metres per unit.")] = 1.0,
        classes: Classes = "",
        name: Name = None,
        link: Link = False,
        overwrite: Overwrite = False,
    ) -> None:

        warnings: list[str] = []
        with progress("import") as report:
            path = import_model(
                kind, model, images, out, cloud=cloud, crs=crs, gps=gps, up="photos" if upright else None, scale=scale,
                classes=parse_mapping(classes), name=name, link=link, overwrite=overwrite, warn=warnings.append,
                report=report,
            )  # fmt: skip
        _print_imported(path, warnings)

    app.command(kind, help=about)(command)


_import_model("colmap", "COLMAP: the folder of cameras, images and points3D, .txt or .bin (often sparse/0).")
_import_model("opensfm", "OpenSfM or OpenDroneMap: a reconstruction.json, or the folder of the project.")
_import_model("metashape", "Agisoft Metashape: a cameras.xml (Export Cameras, Agisoft XML); needs a --cloud.")
_import_model("bundler", "Bundler: a bundle.out with list.txt in the same folder.")
_import_model("nvm", "VisualSFM: a .nvm file (NVM_V3).")


@app.command("las", hidden=True)  # alias for scripts: the former name
@app.command("clouds")
def import_plain_clouds(
    clouds: Annotated[
        list[Path],
        typer.Argument(
            metavar="CLOUD...", help="Point clouds: LAS, LAZ, COPC, PLY, E57, PCD, XYZ, CSV, or an ept.json."
        ),
    ],
    out: TileOut,
    photos: Annotated[
        Path | None, typer.Option(help="CSV file with the photos and their poses (docs/reference/formats.md).")
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(help="CSV file with the cameras' intrinsics, if the one of --photos has none.")
    ] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of the photos; default: that of the CSV file.")] = None,
    crs: Crs = None,
    units: Annotated[
        str | None, typer.Option(help="Unit of the coordinates: m, ft or us-ft; default: that of the CRS.")
    ] = None,
    trajectory: Annotated[Path | None, typer.Option(help="CSV file with the scanner's path: time,x,y,z.")] = None,
    orthophoto: Annotated[
        Path | None,
        typer.Option(help="Orthophoto that textures what it covers: a GeoTIFF, or a JPEG or PNG with a world file."),
    ] = None,
    footprints: Annotated[
        Path | None, typer.Option(help="Building footprints (GeoJSON or GeoPackage), for the positions of walls.")
    ] = None,
    classes: Classes = "",
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """Point clouds (LAS, PLY, E57, ...), optionally with posed photos listed in a CSV file."""
    warnings: list[str] = []
    with progress("import") as report:
        path = import_las(
            clouds, out, photos=photos, cameras=cameras, images=images, crs=crs, units=units, trajectory=trajectory,
            classes=parse_mapping(classes), orthophoto=orthophoto, footprints=footprints, name=name, link=link,
            overwrite=overwrite, warn=warnings.append, report=report,
        )  # fmt: skip
    _print_imported(path, warnings)


@app.command("sweeps")
@options(Sweeps, folder="SWEEPS")
def import_sweeps_and_poses(
    sweeps: Sweeps,
    poses: Annotated[
        Path | None,
        typer.Argument(
            metavar="TRAJECTORY",
            help="Trajectory (.csv, .tum, .kitti; z up), such as one of `scan2sim slam`; default: match the sweeps.",
        ),
    ] = None,
    *,
    out: TileOut,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """Lidar sweeps, merged by a trajectory, GPS, or lidar odometry (sweep matching); optionally with photos."""
    warnings: list[str] = []
    files, params = placed(sweeps, Path(), sweeps.poses)
    nodes = path(sweeps, Path(), sweeps.poses)
    if nodes:
        files["poses"] = scanner_path(nodes, out.with_name(f"{out.name}-path"))
    inputs = {key: file for key, file in files.items() if isinstance(file, Path)}
    with progress("import") as report:
        tile = build_tile(
            inputs, params, out, link=link, overwrite=overwrite, name=name, warn=warnings.append, report=report
        )
    _print_imported(tile, warnings)


def _print_imported(path: Path, warnings: Sequence[str] = ()) -> None:
    for warning in warnings:
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    typer.echo(f"Tile: {path}")
