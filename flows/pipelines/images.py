"""Pipeline definition of unposed photos: reconstruction, alignment with a cloud or dense stereo, and import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from scan2sim.flows.pipelines.graph import Output, Task, TaskId, folder_inputs
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.optional_deps import require
from scan2sim.pipeline.core.step import Params, Step
from scan2sim.pipeline.io import clouds as cloud_io
from scan2sim.pipeline.io.geodata import crs as crs_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.steps.import_photos import IMPORT_PHOTOS, ImportPhotosContext, ImportPhotosParams
from scan2sim.slam.reconstruction import colmap
from scan2sim.slam.reconstruction.lenses import NUMBERS, check_options, lenses
from scan2sim.slam.reconstruction.photos import check_count, list_photos, no_photos, read_headers
from scan2sim.slam.reconstruction.positions import check_sources
from scan2sim.slam.steps.dense_stereo import DENSE_STEREO, DenseStereoParams
from scan2sim.slam.steps.place_photos import PLACE_PHOTOS, PlaceContext, Placed, PlaceParams
from scan2sim.slam.steps.reconstruct import RECONSTRUCT, Reconstructed, can_reconstruct

STEPS: tuple[Step, ...] = (RECONSTRUCT, PLACE_PHOTOS, DENSE_STEREO, IMPORT_PHOTOS)


class Images(DenseStereoParams, Placed, Reconstructed):
    """Photos or a video, and related files: the options of `scan2sim import images`."""

    photos: Path = Field(description="Folder of photos (one camera per subfolder), or video file.")
    cloud: Path | None = Field(
        None, description="Point cloud of the place; default: dense stereo of the photos, which needs CUDA."
    )
    gps: Path | None = Field(
        None, description="GPS track: GPX, NMEA, CSV, or a GoPro video; default: the GPS in the photos' EXIF."
    )
    positions: Path | None = Field(
        None,
        description="Instead of GPS: CSV file,x,y,z with rough positions of three photos or more in the cloud's "
        "coordinates.",
    )
    times: Path | None = Field(
        None, description="Text file with the times of the photos: seconds, one per line; default: EXIF."
    )
    crs: str | None = Field(
        None, description='CRS of the cloud, such as "EPSG:32633" or "local"; default: its own; without a cloud, UTM.'
    )


def build_graph(source: Images, here: Path) -> list[Task]:
    """The task graph that makes a tile of unposed photos; what is missing is reported before any task runs.

    Args:
        source: photos and related files; paths are relative to `here`.
        here: folder.

    Raises:
        ScanError: photos, positions or the CRS are missing, or COLMAP isn't installed.
    """
    lens: Reconstructed = _shared(Reconstructed, source)
    can_reconstruct(lens)
    check_options(lens)
    photos, is_video = here / source.photos, (here / source.photos).is_file()
    if is_video:
        require("a video", "av")
    if source.gps is not None and source.positions is not None:
        raise SettingError("--gps, --positions", "are both given", "Give one of them")
    if is_video and source.times is not None:
        raise SettingError("--times", "is only for a folder of photos; a video has its own times", "Leave it out")
    if not is_video:
        names = list_photos(photos)
        if not names:
            raise no_photos(photos)
        image.check_decoders(photos / name for name in names)
        check_count(photos, names)
    given = {name: getattr(source, name) for name in ("gps", "positions", "times", "cloud")}
    files: dict[str, Path] = {name: here / path for name, path in given.items() if path is not None}
    cloud = files.get("cloud")
    crs = source.crs or (None if cloud is None else cloud_io.read_header(cloud).crs)
    placed = check_sources(photos, **files, crs=crs, offset=source.gps_offset)
    if cloud is not None and crs is None:
        crs = crs_io.LOCAL

    described = {name: path for name, path in files.items() if name == "times"}
    if lens.camera_file is not None:
        described["camera"] = here / lens.camera_file
        lens = lens.model_copy(update={"camera": "auto"})
    if "camera" in described or lens.camera != "auto" or any(getattr(lens, name) is not None for name in NUMBERS):
        lenses(photos, read_headers(photos), lens, described.get("camera"))
    tasks = [Task(RECONSTRUCT, lens, {**folder_inputs("photos", photos), **described})]
    made = TaskId(RECONSTRUCT.name)
    images: dict[str, Path | Output] = {**folder_inputs("images", photos)}
    if is_video:
        images = {"images": Output(made, "frames")}
    shots = {name: Output(made, name) for name in ("model", "photos", "summary")} | images
    beside = {name: path for name, path in files.items() if name != "times"}
    video = {"video": photos} if is_video else {}
    params = PlaceParams(**dict(_shared(Placed, source)), context=PlaceContext(crs=crs))
    tasks.append(Task(PLACE_PHOTOS, params, {**shots, **beside, **video}))
    posed = TaskId(PLACE_PHOTOS.name)
    surface: dict[str, Path | Output] = {} if cloud is None else {"cloud": cloud}
    if cloud is None and placed and colmap.has_cuda():
        inputs = {"path": Output(posed, "path"), "frame": Output(posed, "frame"), **images}
        tasks.append(Task(DENSE_STEREO, _shared(DenseStereoParams, source), inputs))
        surface = {"cloud": Output(TaskId(DENSE_STEREO.name), "cloud")}
    importing = ImportPhotosParams(context=ImportPhotosContext(crs=crs))
    tasks.append(Task(IMPORT_PHOTOS, importing, {"table": Output(posed, "table"), **images, **surface}))
    return tasks


def _shared(model: type[Params], source: Images) -> Any:
    """Parameters of a step among the options."""
    return model(**{name: getattr(source, name) for name in model.model_fields})
