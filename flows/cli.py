"""The `scan2sim` command. What is heavy is imported inside the commands: it starts in a blink."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand, TyperGroup

from scan2sim import __version__
from scan2sim.pipeline.errors import INTERRUPTED, ScanError, exit_code, from_os_error

PAGES = Path(__file__).parents[1] / "docs"
"""Where the pages are that help and errors name as docs/NAME.md: they come with a wheel, too."""


class _Command(TyperCommand):
    """A command whose numbers are looked at before it begins."""

    def invoke(self, ctx: Any) -> Any:
        from scan2sim.flows.numbers import check

        check(ctx.params)
        return super().invoke(ctx)


class _App(typer.Typer):
    """Commands as they are declared, all of them `_Command`s."""

    def command(self, name: str | None = None, **options: Any) -> Any:
        return super().command(name, cls=_Command, **options)


app = _App(
    name="scan2sim",
    help="Street scans (lidar clouds and posed photos) to textured worlds for robot simulators.",
    no_args_is_help=True,
    epilog=f"Pages (docs/...) are in {PAGES}.",
    add_completion=False,
    pretty_exceptions_enable=False,
)
imports = _App(no_args_is_help=True, help="Make a tile from your files.")
app.add_typer(imports, name="import")


class _FirstIsDefault(TyperGroup):
    """`segment TILE` is `segment tile TILE`, `slam VIDEO` is `slam video VIDEO`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands:
            args = [next(iter(self.commands)), *args]
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)


segments = _App(
    cls=_FirstIsDefault, no_args_is_help=True, help="Classes of a tile's points and photos: `segment TILE --out DIR`."
)
app.add_typer(segments, name="segment")
slams = _App(
    cls=_FirstIsDefault, no_args_is_help=True, help="Where the camera of a video went: `slam VIDEO --out DIR`."
)
app.add_typer(slams, name="slam")


TilePath = Annotated[Path, typer.Argument(metavar="TILE", help="A tile.toml, or the folder that holds one.")]
OutDir = Annotated[Path, typer.Option("--out", "-o", help="Folder for the world, the report and kept results.")]
Sets = Annotated[list[str] | None, typer.Option("--set", metavar="STEP.PARAM=VALUE", help="Change a setting.")]
Config = Annotated[Path | None, typer.Option("--config", help="Settings as a TOML file.")]
HoldOut = Annotated[
    int | None, typer.Option("--hold-out", metavar="N", help="Keep every Nth photo out of texturing, to score it.")
]
Force = Annotated[bool, typer.Option("--force", help="Run everything again.")]
From = Annotated[str | None, typer.Option("--from", metavar="STEP", help="Run this step and what follows again.")]
Name = Annotated[str | None, typer.Option("--name", help="The tile's name; default: from the folder.")]
TileOut = Annotated[Path, typer.Option("--out", "-o", help="The tile's folder.")]
Crs = Annotated[str | None, typer.Option(help='CRS, where the files lack it: "EPSG:32633", or "local".')]
Classes = Annotated[
    str, typer.Option(metavar="CODE=CLASS,...", help="What codes of the cloud are: 65=noise,200=5 (docs/formats.md).")
]
Link = Annotated[bool, typer.Option("--link", help="Link files into the tile instead of copying them.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a tile that is there already.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"scan2sim {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")] = False,
) -> None:
    pass


@app.command()
def run(
    tile: TilePath,
    out: OutDir,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
    jobs: Annotated[int, typer.Option(min=0, help="Steps at a time; 0: as the cores allow.")] = 0,
) -> None:
    """Make a world of a tile; what an earlier run has finished is kept."""
    from scan2sim.flows.run import run_tile

    run_tile(tile, out, _settings(set_, config, hold_out), force=force, start=from_, jobs=jobs)


@app.command()
def plan(
    tile: TilePath,
    out: OutDir = Path("out"),
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
) -> None:
    """Show what `run` would run, and why."""
    from scan2sim.flows.run import show_plan

    show_plan(tile, out, _settings(set_, config, hold_out), force=force, start=from_)


@app.command()
def tile(
    corridor: Annotated[Path, typer.Argument(metavar="CORRIDOR", help="A tile.toml too long for one tile.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The survey's folder.")],
    length: Annotated[float, typer.Option(help="Metres of road a tile.")] = 100.0,
    buffer: Annotated[float, typer.Option(help="Metres that tiles' clouds reach beyond their borders.")] = 5.0,
    reach: Annotated[float, typer.Option(help="Metres from the trajectory beyond which points are left out.")] = 60.0,
    photo_reach: Annotated[float, typer.Option(help="Metres beyond a tile up to which photos are taken.")] = 40.0,
    name: Annotated[str | None, typer.Option(help="The survey's name; default: the corridor's.")] = None,
    copy: Annotated[bool, typer.Option("--copy", help="Copy photos into the tiles instead of naming them.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a survey that is there already.")] = False,
) -> None:
    """Cut a long corridor into tiles that overlap: a survey."""
    from scan2sim.flows.cut import Options, cut_survey
    from scan2sim.flows.display import progress

    told: list[str] = []
    options = Options(length, buffer, reach, photo_reach, copy)
    with progress("tile") as report:
        path = cut_survey(corridor, out, options, name=name, overwrite=overwrite, report=report, warn=told.append)
    for warning in told:
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    typer.echo(f"Survey: {path}")


@app.command()
def survey(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A survey.toml, tile.toml or drive.toml, or its folder.")
    ],
    out: Annotated[
        str, typer.Option("--out", "-o", help="Folder for worlds, reports and kept results, or its s3:// URL.")
    ],
    length: Annotated[float | None, typer.Option(help="Metres of road a tile, where it is cut here.")] = None,
    buffer: Annotated[float | None, typer.Option(help="Metres of overlap, where it is cut here.")] = None,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    jobs: Annotated[int, typer.Option(min=0, help="Steps at a time; 0: as the cores allow.")] = 0,
    memory: Annotated[str | None, typer.Option(help="What steps may need together, as 20GB.")] = None,
    runner: Annotated[
        Literal["processes", "threads", "dask", "ray"], typer.Option(help="The last three: through Prefect.")
    ] = "processes",
    address: Annotated[str | None, typer.Option(help="Of a Dask scheduler or Ray cluster.")] = None,
    cores: Annotated[int | None, typer.Option(min=1, help="That a step may use; default: all.")] = None,
) -> None:
    """Make the worlds of all tiles of a survey, which meet, and one of them all."""
    from scan2sim.flows.surveying import run_source

    run_source(
        source, out, _settings(set_, config, hold_out), length=length, buffer=buffer, jobs=jobs, memory=memory,
        runner=runner, address=address, cores=cores,
    )  # fmt: skip


@app.command()
def verify(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder that run or survey was given as --out.")],
) -> None:
    """Read all that was made, and say what is damaged; the next run makes that anew."""
    from scan2sim.flows.verify import verify

    verify(out)


@app.command()
def inspect(path: Annotated[Path, typer.Argument(help="A cloud, a tile, a mesh, or a world.")]) -> None:
    """Show one screen of facts."""
    from scan2sim.flows.inspect import inspect_path

    inspect_path(path)


@app.command()
def sample(
    out: Annotated[Path, typer.Argument(help="The tile's folder.")],
    small: Annotated[bool, typer.Option("--small", help="The street of 26 m that comes along, at once.")] = False,
    length: Annotated[float, typer.Option(help="Metres of road.")] = 100.0,
    points: Annotated[float, typer.Option(help="Points of the cloud.")] = 9e6,
    photos: Annotated[int, typer.Option(help="Photos in all.")] = 40,
    seed: Annotated[int, typer.Option(help="Another seed, another street.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Generate a synthetic street with its ground truth."""
    from scan2sim.flows.display import progress
    from scan2sim.pipeline.io.importing import tile_folder

    with progress("street") as report, tile_folder(out, overwrite) as folder:
        if small:
            import shutil

            from scan2sim.data_samples import SMALL

            shutil.copytree(SMALL, folder, dirs_exist_ok=True)
        else:
            from scan2sim.data_samples.street import generate
            from scan2sim.pipeline import libraries

            libraries.check()
            generate(folder, length=length, points=points, photos=photos, seed=seed, report=report)
    typer.echo(f"Tile: {out / 'tile.toml'}")


@segments.command("tile")
def segment_a_tile(
    tile: TilePath,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for clouds, labels, masks and kept results.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Tell classes anew where the cloud has some.")] = False,
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Classify a tile's points from its photos; write LAZ, label pictures and masks."""
    from scan2sim.flows.segment import segment_tile

    segment_tile(
        tile, out, _settings([*(set_ or []), *(["segment.overwrite=true"] if overwrite else [])], config, None)
    )


@segments.command("train")
def segment_train(
    folder: Annotated[Path, typer.Argument(help="Of images/ and labels/ (docs/segmentation.md).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="ONNX file of the weights.")] = Path("street.onnx"),
    minutes: Annotated[float, typer.Option(help="At most; 0: no limit.")] = 0,
    steps: Annotated[int, typer.Option(help="Of the optimiser.")] = 3000,
    seed: Annotated[int, typer.Option(help="Of weights, crops and looks.")] = 0,
    start: Annotated[Path | None, typer.Option(help="Weights (safetensors) to go on from.")] = None,
) -> None:
    """Train the project's own network on labelled photos."""
    from scan2sim.flows.segment import train_network

    train_network(folder, out, minutes=minutes, steps=steps, seed=seed, start=start)


@segments.command("evaluate")
def segment_evaluate(
    path: Annotated[Path, typer.Argument(help="A tile whose cloud has classes, or a folder of labelled photos.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for a tile's results.")] = Path("segment-out"),
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Print how classes that are told compare with those that are known."""
    from scan2sim.flows.segment import evaluate

    evaluate(path, out, _settings([*(set_ or []), "segment.overwrite=true"], config, None))


@slams.command("video")
def slam_a_video(
    video: Annotated[Path, typer.Argument(metavar="VIDEO", help="A video file, or a folder of pictures.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the trajectory.")],
    gps: Annotated[
        Path | None, typer.Option(help="GPX, NMEA, CSV, or a GoPro video: ties the scale, and places it.")
    ] = None,
    gps_offset: Annotated[float | None, typer.Option(help="Seconds to add to its times; first frame at 0.")] = None,
    local: Annotated[bool, typer.Option("--local", help="Don't place it where GPS says: scale alone.")] = False,
    mask: Annotated[Path | None, typer.Option(help="Picture: 0 where the car itself is seen.")] = None,
    camera: Annotated[str, typer.Option(help="auto, equirectangular or pinhole.")] = "auto",
    focal: Annotated[float | None, typer.Option(help="Pixels, of a pinhole camera.")] = None,
    centre: Annotated[tuple[float, float] | None, typer.Option(help="Pixels; default: the middle.")] = None,
    tile: Annotated[Path | None, typer.Option(help="Take the camera of this tile that has the video's size.")] = None,
    fps: Annotated[float, typer.Option(help="Of a folder of pictures.")] = 10.0,
    times: Annotated[Path | None, typer.Option(help="Of a folder's pictures: seconds, one a line.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every Nth frame.")] = 1,
    until: Annotated[float, typer.Option(help="Seconds of the video; 0: all.")] = 0.0,
    backend: Annotated[str, typer.Option(help="lm, or adam: the mission's.")] = "lm",
    features: Annotated[str, typer.Option(help="corners (tracked), orb, rootsift, superpoint, aliked.")] = "corners",
    matcher: Annotated[str, typer.Option(help="nearest, superglue, lightglue.")] = "nearest",
    weights: Annotated[Path | None, typer.Option(help="Your file of the features' weights.")] = None,
    matcher_weights: Annotated[Path | None, typer.Option(help="Your file of the matcher's.")] = None,
    colmap: Annotated[bool, typer.Option("--colmap", help="Write the map as a COLMAP model, too.")] = False,
    loops: Annotated[bool, typer.Option("--loops", help="Recognise places that were passed before.")] = False,
    adjust: Annotated[bool, typer.Option("--adjust", help="Adjust all keyframes at once in the end.")] = False,
    view: Annotated[bool, typer.Option("--view", help="Record what is tracked, and where: view.mp4.")] = False,
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Poses of a video's frames: TUM, KITTI, CSV, GeoJSON."""
    from scan2sim.flows.slam import Options, slam_video

    options = Options(
        gps=gps, gps_offset=gps_offset, georeference=not local, mask=mask, camera=camera, focal=focal, centre=centre,
        tile=tile, fps=fps, times=times, every=every, until=until or None, backend=backend,
        features=features, matcher=matcher, weights=weights, matcher_weights=matcher_weights,
        colmap=colmap, loops=loops, adjust=adjust, view=view,
    )  # fmt: skip
    slam_video(video, out, options, _settings(set_, config, None))


@slams.command("evaluate")
def slam_evaluate(
    trajectory: Annotated[Path, typer.Argument(help="CSV, TUM or KITTI file.")],
    truth: Annotated[Path, typer.Argument(help="Another, or a GPS track.")],
    segment: Annotated[float, typer.Option(help="Metres of the local error's segments.")] = 400.0,
    alignment: Annotated[str, typer.Option(help="similarity2d, rigid2d or similarity3d.")] = "similarity2d",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="PNG of path and errors.")] = None,
) -> None:
    """Print how far a trajectory is from the truth: D3.2's errors, ATE, RPE, drift."""
    from scan2sim.flows.slam import evaluate_trajectory

    evaluate_trajectory(trajectory, truth, segment=segment, alignment=alignment, out=out)


@slams.command("study")
def slam_study(
    source: Annotated[Path, typer.Argument(metavar="DRIVE", help="A drive's folder, a video, or its frames.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of cells, tables and plots.")],
    truth: Annotated[Path | None, typer.Option(help="Trajectory or GPS track; default: the drive's.")] = None,
    gps: Annotated[Path | None, typer.Option(help="Track for the scale; default: the drive's.")] = None,
    mask: Annotated[Path | None, typer.Option(help="Picture: 0 where the car is; default: the drive's.")] = None,
    heights: Annotated[str, typer.Option(help="Pixels.")] = "512,768,1024,1536",
    bitrates: Annotated[str, typer.Option(help="Mbit/s.")] = "1,2,5,10,20,40",
    rates: Annotated[str, typer.Option(help="Frames a second.")] = "30,15",
    jobs: Annotated[int, typer.Option(min=1, help="Cells at a time.")] = 1,
    backend: Annotated[str, typer.Option(help="lm, or adam: the mission's.")] = "lm",
    set_: Sets = None,
    config: Config = None,
) -> None:
    """What resolution, bit rate and frame rate of the video cost: D3.2's tables 4 and 5."""
    from scan2sim.flows.slam import study_compression

    study_compression(
        source, out, truth=truth, gps=gps, mask=mask, heights=heights, bitrates=bitrates, rates=rates, jobs=jobs,
        backend=backend, settings=_settings(set_, config, None),
    )  # fmt: skip


@imports.command("kitti-raw")
def import_kitti(
    drive: Annotated[Path, typer.Argument(help="A drive's folder (..._sync), or one that holds it.")],
    out: TileOut,
    poses: Annotated[Path | None, typer.Option(help="Sweep poses instead of OXTS: row-major 3x4 a line.")] = None,
    camera: Annotated[list[str] | None, typer.Option(help="Its folder; several times for several.")] = None,
    max_range: Annotated[float, typer.Option(help="Metres; returns from further away are left out.")] = 50.0,
    rigid: Annotated[bool, typer.Option("--rigid", help="Sweeps are motion-compensated already.")] = False,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI raw: merge sweeps by OXTS or a pose file, colour points from the photos."""
    from scan2sim.flows.display import progress
    from scan2sim.pipeline.io.kitti import import_kitti_raw

    with progress("import") as report:
        path = import_kitti_raw(
            drive, out, poses=poses, cameras=camera or ["image_02"], max_range=max_range, deskew=not rigid,
            name=name, link=link, overwrite=overwrite, report=report,
        )  # fmt: skip
    _imported(path)


@imports.command("kitti-odometry")
def import_kitti_sequence(
    sequence: Annotated[Path, typer.Argument(help="A sequence's folder: velodyne, image_2, calib.txt, times.txt.")],
    out: TileOut,
    poses: Annotated[Path | None, typer.Option(help="Of camera 0, 3x4 a line; default: poses.txt in it.")] = None,
    camera: Annotated[list[str] | None, typer.Option(help="Its folder; several times for several.")] = None,
    max_range: Annotated[float, typer.Option(help="Metres; returns from further away are left out.")] = 50.0,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI odometry: merge a sequence's sweeps by its poses, colour points from the photos."""
    from scan2sim.flows.display import progress
    from scan2sim.pipeline.io.kitti_odometry import import_kitti_odometry

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
        from scan2sim.flows.display import progress
        from scan2sim.pipeline.classes import parse
        from scan2sim.pipeline.io.import_model import import_model

        told: list[str] = []
        with progress("import") as report:
            path = import_model(
                kind, model, images, out, cloud=cloud, crs=crs, gps=gps, up="photos" if upright else None, scale=scale,
                classes=parse(classes), name=name, link=link, overwrite=overwrite, warn=told.append, report=report,
            )  # fmt: skip
        _imported(path, told)

    imports.command(kind, help=about)(command)


_import_model("colmap", "COLMAP: a folder of cameras, images and points3D, .txt or .bin (often sparse/0).")
_import_model("opensfm", "OpenSfM or OpenDroneMap: a reconstruction.json, or the project's folder.")
_import_model("metashape", "Agisoft Metashape: a cameras.xml (Export Cameras, Agisoft XML); needs a --cloud.")
_import_model("bundler", "Bundler: a bundle.out, with its list.txt beside it.")
_import_model("nvm", "VisualSFM: a .nvm file (NVM_V3).")


@imports.command("las", hidden=True)  # what it was called when it read LAS and PLY alone
@imports.command("clouds")
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
    from scan2sim.flows.display import progress
    from scan2sim.pipeline.classes import parse
    from scan2sim.pipeline.io.las_csv import import_las

    told: list[str] = []
    with progress("import") as report:
        path = import_las(
            clouds, out, photos=photos, cameras=cameras, images=images, crs=crs, units=units, trajectory=trajectory,
            classes=parse(classes), orthophoto=orthophoto, footprints=footprints, name=name, link=link,
            overwrite=overwrite, warn=told.append, report=report,
        )  # fmt: skip
    _imported(path, told)


@imports.command("sweeps")
def import_sweeps_and_poses(
    sweeps: Annotated[Path, typer.Argument(help="Folder of sweeps in scanner axes: .bin, .pcd, .ply, .las, .laz.")],
    poses: Annotated[Path, typer.Argument(help="Trajectory, of `slam` for example: .csv, .tum, .kitti; z-up.")],
    out: TileOut,
    extrinsics: Annotated[
        Path | None, typer.Option(help="T_camera_scanner, 3 or 4 rows, or KITTI's calibration: poses are the camera's.")
    ] = None,
    scanner_poses: Annotated[
        bool, typer.Option("--scanner-poses", help="Poses are the scanner's all the same.")
    ] = False,
    times: Annotated[
        Path | None, typer.Option(help="Of sweeps, seconds, one a line; default: names, or order.")
    ] = None,
    time_offset: Annotated[float, typer.Option(help="Seconds to add to times of sweeps and photos.")] = 0.0,
    photos: Annotated[Path | None, typer.Option(help="Folder of photos: they colour the points.")] = None,
    photo_times: Annotated[Path | None, typer.Option(help="Of photos, likewise.")] = None,
    camera: Annotated[str, typer.Option(help="auto, pinhole, equirectangular, or a TOML like a tile's.")] = "auto",
    focal: Annotated[float | None, typer.Option(help="Pixels, of a pinhole camera.")] = None,
    centre: Annotated[tuple[float, float] | None, typer.Option(help="Pixels; default: the middle.")] = None,
    mask: Annotated[Path | None, typer.Option(help="Of all photos: 0 where the car itself is seen.")] = None,
    max_range: Annotated[float, typer.Option(help="Metres; returns from further away are left out.")] = 50.0,
    min_range: Annotated[float, typer.Option(help="Metres; nearer returns, the car's own, are left out.")] = 1.0,
    deskew: Annotated[str, typer.Option(help="kitti: points by the pose of their own moment; or none.")] = "none",
    period: Annotated[
        float | None, typer.Option(help="Seconds of the scanner's turn; default: between sweeps.")
    ] = None,
    voxel: Annotated[float | None, typer.Option(help="Keep one point in so many metres.")] = None,
    keep_unsure: Annotated[bool, typer.Option("--keep-unsure", help="Take unsure stretches of the path, too.")] = False,
    crs: Crs = "local",
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """A scanner's sweeps placed by a trajectory, with photos if there are any."""
    from scan2sim.flows.display import progress
    from scan2sim.pipeline.errors import SettingError
    from scan2sim.pipeline.io import sweeps as sweeps_io

    if deskew not in ("none", "kitti"):
        raise SettingError("deskew", f"there is no {deskew!r}", "Use kitti, or none")
    known = None if extrinsics is None else sweeps_io.read_extrinsics(extrinsics)
    pictures = None
    if photos is not None:
        file = Path(camera) if camera.endswith(".toml") or Path(camera).exists() else None
        shape = sweeps_io.camera_of_photos(
            photos, model="auto" if file else camera, focal=focal, centre=centre, file=file
        )
        beside = None if extrinsics is None else sweeps_io.photo_extrinsics(extrinsics, photos)
        pictures = sweeps_io.Pictures(photos, shape, photo_times, mask, beside)
    told: list[str] = []
    with progress("import") as report:
        path = sweeps_io.import_sweeps(
            sweeps, poses, out, extrinsics=known, of="scanner" if scanner_poses else None, times=times,
            offset=time_offset, photos=pictures, max_range=max_range, min_range=min_range,
            deskew="kitti" if deskew == "kitti" else "none", period=period, voxel=voxel, keep_unsure=keep_unsure,
            crs=crs or "local", name=name, link=link, overwrite=overwrite, warn=told.append, report=report,
        )  # fmt: skip
    _imported(path, told)


def _imported(path: Path, warnings: Sequence[str] = ()) -> None:
    for warning in warnings:
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    typer.echo(f"Tile: {path}")


def _settings(set_: list[str] | None, config: Path | None, hold_out: int | None):  # type: ignore[no-untyped-def]
    from scan2sim.flows.settings import Settings

    assignments = list(set_ or [])
    if hold_out is not None:
        assignments.append(f"views.hold_out={hold_out}")
    return Settings.read(config, assignments)


def main() -> None:
    """Run the command; errors become one message and an exit code (`pipeline.errors.EXIT_CODES`)."""
    os.environ.setdefault("PYTHONSAFEPATH", "1")  # a random.py in the current folder is not our processes' own
    try:
        app()
    except SystemExit as ended:
        if ended.code == exit_code(KeyboardInterrupt()):  # as typer turns Ctrl-C into
            typer.echo(INTERRUPTED, err=True)
        raise
    except Exception as error:
        if isinstance(error, OSError):
            error = from_os_error(error, error.filename or "a file")

        if isinstance(error, ScanError):
            typer.secho(f"error: {error.where}: {error.cause}", fg="red", err=True)
            remedy = re.sub(r"(?<![\w/])docs(?=/\w+\.md)", str(PAGES), error.remedy)
            typer.echo(f"  {remedy}{'' if remedy.endswith('?') else '.'}", err=True)
        else:
            from scan2sim.flows.display import log_unexpected

            typer.secho(f"error: unexpected {type(error).__name__}: {error}", fg="red", err=True)
            typer.echo(f"  The details are in {log_unexpected(error)}; please report them.", err=True)
        sys.exit(exit_code(error))


if __name__ == "__main__":
    main()
