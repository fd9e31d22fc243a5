"""Importers of the Python API: each makes a tile of a user's files, as the command `scan2sim import` of its name does.

Paths may be text or `pathlib.Path`. Warnings go to the terminal, or to `warn` if it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from scan2sim.flows.pipelines.graph import Task
    from scan2sim.pipeline.core.step import Report
    from scan2sim.pipeline.pose_check.conventions import PhotoConventions

PoseSource = Literal["given", "auto", "fused"]
Up = tuple[float, float, float] | Literal["photos"]
Warn = Callable[[str], None]
CHECKING_PHOTOS = "checking the photos against the cloud"


def import_clouds(
    clouds: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    photos: str | Path | None = None,
    cameras: str | Path | None = None,
    images: str | Path | None = None,
    embedded_images: bool = True,
    crs: str | None = None,
    units: str | None = None,
    axes: str | None = None,
    trajectory: str | Path | None = None,
    pose_source: PoseSource = "auto",
    orthophoto: str | Path | None = None,
    footprints: str | Path | None = None,
    conventions: PhotoConventions | Mapping[str, Any] | None = None,
    classes: Mapping[int, int] | None = None,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    report: Report | None = None,
) -> Path:
    """Create a tile from point clouds and, optionally, posed photos.

    Args:
        clouds: a file, or several in one CRS. LAS, LAZ and PLY files are copied unchanged; others are converted to LAZ,
            with coordinates rounded to millimetres.
        out: folder of the tile to create.
        photos: CSV of posed photos (docs/reference/formats.md).
        cameras: CSV of cameras, if the photos' rows don't contain them.
        images: folder of the photos; default: that of the CSV.
        embedded_images: whether images with poses inside E57 files become photos of the tile.
        crs: "EPSG:32633" or WKT, "local" without georeference; takes precedence over the clouds' own, the default.
        units: "m", "ft" or "us-ft"; takes precedence over the unit of the CRS, the default.
        axes: order of the clouds' coordinates, a permutation of "enh" (easting, northing, height), the default.
        trajectory: the scanner's path: .csv (a header line, then time,x,y,z per line), .tum or SBET.
        pose_source: "given" uses cloud and trajectory as they are; "auto" checks whether surfaces that were scanned at
            different times agree, and corrects them if they agree clearly better then; "fused" always corrects them.
        orthophoto: GeoTIFF, or an image with a world file, in the clouds' CRS.
        footprints: building footprints, GeoJSON or GeoPackage.
        conventions: how the CSV gives poses and cameras where it isn't as documented: options of the command, such as
            `{"camera_axes": "opengl"}`.
        classes: mapping of class codes of the clouds to LAS codes, where they differ.
        name: name of the tile; default: that of its folder.
        link: symlink clouds and photos instead of copying them.
        overwrite: replace an existing tile.
        progress: show progress and warnings on the terminal.
        warn: receives the warnings; default: the terminal.
        report: receives the progress, 0 to 1, and what is done; default: the terminal.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        InputError: a file is missing or wrong, there is no CRS, or the coordinates contradict it.
        SettingError: `out` is not empty, or an option is wrong. UnavailableError: a format's library isn't installed.
    """
    from scan2sim.flows.pipelines import assembled
    from scan2sim.pipeline.pose_check.check import check_photos
    from scan2sim.pipeline.pose_check.conventions import PhotoConventions

    if isinstance(conventions, Mapping):
        conventions = PhotoConventions.of("conventions", conventions, remedy=_remedy("clouds"))
    files = [clouds] if isinstance(clouds, (str, Path)) else clouds

    def make(warn: Warn, report: Report) -> Path:
        tile = assembled.import_clouds(
            [Path(file) for file in files], Path(out).absolute(), photos=_path(photos), cameras=_path(cameras),
            images=_path(images), embedded_images=embedded_images, crs=crs, units=units, axes=axes,
            trajectory=_path(trajectory), pose_source=pose_source, orthophoto=_path(orthophoto),
            footprints=_path(footprints), conventions=conventions, classes=classes, name=name, link=link,
            overwrite=overwrite, warn=warn, report=report,
        )  # fmt: skip
        if photos is not None:
            report(1.0, CHECKING_PHOTOS)
            _pass_on(check_photos(tile), warn)
        return tile

    return _finished(make, progress, warn, report)


def import_photogrammetry(
    kind: str,
    model: str | Path,
    images: str | Path | None,
    out: str | Path,
    *,
    cloud: str | Path | None = None,
    crs: str | None = None,
    up: Up | None = None,
    scale: float = 1.0,
    gps: bool = False,
    classes: Mapping[int, int] | None = None,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    report: Report | None = None,
) -> Path:
    """Create a tile from the posed photos of a photogrammetry program: `scan2sim import colmap` and others.

    Args:
        kind: "colmap", "opensfm", "metashape", "pix4d", "bundler", "nvm" or "nerfstudio".
        model: the program's file or folder.
        images: folder of the photos; None: that of the model.
        out: folder of the tile to create.
        cloud: point cloud; default: the model's points, or those of its depth images. A cloud without a CRS is in the
            model's coordinates and is transformed with it; a cloud with a CRS stays, and the model must fit it.
        crs: target CRS of a georeferenced model (default: the cloud's, the program's, or UTM); for other models, the
            CRS of their coordinates (default: "local").
        up: direction of the model that becomes +z, or "photos" for that by which the photos were held; default: the
            model's own, if its CRS isn't known.
        scale: metres per unit of the model.
        gps: georeference the model by the GPS positions in the photos' EXIF.
        classes, name, link, overwrite, progress, warn, report: as in `import_clouds`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        InputError: a file is missing or can't be read. SettingError: `out` is not empty, or options are contradictory.
        DataError: the GPS is insufficient to georeference the model.
    """
    from scan2sim.flows.commands import option_ranges
    from scan2sim.pipeline.importers.photogrammetry import import_model
    from scan2sim.pipeline.pose_check.check import check_photos

    option_ranges.check_arguments("import_photogrammetry", scale=scale)

    def make(warn: Warn, report: Report) -> Path:
        tile = import_model(
            kind, Path(model), _path(images), Path(out).absolute(), cloud=_path(cloud), crs=crs, up=up, scale=scale,
            gps=gps, classes=classes, name=name, link=link, overwrite=overwrite, warn=warn, report=report,
        )  # fmt: skip
        if cloud is not None:
            report(1.0, CHECKING_PHOTOS)
            _pass_on(check_photos(tile, conventions=False), warn)
        return tile

    return _finished(make, progress, warn, report)


def import_kitti_raw(
    drive: str | Path,
    out: str | Path,
    *,
    poses: str | Path | None = None,
    cameras: str | Sequence[str] = ("image_02",),
    frames: tuple[int, int] | None = None,
    pose_source: PoseSource = "auto",
    max_range: float = 50.0,
    deskew: bool = True,
    vertical_angle_offset: float = 0.0,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    report: Report | None = None,
) -> Path:
    """Create a tile from a KITTI raw drive (synced and rectified), with poses that are checked against its sweeps.

    Points get the colour of the photo of their own frame, otherwise that of the nearest coloured point nearby,
    otherwise grey. Times are seconds since 1980-01-06, from the drive's time stamps.

    Args:
        drive: the `..._sync` folder, or a folder that contains exactly one; calibration files are searched in it and in
            its parent.
        out: folder of the tile to create.
        poses: row-major 3x4 matrices, one per line, scanner of sweep i to scanner of sweep 0; default: OXTS poses.
        cameras: folder of photos, or several.
        frames: first and last frame number; default: all frames.
        pose_source: "given" uses the poses as they are; "auto" checks them against the sweeps, and corrects them if
            surfaces that were scanned at different times agree clearly better then; "fused" always corrects them.
        max_range: metres; farther returns are removed (a pose error of 0.1 degrees is 9 cm at 50 m).
        deskew: transform each point by the pose of its own time; disable for sweeps that are already
            motion-compensated (such as those of KITTI odometry).
        vertical_angle_offset: degrees by which the beams are raised, to correct the scanner's calibration.
        name, link, overwrite, progress, warn, report: as in `import_clouds`.

    Returns:
        Absolute path of the `tile.toml`; `trajectory_check.json` beside it has the result of the check.

    Raises:
        InputError: a file is missing or damaged. SettingError: `out` is not empty, or no frame is selected.
        DataError: no points are within range.
    """
    from scan2sim.flows.pipelines import kitti

    make = partial(kitti.import_kitti_raw, Path(drive), deskew=deskew)
    return _kitti(
        "import_kitti_raw", make, out, progress, warn, report, cameras, max_range, vertical_angle_offset,
        poses=_path(poses), frames=frames, pose_source=pose_source, name=name, link=link, overwrite=overwrite,
    )  # fmt: skip


def import_kitti_odometry(
    sequence: str | Path,
    out: str | Path,
    *,
    poses: str | Path | None = None,
    cameras: str | Sequence[str] = ("image_2",),
    frames: tuple[int, int] | None = None,
    pose_source: PoseSource = "auto",
    max_range: float = 50.0,
    vertical_angle_offset: float = 0.0,
    labels: str | Path | None = None,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    report: Report | None = None,
) -> Path:
    """Create a tile from a KITTI odometry sequence, with poses that are checked against its sweeps.

    Args:
        sequence: folder with velodyne/, image_2/ ..., calib.txt and times.txt.
        poses: poses of camera 0, row-major 3x4, one per line; default: `poses.txt` in the sequence, or the data set's
            `../../poses/<sequence>.txt`.
        labels: folder of labels (`NNNNNN.label`) of SemanticKITTI, or predicted in its format: the points' classes.
        out, cameras, frames, pose_source, max_range, vertical_angle_offset: as in `import_kitti_raw`.
        name, link, overwrite, progress, warn, report: as in `import_clouds`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        ScanError: as `import_kitti_raw`.
    """
    from scan2sim.flows.pipelines import kitti

    make = partial(kitti.import_kitti_odometry, Path(sequence), labels=_path(labels))
    return _kitti(
        "import_kitti_odometry", make, out, progress, warn, report, cameras, max_range, vertical_angle_offset,
        poses=_path(poses), frames=frames, pose_source=pose_source, name=name, link=link, overwrite=overwrite,
    )  # fmt: skip


def import_map(
    path: str | Path,
    out: str | Path,
    trajectory: str | Path | None = None,
    *,
    name: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    report: Report | None = None,
    **options: Any,
) -> Path:
    """Create a tile from a robot's map or a textured mesh: level, z up, in metres, without outliers.

    `run` takes a map, too, and imports it with the defaults of the options.

    Args:
        path: a cloud, a folder of clouds in one frame, or a textured mesh.
        out: folder of the tile to create.
        trajectory: path of the sensor in the map's frame (.csv or .tum, with times).
        name, overwrite, progress, warn, report: as in `import_clouds`.
        options: further options of `scan2sim import map`, with underscores: `up="y"`, `units="cm"`, `images=False`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        InputError: a file is missing or damaged. SettingError: an option is wrong, or `out` is not empty.
        DataError: the map is no world: too few points, or too small.
    """
    from scan2sim.pipeline.importers.mesh_model import import_mesh
    from scan2sim.pipeline.importers.robot_map import MapParams, map_files
    from scan2sim.pipeline.importers.robot_map import import_map as import_cloud_map
    from scan2sim.pipeline.io.mesh_files import find_mesh
    from scan2sim.pipeline.robot_maps.label_colours import read_legend

    if legend := options.get("classes_from_colours"):
        options["classes_from_colours"] = read_legend(str(legend))
    params, mesh = MapParams.of("import_map", options, remedy=_remedy("map")), find_mesh(Path(path))
    given: dict[str, Any] = {"trajectory": _path(trajectory), "name": name, "overwrite": overwrite}
    target = Path(out).absolute()
    if mesh is not None:
        make = partial(import_mesh, mesh, target, params, **given)
        return _finished(make, progress, warn, report)
    return _finished(partial(import_cloud_map, map_files(Path(path)), target, params, **given), progress, warn, report)


def import_bag(
    bag: str | Path,
    out: str | Path,
    *,
    name: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    **options: Any,
) -> Path:
    """Create a tile from the sweeps, photos, calibration and poses of a ROS bag (docs/rosbag.md).

    Steps before the import, such as lidar odometry, are cached in a folder beside `out`, `OUT-recording`.

    Args:
        bag: ROS 2 bag (.mcap, .db3, or its folder) or ROS 1 bag (.bag).
        out: folder of the tile to create.
        name, overwrite, progress, warn: as in `import_clouds`.
        options: further options of `scan2sim import bag`, with underscores; those that are repeatable are lists:
            `lidar=["/points"]`, `poses="/odom"`, `max_range=30`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        InputError: the bag can't be read, or misses what is needed. SettingError: an option is wrong, or `out` is not
        empty. StepError: a step failed. UnavailableError: a package is missing.
    """
    from scan2sim.flows.pipelines import bag as pipeline

    source = pipeline.BagSource.of("import_bag", {"file": Path(bag), **options}, remedy=_remedy("bag"))
    return _recording(
        lambda: pipeline.build_graph(source, Path()), out, "recording", progress, warn, name=name, overwrite=overwrite
    )


def import_sweeps(
    sweeps: str | Path,
    out: str | Path,
    trajectory: str | Path | None = None,
    *,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    **options: Any,
) -> Path:
    """Create a tile from lidar sweeps, merged by a trajectory, GPS, or lidar odometry; optionally with photos.

    Steps before the import, such as lidar odometry, are cached in a folder beside `out`, `OUT-path`.

    Args:
        sweeps: folder of sweeps in scanner coordinates: .bin, .pcd, .ply, .las or .laz files.
        out: folder of the tile to create.
        trajectory: .csv, .tum or .kitti, z up; default: lidar odometry.
        name, link, overwrite, progress, warn: as in `import_clouds`.
        options: further options of `scan2sim import sweeps`, with underscores: `gps="track.gpx"`, `photos="photos"`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        ScanError: as `import_bag`.
    """
    from scan2sim.flows.pipelines import sweeps as pipeline

    given = {"folder": Path(sweeps), "poses": _path(trajectory), **options}
    source = pipeline.Sweeps.of("import_sweeps", given, remedy=_remedy("sweeps"))
    return _recording(
        lambda: pipeline.build_graph(source, Path(), source.poses), out, "path", progress, warn, name=name, link=link,
        overwrite=overwrite,
    )  # fmt: skip


def import_nuscenes(
    folder: str | Path,
    out: str | Path,
    *,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    **options: Any,
) -> Path:
    """Create a tile from a scene of nuScenes: its lidar sweeps, merged by its poses, and the photos of its cameras.

    Args:
        folder: folder with samples, sweeps and v1.0-mini (or v1.0-trainval, v1.0-test).
        out: folder of the tile to create; steps before the import are cached beside it, in `OUT-recording`.
        name, link, overwrite, progress, warn: as in `import_clouds`.
        options: further options of `scan2sim import nuscenes`, with underscores: `scene="scene-0061"`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        ScanError: as `import_bag`.
    """
    from scan2sim.flows.pipelines import dataset

    source = dataset.NuScenes.of("import_nuscenes", {"folder": Path(folder), **options}, remedy=_remedy("nuscenes"))
    return _recording(
        lambda: dataset.build_graph(source, Path()), out, "recording", progress, warn, name=name, link=link,
        overwrite=overwrite, conventions=False,
    )  # fmt: skip


def import_pandaset(
    folder: str | Path,
    out: str | Path,
    *,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    **options: Any,
) -> Path:
    """Create a tile from a sequence of PandaSet: its lidar sweeps, merged by its poses, and photos of its cameras.

    Args:
        folder: folder of a sequence, with lidar, camera and meta.
        out: folder of the tile to create; steps before the import are cached beside it, in `OUT-recording`.
        name, link, overwrite, progress, warn: as in `import_clouds`.
        options: further options of `scan2sim import pandaset`, with underscores: `photo_interval=0.5`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        ScanError: as `import_bag`.
    """
    from scan2sim.flows.pipelines import dataset

    source = dataset.PandaSet.of("import_pandaset", {"folder": Path(folder), **options}, remedy=_remedy("pandaset"))
    return _recording(
        lambda: dataset.build_graph(source, Path()), out, "recording", progress, warn, name=name, link=link,
        overwrite=overwrite, conventions=False,
    )  # fmt: skip


def import_images(
    photos: str | Path,
    out: str | Path,
    *,
    classes: Mapping[int, int] | None = None,
    name: str | None = None,
    link: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    warn: Warn | None = None,
    **options: Any,
) -> Path:
    """Create a tile from photos without poses, or a video: poses by COLMAP, scale and position by GPS and a cloud.

    docs/images.md describes it. Steps before the import are cached in a folder beside `out`, `OUT-photos`.

    Args:
        photos: folder of photos (one camera per subfolder), or video file.
        out: folder of the tile to create.
        classes, name, link, overwrite, progress, warn: as in `import_clouds`.
        options: further options of `scan2sim import images`, with underscores: `cloud="survey.laz"`, `gps="track.gpx"`.

    Returns:
        Absolute path of the `tile.toml`.

    Raises:
        UnavailableError: COLMAP isn't installed, or there is no cloud and no CUDA. ScanError: as `import_bag`.
    """
    from scan2sim.flows.pipelines import images
    from scan2sim.pipeline.steps.import_photos import build_tile

    source = images.Images.of("import_images", {"photos": Path(photos), **options}, remedy=_remedy("images"))
    return _after_tasks(
        lambda: images.build_graph(source, Path()), build_tile, out, "photos", progress, warn, classes=classes,
        name=name, link=link, overwrite=overwrite,
    )  # fmt: skip


def _path(text: str | Path | None) -> Path | None:
    return None if text is None else Path(text)


def _remedy(command: str) -> str:
    return f"`scan2sim import {command} --help` describes the options"


def _pass_on(warnings: Sequence[str], warn: Warn) -> None:
    for text in warnings:
        warn(text)


def _kitti(
    function: str,
    make: Callable[..., Path],
    out: str | Path,
    progress: bool,
    warn: Warn | None,
    report: Report | None,
    cameras: str | Sequence[str],
    max_range: float,
    vertical_angle_offset: float,
    **given: Any,
) -> Path:
    """Run an import of a drive of KITTI, and check its photos."""
    from scan2sim.flows.commands import option_ranges
    from scan2sim.pipeline.pose_check.check import check_photos

    numbers = {"max_range": max_range, "vertical_angle_offset": vertical_angle_offset}
    option_ranges.check_arguments(function, **numbers)
    given["cameras"] = [cameras] if isinstance(cameras, str) else cameras

    def make_and_check(warn: Warn, report: Report) -> Path:
        tile = make(Path(out).absolute(), warn=warn, report=report, **numbers, **given)
        report(1.0, CHECKING_PHOTOS)
        _pass_on(check_photos(tile, conventions=False), warn)
        return tile

    return _finished(make_and_check, progress, warn, report)


def _recording(
    graph: Callable[[], list[Task]], out: str | Path, suffix: str, progress: bool, warn: Warn | None, **given: Any
) -> Path:
    """Run an import of sweeps, and the tasks before it."""
    from scan2sim.pipeline.steps.import_sweeps import build_tile

    return _after_tasks(graph, build_tile, out, suffix, progress, warn, **given)


def _after_tasks(
    graph: Callable[[], list[Task]],
    build_tile: Callable[..., Path],
    out: str | Path,
    suffix: str,
    progress: bool,
    warn: Warn | None,
    **given: Any,
) -> Path:
    """Run an import, the last task of a graph, and those before it, cached in a folder beside `out`, `OUT-SUFFIX`."""
    from scan2sim.flows.commands import display
    from scan2sim.flows.commands.sweeps import run_before_import
    from scan2sim.pipeline.io.tile_folder import check_target

    target = Path(out).absolute()
    check_target(target, given["overwrite"])
    tasks = graph()
    with display.shown(progress):
        inputs = run_before_import(tasks, target.with_name(f"{target.name}-{suffix}"), warn or display.warn)
    return _finished(partial(build_tile, inputs, tasks[-1].params, target, **given), progress, warn, None)


def _finished(make: Callable[..., Path], progress: bool, warn: Warn | None, report: Report | None) -> Path:
    """Run an import, and report its warnings, what is implausible about the tile, and the results of checks.

    Args:
        make: makes the tile; called with `warn` and `report`.
        progress: whether anything is printed.
        warn, report: receive warnings and progress; None: the terminal.
    """
    from scan2sim.flows.commands import display
    from scan2sim.flows.commands.imported import all_warnings, summaries

    found: list[str] = []
    with display.shown(progress):
        with display.progress("import") as bar:
            tile = make(warn=found.append, report=report or bar)
        _pass_on(all_warnings(tile, found), warn or display.warn)
        for line in summaries(tile):
            display.console.print(line, highlight=False, soft_wrap=True, markup=False)
    return tile
