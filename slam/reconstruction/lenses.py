"""Lenses of photos to reconstruct: by a calibration file, by options, by EXIF, or to be solved."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.parameters import Focal, Pixels
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.core.types import Camera
from scan2sim.pipeline.io import calibration
from scan2sim.pipeline.io.camera_calibrations import file_of
from scan2sim.pipeline.io.colmap_writer import colmap_camera
from scan2sim.slam.reconstruction.colmap import Lens
from scan2sim.slam.reconstruction.photos import Photo, is_panorama

MODELS = ("auto", "pinhole", "equirectangular")
"""Camera models that can be named."""
NUMBERS = ("focal", "centre", "k1")
"""Options that describe the lens of a perspective photo."""
PERSPECTIVE = ("SIMPLE_RADIAL", "PINHOLE", "OPENCV", "FULL_OPENCV")
"""Camera models of COLMAP to which the focal length by EXIF can be compared."""
MAX_FOCAL_RATIO = 1.2
"""Ratio of a given focal length to that by EXIF, or its inverse, above which they contradict each other: EXIF has whole
millimetres, of photos that aren't cropped."""


class LensParams(Params):
    """Lenses of the photos."""

    camera: str = Field(
        "auto",
        description="Camera model: equirectangular, pinhole, or auto (by the photos' shape and content); or a file: "
        "TOML as in a tile, or the calibration of another program (docs/inputs.md), whose lens is kept.",
    )
    focal: Focal | None = Field(
        None, description="Focal length in pixels, which is kept; default: from EXIF and refined, or solved."
    )
    centre: tuple[Pixels, Pixels] | None = Field(
        None, description="Principal point in pixels; default: the image centre."
    )
    k1: Annotated[float, Field(ge=-1, le=1)] | None = Field(
        None, description="Radial distortion k1 (OpenCV model); default: solved, or 0 if --focal is given."
    )
    refine_lens: bool = Field(
        False, description="Refine the focal length and distortion given by --camera FILE or --focal."
    )

    @property
    def camera_file(self) -> Path | None:
        """File of the cameras, if `camera` names a file and not a camera model."""
        return file_of(self.camera)


def check_options(params: LensParams) -> None:
    """Raise a SettingError if options contradict each other, or the camera model is unknown."""
    file = params.camera_file is not None
    if not file and params.camera not in MODELS:
        raise SettingError("--camera", f"unknown model {params.camera!r}", f"Use {', '.join(MODELS)}, or a file")
    panorama = params.camera == "equirectangular"
    for name in NUMBERS:
        if getattr(params, name) is not None and (file or panorama):
            beside = "a file with the camera" if file else "--camera equirectangular, which has no lens"
            raise SettingError(f"--{name}", f"is given beside {beside}", "Leave one of them out")
    if params.refine_lens and not file and params.focal is None:
        raise SettingError("--refine-lens", "there is no lens to refine", "Give --camera or --focal, or leave it out")


def by_camera(photos: Sequence[Photo]) -> list[list[Photo]]:
    """Photos of each camera."""
    groups: dict[object, list[Photo]] = defaultdict(list)
    for photo in photos:
        groups[photo.camera].append(photo)
    return list(groups.values())


def lenses(
    source: Path, photos: Sequence[Photo], params: LensParams, file: Path | None = None, images: Path | None = None
) -> list[Lens]:
    """Lens of each camera (of `by_camera`).

    Args:
        source: folder of the photos, or video.
        photos: the photos.
        params: options.
        file: calibration file of the cameras, or None.
        images: folder of the photos, or of the video's frames; None: not yet extracted.

    Raises:
        InputError: the file can't be read, or has no camera for some photos, or several that differ; or photos show
            fisheye circles.
        SettingError: an option doesn't apply to all photos.
    """
    groups = by_camera(photos)
    if file is not None:
        cameras = _calibrated(source, groups, file)
        return [_of_camera(camera, fixed=not params.refine_lens) for camera in cameras]
    _check_sizes(photos, params)
    return [_panorama(group[0], params, images) or _lens(group, params) for group in groups]


def _of_camera(camera: Camera, *, fixed: bool) -> Lens:
    return Lens(*colmap_camera(camera), fixed=fixed or camera.model == "equirectangular")


def _panorama(photo: Photo, params: LensParams, images: Path | None) -> Lens | None:
    """Camera of a panorama, by the option or by what it shows; None: a perspective photo."""
    if params.camera == "equirectangular":
        if photo.width != 2 * photo.height:
            cause = f"equirectangular: {photo.name} is {photo.width}x{photo.height}, not twice as wide as high"
            raise SettingError("--camera", cause, "Export whole panoramas, or give --camera pinhole or a file")
    elif (
        images is None
        or params.camera == "pinhole"
        or any(getattr(params, name) is not None for name in NUMBERS)
        or not is_panorama(images / photo.name, photo)
    ):
        return None
    return _of_camera(Camera("equirectangular", photo.width, photo.height), fixed=True)


def contradictions(photos: Sequence[Photo], found: Sequence[Lens]) -> list[str]:
    """Warnings about given lenses whose focal length isn't that of the photos' EXIF."""
    warnings = []
    for group, lens in zip(by_camera(photos), found, strict=True):
        exif = group[0].focal
        if exif is None or not lens.params or lens.model not in PERSPECTIVE:
            continue
        ratio = lens.params[0] / exif
        if max(ratio, 1 / ratio) > MAX_FOCAL_RATIO:
            warnings.append(
                f"by EXIF, the focal length of {_named(group)} is {exif:.0f} pixels, but the given one is "
                f"{lens.params[0]:.0f}: check that it is in pixels of these photos, and whether they were scaled, "
                "cropped or zoomed"
            )
    return warnings


def _lens(group: Sequence[Photo], params: LensParams) -> Lens:
    """Lens of a camera by the options, or by EXIF."""
    photo = group[0]
    if params.focal is None and photo.focal is None:
        for name in ("centre", "k1"):
            if getattr(params, name) is not None:
                cause = f"needs a focal length, which {_named(group)} doesn't have in its EXIF"
                raise SettingError(f"--{name}", cause, "Give --focal (pixels), or a file with the camera (--camera)")
        return Lens()
    x, y = params.centre or ((photo.width - 1) / 2, (photo.height - 1) / 2)
    focal = params.focal or photo.focal
    assert focal is not None
    fixed = params.focal is not None and not params.refine_lens
    return Lens("SIMPLE_RADIAL", (focal, x + 0.5, y + 0.5, params.k1 or 0.0), fixed)


def _check_sizes(photos: Sequence[Photo], params: LensParams) -> None:
    """Raise a SettingError if numbers in pixels are given for photos of different sizes."""
    turned = params.centre is None  # the focal length is the same, but not the centre
    found: dict[tuple[int, ...], Photo] = {}
    for photo in photos:
        size = (photo.width, photo.height)
        found.setdefault(tuple(sorted(size)) if turned else size, photo)
    option = "--focal" if params.focal is not None else "--centre"
    if len(found) > 1 and not (params.focal is None and params.centre is None):
        sizes = ", ".join(f"{one.width}x{one.height}: {one.name}" for one in list(found.values())[:3])
        raise SettingError(
            option, f"is in pixels of one image size, but the photos have {len(found)} sizes ({sizes})",
            "Give --camera FILE with a camera of each size, or photos of one size",
        )  # fmt: skip


def _calibrated(source: Path, groups: Sequence[Sequence[Photo]], file: Path) -> list[Camera]:
    """Camera of each group of photos by a file, whose cameras are told apart by size and by the photos' folders."""
    found = []
    for group in groups:
        size = (group[0].width, group[0].height)
        names = _folders(group[0]) or (source.resolve().stem if source.is_file() else source.resolve().name,)
        camera = calibration.read_camera(file, *size, names=names, photos=_named(group))
        if camera.model == "orthographic":
            cause = f"its camera of {_named(group)} is orthographic, which can't be reconstructed"
            raise InputError(file, cause, "Give the file of the photos' camera")
        found.append(camera)
    _check_folders(groups, file)
    return found


def _check_folders(groups: Sequence[Sequence[Photo]], file: Path) -> None:
    """Raise an InputError if cameras of a file are named like some of the photos' folders, but not like others."""
    known: Mapping[bool, list[str]] = {True: [], False: []}
    for group in groups:
        folders = _folders(group[0])
        ids = calibration.camera_names(file, group[0].width, group[0].height)
        if folders:
            known[not ids.isdisjoint(folders)].append("/".join(folders))
    if known[True] and known[False]:
        cause = f"has cameras for the folders {_listed(known[True])}, but none for {_listed(known[False])}"
        raise InputError(file, cause, "Add one with the folder's name as its id, or import the other folders alone")


def _folders(photo: Photo) -> tuple[str, ...]:
    return tuple(photo.name.split("/")[:-1])


def _listed(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(names))


def _named(group: Sequence[Photo]) -> str:
    """Text that names photos in a message."""
    more = len(group) - 1
    return group[0].name + (f" and {more} other photo{'s' if more > 1 else ''}" if more else "")
