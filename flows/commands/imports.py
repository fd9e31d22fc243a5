"""`scan2sim import`: creates a tile from a user's files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from scan2sim.flows.commands.app import App, Classes, Crs, Link, Name, Overwrite, TileOut
from scan2sim.flows.commands.display import progress
from scan2sim.flows.commands.imported import all_warnings, summaries
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.robot_map import NoImages, map_params
from scan2sim.flows.commands.sweeps import cached_check, run_before_import
from scan2sim.flows.pipelines import assembled, bag, dataset, images, kitti, sweeps
from scan2sim.flows.pipelines.graph import Task
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.importers.mesh_model import import_mesh
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.importers.robot_map import MapParams, import_map, map_files
from scan2sim.pipeline.io.label_sets import parse_classes
from scan2sim.pipeline.io.mesh_files import find_mesh
from scan2sim.pipeline.io.tile_folder import check_target
from scan2sim.pipeline.pose_check.check import check_photos
from scan2sim.pipeline.pose_check.conventions import PhotoConventions
from scan2sim.pipeline.steps import import_photos
from scan2sim.pipeline.steps.import_sweeps import SweepsParams, build_tile
from scan2sim.slam.steps.strip_adjustment import PoseSourceParams

app = App("Import recordings: create a tile from point clouds, photos, sweeps, ROS bags or data sets.")
KITTI_CAMERA_HELP = "Image folder of a camera, such as {}, to take photos from; repeatable; default: {}."
CHECKING_PHOTOS = "checking the photos against the cloud"
PoseSource = Annotated[
    str,
    typer.Option(metavar="given|auto|fused", help=PoseSourceParams.model_fields["pose_source"].description),
]
MaxRange = Annotated[float, typer.Option(help="Maximum range in metres; farther returns are removed.")]
VerticalAngleOffset = Annotated[
    float,
    typer.Option(help="Degrees by which the scanner's beams are raised, to correct its calibration (KITTI: 0.15)."),
]


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
    pose_source: PoseSource = "auto",
    max_range: MaxRange = 50.0,
    rigid: Annotated[
        bool, typer.Option("--rigid", help="The sweeps are motion-compensated already: don't deskew them.")
    ] = False,
    vertical_angle_offset: VerticalAngleOffset = 0.0,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI raw: merge the sweeps by OXTS or a pose file, colour the points from the photos."""
    source, warnings = PoseSourceParams.of("", {"pose_source": pose_source}).pose_source, list[str]()
    check = None
    if source != "given":
        check_target(out, overwrite)
        task = kitti.raw_check(
            drive, source, poses=poses, deskew=not rigid, vertical_angle_offset=vertical_angle_offset
        )
        check = cached_check(task, out)
    with progress("import") as report:
        path = kitti.import_kitti_raw(
            drive, out, poses=poses, cameras=camera or ["image_02"], max_range=max_range, deskew=not rigid,
            vertical_angle_offset=vertical_angle_offset, pose_source=source, trajectory_check=check, name=name,
            link=link, overwrite=overwrite, warn=warnings.append, report=report,
        )  # fmt: skip
        report(1.0, CHECKING_PHOTOS)
        warnings += check_photos(path, conventions=False)
    _print_imported(path, warnings)


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
    pose_source: PoseSource = "auto",
    max_range: MaxRange = 50.0,
    vertical_angle_offset: VerticalAngleOffset = 0.0,
    labels: Annotated[
        Path | None,
        typer.Option(help="Folder of labels (NNNNNN.label) of SemanticKITTI, or predicted in its format: classes."),
    ] = None,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI odometry: merge the sweeps of a sequence by its poses, colour the points from the photos."""
    source, warnings = PoseSourceParams.of("", {"pose_source": pose_source}).pose_source, list[str]()
    check = None
    if source != "given":
        check_target(out, overwrite)
        task = kitti.odometry_check(sequence, source, poses=poses, vertical_angle_offset=vertical_angle_offset)
        check = cached_check(task, out)
    with progress("import") as report:
        path = kitti.import_kitti_odometry(
            sequence, out, poses=poses, cameras=camera or ["image_2"], max_range=max_range, name=name, link=link,
            vertical_angle_offset=vertical_angle_offset, labels=labels, pose_source=source, trajectory_check=check,
            overwrite=overwrite, warn=warnings.append, report=report,
        )  # fmt: skip
        report(1.0, CHECKING_PHOTOS)
        warnings += check_photos(path, conventions=False)
    _print_imported(path, warnings)


def _import_model(kind: str, about: str) -> None:
    """Declare `scan2sim import KIND`, which imports posed photos of a photogrammetry program."""

    def command(
        model: Annotated[
            Path, typer.Argument(metavar="MODEL", help="File or folder of the photogrammetry program (see above).")
        ],
        out: TileOut,
        images: Annotated[
            Path | None, typer.Argument(metavar="IMAGES", help="Folder of the photos; default: that of the model.")
        ] = None,
        cloud: Annotated[
            Path | None, typer.Option(help="File of the dense point cloud; default: the points in the model.")
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
                classes=parse_classes(classes), name=name, link=link, overwrite=overwrite, warn=warnings.append,
                report=report,
            )  # fmt: skip
            if cloud is not None:
                report(1.0, CHECKING_PHOTOS)
                warnings += check_photos(path, conventions=False)
        _print_imported(path, warnings)

    app.command(kind, help=about)(command)


_import_model("colmap", "COLMAP: the folder of cameras, images and points3D, .txt or .bin (often sparse/0).")
_import_model("opensfm", "OpenSfM or OpenDroneMap: a reconstruction.json, or the folder of the project.")
_import_model("metashape", "Agisoft Metashape: a cameras.xml (Export Cameras, Agisoft XML); needs a --cloud.")
_import_model("pix4d", "Pix4D: a PROJECT_calibrated_camera_parameters.txt, with its offset.xyz; needs a --cloud.")
_import_model("bundler", "Bundler: a bundle.out with list.txt in the same folder.")
_import_model("nvm", "VisualSFM: a .nvm file (NVM_V3).")
_import_model("nerfstudio", "nerfstudio, Polycam, Record3D, KIRI Engine: a transforms.json, or the folder of one.")


@app.command("las", hidden=True)  # alias for scripts: the former name
@app.command("clouds")
@options(PhotoConventions)
def import_plain_clouds(
    conventions: PhotoConventions,
    clouds: Annotated[
        list[Path],
        typer.Argument(
            metavar="CLOUD...", help="Point clouds: LAS, LAZ, COPC, PLY, E57, PCD, PTX, XYZ, CSV, or an ept.json."
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
    no_images: NoImages = False,
    crs: Crs = None,
    units: Annotated[
        str | None,
        typer.Option(help="Unit of the coordinates: m, ft or us-ft; wins over that of the CRS, the default."),
    ] = None,
    axes: Annotated[
        str | None,
        typer.Option(
            metavar="enh|neh|...",
            help="Order of the clouds' coordinates: easting, northing, height (default: enh); neh: northing first.",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="The scanner's path: .csv (time,x,y,z), .tum or SBET; checked, see --pose-source."),
    ] = None,
    pose_source: PoseSource = "auto",
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
    """Point clouds (LAS, PLY, E57, ...), optionally with posed photos: listed in a CSV file, or inside an E57."""
    source, warnings = PoseSourceParams.of("", {"pose_source": pose_source}).pose_source, list[str]()
    check = None
    if trajectory is not None and source != "given" and axes is None:
        check_target(out, overwrite)
        check = cached_check(assembled.check(clouds, trajectory, source, crs=crs, units=units), out)
    with progress("import") as report:
        path = import_las(
            clouds, out, photos=photos, cameras=cameras, images=images, embedded_images=not no_images, crs=crs,
            units=units, axes=axes, trajectory=trajectory, trajectory_check=check, classes=parse_classes(classes),
            orthophoto=orthophoto, footprints=footprints, conventions=conventions, name=name, link=link,
            overwrite=overwrite, warn=warnings.append, report=report,
        )  # fmt: skip
        if photos is not None:
            report(1.0, CHECKING_PHOTOS)
            warnings += check_photos(path)
    _print_imported(path, warnings)


@app.command("map")
@options(MapParams)
def import_robot_map(
    params: MapParams,
    clouds: Annotated[
        Path,
        typer.Argument(
            metavar="MAP", help="Point cloud of a robot's SLAM, a folder of clouds in one frame, or a textured mesh."
        ),
    ],
    trajectory: Annotated[
        Path | None, typer.Option(help="Path of the sensor in the map's frame (.csv or .tum, with times).")
    ] = None,
    *,
    out: TileOut,
    name: Name = None,
    overwrite: Overwrite = False,
) -> None:
    """Robot's map, or textured mesh: found up axis, levelled, without outliers (`scan2sim run MAP` does it, too)."""
    notes: list[str] = []
    shared: dict[str, Any] = {"trajectory": trajectory, "name": name, "overwrite": overwrite, "warn": notes.append}
    params, mesh = map_params(**params.model_dump()), find_mesh(clouds)
    with progress("import") as report:
        if mesh is not None:
            path = import_mesh(mesh, out, params, **shared, report=report)
        else:
            path = import_map(map_files(clouds), out, params, **shared, report=report)
    _print_imported(path, notes)


@app.command("sweeps")
@options(sweeps.Sweeps, folder="SWEEPS")
def import_sweeps_and_poses(
    source: sweeps.Sweeps,
    poses: Annotated[
        Path | None,
        typer.Argument(
            metavar="TRAJECTORY",
            help="Trajectory (.csv, .tum, .kitti; z up), such as one of `scan2sim slam`; default: lidar odometry.",
        ),
    ] = None,
    *,
    out: TileOut,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """Lidar sweeps, merged by a trajectory, GPS, or lidar odometry; optionally with photos."""
    tasks = sweeps.build_graph(source, Path(), source.poses)
    _import_sweeps(tasks, out, "path", name=name, link=link, overwrite=overwrite)


@app.command("bag")
@options(bag.BagSource, file="BAG")
def import_ros_bag(
    source: bag.BagSource,
    *,
    out: TileOut,
    name: Name = None,
    overwrite: Overwrite = False,
) -> None:
    """ROS bag (MCAP, SQLite, ROS 1): sweeps, photos, calibration and poses of its topics (docs/rosbag.md)."""
    _import_sweeps(bag.build_graph(source, Path()), out, "recording", name=name, link=False, overwrite=overwrite)


@app.command("nuscenes")
@options(dataset.NuScenes)
def import_nuscenes(
    source: dataset.NuScenes,
    *,
    out: TileOut,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """nuScenes: merge the lidar sweeps of a scene by its poses, and add the photos of its cameras."""
    tasks = dataset.build_graph(source, Path())
    _import_sweeps(tasks, out, "recording", name=name, link=link, overwrite=overwrite, conventions=False)


@app.command("pandaset")
@options(dataset.PandaSet)
def import_pandaset(
    source: dataset.PandaSet,
    *,
    out: TileOut,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """PandaSet: merge the lidar sweeps of a sequence by its poses, and add the photos of its cameras."""
    tasks = dataset.build_graph(source, Path())
    _import_sweeps(tasks, out, "recording", name=name, link=link, overwrite=overwrite, conventions=False)


@app.command("images")
@options(images.Images, photos="PHOTOS")
def import_unposed_photos(
    source: images.Images,
    *,
    out: TileOut,
    classes: Classes = "",
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """Photos without poses, or a video: poses by COLMAP, scale and position by GPS and a cloud (docs/images.md)."""
    check_target(out, overwrite)
    if out.resolve().is_relative_to(source.photos.resolve()):
        raise SettingError("--out", f"is inside the folder of the photos, {source.photos}", "Choose a folder beside it")
    tasks = images.build_graph(source, Path())
    inputs = run_before_import(tasks, out.with_name(f"{out.name}-photos"))
    params, warnings = tasks[-1].params, list[str]()
    assert isinstance(params, import_photos.ImportPhotosParams)
    with progress("import") as report:
        tile = import_photos.build_tile(
            inputs, params, out, classes=parse_classes(classes), name=name, link=link, overwrite=overwrite,
            warn=warnings.append, report=report,
        )  # fmt: skip
    _print_imported(tile, warnings)


def _import_sweeps(tasks: list[Task], out: Path, suffix: str, **options: Any) -> None:
    """Run an import of sweeps and the tasks before it, whose results are cached in a folder beside `out`."""
    check_target(out, options["overwrite"])
    inputs = run_before_import(tasks, out.with_name(f"{out.name}-{suffix}"))
    params, warnings = tasks[-1].params, list[str]()
    assert isinstance(params, SweepsParams)
    with progress("import") as report:
        tile = build_tile(inputs, params, out, warn=warnings.append, report=report, **options)
    _print_imported(tile, warnings)


def _print_imported(path: Path, warnings: Sequence[str] = ()) -> None:
    for warning in all_warnings(path, warnings):
        typer.secho(f"warning: {warning}", fg="yellow", err=True)
    for line in (*summaries(path), f"Tile: {path}"):
        typer.echo(line)
