"""Pose refinement step (`pose_refinement`): adjusts poses and lenses of the photos to each other and to the surface.

Corners of every photo are matched in its neighbours via the surface of the meshes
(`texturing.pose_refinement.matches`). All poses are then estimated by a bundle adjustment with one correction per
photo, one per camera and the lens of each camera, constrained by the surface and by the expected errors of poses and
calibration (`texturing.pose_refinement.bundle_adjustment`). Photos held out of texturing don't contribute: they get
their camera's correction, and one interpolated between the neighbouring photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.camera.lens import GIVEN_SIGMA
from scan2sim.pipeline.core.parameters import Distance
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, I64, Bools, Camera, Mesh, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.photo_consistency import PhotoConsistencyParams, neighbours

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap, Scene
    from scan2sim.texturing.pose_refinement.bundle_adjustment import Corrections, Priors
    from scan2sim.texturing.pose_refinement.matches import GreyPhoto, Matches

    Numbers = I64

COMPARED_PIXELS_MAX = 500_000
"""Photos are compared at this size at most; "compared pixels" are pixels at this size."""
NEIGHBOUR_PHOTOS = 6
"""Photos in which the corners of each photo are searched."""
MAX_ROUNDS = 3
"""Rounds of matching and solving; each renders the depth maps again at the current poses."""
ROUND_GAIN_MIN_PX = 1.0
"""Decrease of the median displacement in a round, compared pixels, below which no further round follows."""
MIN_MATCHES = 200
"""Matches below which poses are not refined."""
MAX_CORRECTION_SIGMAS = 4.0
"""Corrections beyond this multiple of the expected error are rejected."""
DEPTH_MAP_SCALE = 0.5
"""Resolution of the depth maps relative to the photos: planes are fitted over several pixels."""
MOVABLE_MARGIN_PX, MOVABLE_DEPTH_TOLERANCE_M = 3, 0.5
"""Pixels of the depth map around movable objects that are not used, and metres that an object may lie behind the
surface and still count as visible."""
MIN_GAIN_PX = 0.1
"""Smallest decrease of the median displacement, in pixels of photos scaled to 0.5 MP, for poses to be changed."""


class PoseRefinementParams(Params):
    """Settings of the pose refinement: expected errors of the poses (standard deviations), and when to correct them.

    Attributes:
        when: "auto": if there are photos taken from the ground; "never": keep the given poses.
        shift: expected error of a photo's position in metres.
        rotation: expected error of a photo's rotation in milliradians.
        camera_shift: expected error of a camera's position on the vehicle in metres.
        camera_rotation: expected error of a camera's rotation on the vehicle in milliradians.
        lens: also estimate focal length and radial distortion (k1, k2) of each camera with a pinhole or OpenCV model.
        correlation_length: metres of path over which the error of the photos' poses decorrelates.
        corners: maximum number of corners of a photo that are matched in other photos.
        max_distance: metres from the camera beyond which surface points are not used.
    """

    when: Literal["auto", "never"] = "auto"
    shift: Distance = 0.05
    rotation: float = Field(3.0, gt=0, le=200)
    camera_shift: Distance = 0.05
    camera_rotation: float = Field(5.0, gt=0, le=200)
    lens: bool = True
    correlation_length: Distance = 10.0
    corners: int = Field(600, ge=50, le=20_000)
    max_distance: Distance = 40.0


def pose_refinement(inputs: Inputs, params: PoseRefinementParams, out: Path, report: Report) -> Done:
    """Refine the poses of `views` on the surface `mesh.*`, except where movable objects (`cloud.*`, `moving`) hide it.

    Files: `views` and `cameras`, with refined poses and lenses, or unchanged if refinement gains too little. Metrics:
    `matches`, their number; `displaced_px` and `displaced_after_px`, median displacements; `moved`, whether poses were
    changed; `cameras` and `photos`, the correction of each.
    """
    from scan2sim.texturing.pose_refinement import bundle_adjustment

    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    index = [i for i, view in enumerate(views) if view.camera.model != "orthographic"]
    photos = [views[i] for i in index]
    names, camera = group_by_camera(photos)
    poses = np.array([view.T_world_cam for view in photos], np.float64).reshape(-1, 4, 4)  # also for no photos
    grey_photos = _grey_photos(photos, [k for k, i in enumerate(index) if not held[i]])
    surface, movable = _surface(inputs)
    cameras = [compared_camera(view.camera) for view in photos]
    priors = _priors(params)
    now, first, found = _refined(photos, camera, grey_photos, surface, movable, params, priors, report)
    warnings = _implausible_lenses(now, names)
    if warnings:
        priors = replace(priors, lens=np.zeros(5))
        now, first, found = _refined(photos, camera, grey_photos, surface, movable, params, priors, report)
    now, more_warnings = _plausible(now, names, [view.name for view in photos], priors)
    at = now.apply(poses, camera)
    after = bundle_adjustment.displacement(found, now.lenses(cameras, camera), at)
    moved = (
        len(after) >= MIN_MATCHES and bool(np.any(at != poses)) and _median(first[1]) - _median(after) >= MIN_GAIN_PX
    )
    if moved:
        lenses = now.lenses([view.camera for view in photos], camera)
        for i, T, lens in zip(index, at, lenses, strict=True):
            views = (*views[:i], replace(views[i], T_world_cam=T, camera=lens), *views[i + 1 :])
    files = views_io.save_linked(out, views, held)
    metrics: dict[str, Any] = {"photos": len(photos), "matches": len(first[1]), "moved": moved}
    if len(first[1]):
        metrics |= {"displaced_px": round(_median(first[1]), 3)}
    if moved:
        metrics |= {"displaced_after_px": round(_median(after), 3)}
        metrics |= _correction_metrics(now, names, photos, *_by_photo(first, (found, after), photos, cameras))
    return Done(files, metrics, [*warnings, *more_warnings] if moved else warnings)


def _refined(
    photos: Sequence[View],
    camera: Numbers,
    grey_photos: dict[int, GreyPhoto],
    surface: Scene,
    movable: Scene,
    params: PoseRefinementParams,
    priors: Priors,
    report: Report,
) -> tuple[Corrections, tuple[Matches, F64], Matches]:
    """Corrections, the first matches with their displacements (N,), and the last matches."""
    from scan2sim.texturing.pose_refinement import bundle_adjustment

    poses = np.array([view.T_world_cam for view in photos], np.float64).reshape(-1, 4, 4)  # also for no photos
    given = [compared_camera(view.camera) for view in photos]
    order = bundle_adjustment.capture_order(poses[:, :3, 3], [view.time for view in photos])
    now = bundle_adjustment.Corrections.none(len(photos), int(camera.max(initial=-1)) + 1)
    first: tuple[Matches, F64] | None = None
    for turn in range(MAX_ROUNDS):
        at, lenses = now.apply(poses, camera), now.lenses(given, camera)
        posed = [replace(view, T_world_cam=T) for view, T in zip(photos, at, strict=True)]
        report(turn / MAX_ROUNDS, "matching")
        found = _matched(posed, lenses, grey_photos, surface, movable, params)
        before = bundle_adjustment.displacement(found, lenses, at)
        first = first or (found, before)
        if len(before) < MIN_MATCHES or _median(before) <= MIN_GAIN_PX:
            break
        report((turn + 0.8) / MAX_ROUNDS, "solving")
        now = bundle_adjustment.solve(found, given, poses, now, camera, order, priors)
        after = bundle_adjustment.displacement(found, now.lenses(given, camera), now.apply(poses, camera))
        if _median(before) - _median(after) < ROUND_GAIN_MIN_PX:
            break
    assert first is not None
    return now, first, found


def group_by_camera(views: Sequence[View]) -> tuple[list[str], Numbers]:
    """Names of the cameras, and (V,) index of each view's camera: photos of one camera have one model and one folder.

    The cameras of a stereo pair have the same model, but their photos are in different folders.
    """
    keys = [(view.camera, view.name.rpartition("/")[0]) for view in views]
    known = list(dict.fromkeys(keys))
    names = [folder or f"{camera.model} {camera.width} x {camera.height}" for camera, folder in known]
    unique = [f"{name} ({k + 1})" if names.count(name) > 1 else name for k, name in enumerate(names)]
    return unique, np.array([known.index(key) for key in keys], np.int64)


def compared_camera(camera: Camera) -> Camera:
    """The camera scaled to the size at which photos are compared."""
    return camera.scaled(min(1.0, (COMPARED_PIXELS_MAX / (camera.width * camera.height)) ** 0.5))


def _median(values: F64) -> float:
    return float(np.nanmedian(values)) if len(values) else 0.0


def _priors(params: PoseRefinementParams) -> Priors:
    from scan2sim.texturing.pose_refinement.bundle_adjustment import Priors

    return Priors(
        params.shift,
        params.rotation / 1000,
        params.camera_shift,
        params.camera_rotation / 1000,
        params.correlation_length,
        GIVEN_SIGMA if params.lens else np.zeros(5),
    )


def _grey_photos(photos: Sequence[View], used: Sequence[int]) -> dict[int, GreyPhoto]:
    """Readable photos by index; the steps that texture with the photos warn about the others."""
    from scan2sim.texturing.photo_cache import PhotoCache
    from scan2sim.texturing.pose_refinement.matches import grey_photo

    masks = PhotoCache(photos)
    out = {}
    for k in used:
        rgb, mask = image.usable_photo(photos[k]), masks.mask(k)
        if rgb is not None and mask is not None:
            out[k] = grey_photo(rgb, mask, compared_camera(photos[k].camera))
    return out


def _surface(inputs: Inputs) -> tuple[Scene, Scene]:
    """Scene of all meshes, and scene of the clouds' movable objects."""
    from scan2sim.pipeline.camera import depth_map as kernel

    meshes = [Mesh.load(path) for name, path in inputs.items() if name.startswith("mesh.")]
    clouds = [PointCloud.load(path) for name, path in inputs.items() if name.startswith("cloud.")]
    cloud = PointCloud.join(clouds) if clouds else None
    if cloud is not None and cloud.classification is not None:
        cloud = cloud.take(np.isin(cloud.classification, kernel.MOVABLE))
    moving = PointCloud.load(inputs["moving"]) if "moving" in inputs else None
    return kernel.scene(meshes), kernel.scene([], cloud, moving=moving)


def _matched(
    photos: Sequence[View],
    cameras: Sequence[Camera],
    grey_photos: dict[int, GreyPhoto],
    surface: Scene,
    movable: Scene,
    params: PoseRefinementParams,
) -> Matches:
    """Matches between all photos at their current poses."""
    import cv2

    from scan2sim.pipeline.camera import depth_map as kernel
    from scan2sim.texturing.pose_refinement.matches import matches

    def rendered(k: int, scene: Scene) -> DepthMap:
        camera = cameras[k]
        size = round(DEPTH_MAP_SCALE**2 * camera.width * camera.height)
        return kernel.depth_map(camera, photos[k].T_world_cam, scene, time=photos[k].time, pixels=size)

    maps = {k: rendered(k, surface) for k in grey_photos}
    static = {}
    for k, photo in grey_photos.items():
        if len(movable.centres):
            is_movable = rendered(k, movable).range <= maps[k].range + MOVABLE_DEPTH_TOLERANCE_M
            dilated = cv2.dilate(is_movable.astype(np.uint8), np.ones((2 * MOVABLE_MARGIN_PX + 1,) * 2))
            size = (cameras[k].width, cameras[k].height)
            is_static = np.asarray(cv2.resize(dilated, size, interpolation=cv2.INTER_NEAREST)) == 0
            photo = replace(photo, usable=photo.usable & is_static)
        static[k] = replace(photo, camera=cameras[k])
    settings = PhotoConsistencyParams(max_shift=0, neighbours=NEIGHBOUR_PHOTOS, max_distance=params.max_distance)
    small_views = [replace(view, camera=camera) for view, camera in zip(photos, cameras, strict=True)]
    nearest = neighbours(small_views, list(grey_photos), maps.__getitem__, settings)
    return matches(
        small_views, static, maps.__getitem__, nearest, count=params.corners, max_distance=params.max_distance
    )


def _implausible_lenses(found: Corrections, cameras: Sequence[str]) -> list[str]:
    """Warnings about lenses that changed implausibly much."""
    bad = (np.abs(found.lens) > MAX_CORRECTION_SIGMAS * GIVEN_SIGMA).any(axis=1)
    return [
        f"{cameras[k]}: estimated lens, with a focal length changed by {100 * np.expm1(found.lens[k, 0]):.1f} %, is "
        "implausibly different from the given one and was rejected; check the camera's calibration"
        for k in np.flatnonzero(bad).tolist()
    ]


def _plausible(
    found: Corrections, cameras: Sequence[str], photos: Sequence[str], priors: Priors
) -> tuple[Corrections, list[str]]:
    """Corrections with implausibly large ones set to zero, and warnings about those."""

    def beyond(rows: F64, turn: float, shift: float) -> Bools:
        turned, shifted = np.linalg.norm(rows[:, :3], axis=1), np.linalg.norm(rows[:, 3:], axis=1)
        limit = MAX_CORRECTION_SIGMAS
        return np.asarray((turned > limit * turn) | (shifted > limit * shift))

    bad_camera = beyond(found.camera, priors.camera_turn, priors.camera_shift)
    bad_photo = beyond(found.photo, priors.turn, priors.shift)
    warnings = []
    for names, rows, bad, prefix in (
        (cameras, found.camera, bad_camera, "camera_"),
        (photos, found.photo, bad_photo, ""),
    ):
        for k in np.flatnonzero(bad).tolist():
            row = _magnitude(rows[k])
            warnings.append(
                f"{names[k]}: estimated pose correction of {row['shift_cm']:.0f} cm and {row['turn_mrad']:.0f} mrad is "
                f"implausibly large and was rejected; check the pose, or increase `pose_refinement.{prefix}shift` and "
                f"`pose_refinement.{prefix}rotation`"
            )
    return replace(
        found,
        photo=np.where(bad_photo[:, None], 0.0, found.photo),
        camera=np.where(bad_camera[:, None], 0.0, found.camera),
    ), warnings


def _by_photo(
    first: tuple[Matches, F64], last: tuple[Matches, F64], photos: Sequence[View], cameras: Sequence[Camera]
) -> tuple[dict[int, float], dict[int, float]]:
    """Median displacement of each photo in its own pixels, before and after."""

    def medians(found: Matches, displacement: F64) -> dict[int, float]:
        scale = [view.camera.width / camera.width for view, camera in zip(photos, cameras, strict=True)]
        return {int(k): _median(displacement[found.view == k]) * scale[k] for k in np.unique(found.view)}

    return medians(*first), medians(*last)


def _magnitude(correction: F64) -> dict[str, float]:
    return {
        "shift_cm": round(100 * float(np.linalg.norm(correction[3:])), 2),
        "turn_mrad": round(1000 * float(np.linalg.norm(correction[:3])), 2),
    }


def _correction_metrics(
    applied: Corrections,
    cameras: Sequence[str],
    photos: Sequence[View],
    before: dict[int, float],
    after: dict[int, float],
) -> dict[str, Any]:
    """Metrics: corrections of the cameras (right, down, forward; lens) and magnitudes of the photos' corrections."""
    rows = {}
    for k, view in enumerate(photos):
        rows[view.name] = _magnitude(applied.photo[k])
        if k in before and k in after:
            rows[view.name] |= {"displaced_px": round(before[k], 2), "displaced_after_px": round(after[k], 2)}
    by_camera = {
        name: {
            "shift_cm": (100 * row[3:]).round(2).tolist(),
            "turn_mrad": (1000 * row[:3]).round(2).tolist(),
            "focal_change_percent": round(100 * float(np.expm1(lens[0])), 3),
            "k1_change": round(float(lens[3]), 4),
            "k2_change": round(float(lens[4]), 4),
        }
        for name, row, lens in zip(cameras, applied.camera, applied.lens, strict=True)
    }
    shift, turn = (max(row[key] for row in rows.values()) for key in ("shift_cm", "turn_mrad"))
    return {"largest_shift_cm": shift, "largest_turn_mrad": turn, "cameras": by_camera, "photos": rows}


POSE_REFINEMENT = Step("pose_refinement", 4, pose_refinement, PoseRefinementParams)
