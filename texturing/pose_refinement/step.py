"""Refine: the photos' poses, so that all of them show the same place of the surface at the same place.

Corners of every photo are found again in those around it (`texturing.pose_refinement.matches`), over the surface that
the meshes are;
poses are then solved for all at once, with one correction a camera, held by the surface and by how wrong
poses can be (`texturing.pose_refinement.bundle_adjustment`). Photos that are held out of texturing move nobody: they
take their camera's correction, and between their neighbours' own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from scan2sim.pipeline.core.parameters import Reach
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, I64, Bools, Camera, Mesh, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.texturing.photo_consistency import AgreementParams, neighbours

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.depth_map import DepthMap, Scene
    from scan2sim.texturing.pose_refinement.bundle_adjustment import Corrections, Priors
    from scan2sim.texturing.pose_refinement.matches import Matches, Picture

    Numbers = I64

PIXELS = 500_000
"""Photos are compared at this size at most."""
AROUND = 6
"""Photos in which each one's corners are looked for."""
ROUNDS = 3
"""Depth maps are drawn anew so often, at most, where poses moved."""
MOVED = 1.0
"""Pixels, median, that a round must have moved what is seen for another to follow."""
FEW = 200
"""Matches below which nothing is said."""
BOUND = 4.0
"""A correction beyond so many times what is expected is not believed."""
COARSE = 0.5
"""Width of the depth maps against the pictures': planes are fitted over several pixels."""
MARGIN, BEFORE = 3, 0.5
"""Pixels of the depth map about what can move that aren't asked, and metres that it may lie behind what hides it."""


class RefineParams(Params):
    """How wrong poses are expected to be, and from when on it matters.

    Attributes:
        when: "auto": where there are photos from the ground; "never": poses stay as they were given.
        worth: pixels (of photos scaled to 0.5 MP) by which their median displacement must fall for poses to be moved.
        shift: metres by which a photo's place is expected to be wrong.
        turn: milliradians likewise.
        camera_shift: metres by which a camera's place on the vehicle is.
        camera_turn: milliradians likewise.
        wander: metres of the path over which the photos' error becomes another one.
        corners: of a photo that are matched in others.
        max_distance: metres beyond which the surface isn't asked.
    """

    when: Literal["auto", "never"] = "auto"
    worth: float = Field(0.1, ge=0, le=100)
    shift: Reach = 0.05
    turn: float = Field(3.0, gt=0, le=200)
    camera_shift: Reach = 0.05
    camera_turn: float = Field(5.0, gt=0, le=200)
    wander: Reach = 10.0
    corners: int = Field(600, ge=50, le=20_000)
    max_distance: Reach = 40.0


def refine(inputs: Inputs, params: RefineParams, out: Path, report: Report) -> Done:
    """Refine the poses of `views` over the surface `mesh.*`, apart from what can move of `cloud.*`, and `moving`.

    File: `views`, as it was but for poses; those to the last bit where nothing is to be gained. Facts: `matches`;
    `displaced_px` and `displaced_after_px`, medians over them; whether poses were `moved`; `cameras` and `photos`, what
    each was moved by.
    """
    from scan2sim.texturing.pose_refinement import bundle_adjustment

    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    index = [i for i, view in enumerate(views) if view.camera.model != "orthographic"]
    photos = [views[i] for i in index]
    names, camera = lenses(photos)
    poses = np.array([view.T_world_cam for view in photos], np.float64).reshape(-1, 4, 4)  # none where none can be read
    cameras = [small(view.camera) for view in photos]
    pictures = _pictures(photos, [k for k, i in enumerate(index) if not held[i]])
    surface, movable = _surface(inputs)
    order = bundle_adjustment.chain(poses[:, :3, 3], [view.time for view in photos])
    now = bundle_adjustment.Corrections(np.zeros((len(photos), 6)), np.zeros((len(names), 6)))
    first: tuple[Matches, F64] | None = None
    for turn in range(ROUNDS):
        at = now.apply(poses, camera)
        posed = [replace(view, T_world_cam=T) for view, T in zip(photos, at, strict=True)]
        report(turn / ROUNDS, "matching")
        found = _matched(posed, cameras, pictures, surface, movable, params)
        off = bundle_adjustment.displacement(found, cameras, at)
        first = first or (found, off)
        if len(off) < FEW or _median(off) <= params.worth:
            break
        report((turn + 0.8) / ROUNDS, "solving")
        now = bundle_adjustment.solve(found, cameras, poses, now, camera, order, _priors(params))
        left = bundle_adjustment.displacement(found, cameras, now.apply(poses, camera))
        if _median(off) - _median(left) < MOVED:
            break
    assert first is not None
    now, warnings = _believed(now, names, [view.name for view in photos], _priors(params))
    at = now.apply(poses, camera)
    left = bundle_adjustment.displacement(found, cameras, at)
    moved = len(left) >= FEW and bool(np.any(at != poses)) and _median(first[1]) - _median(left) >= params.worth
    if moved:
        for i, T in zip(index, at, strict=True):
            views = (*views[:i], replace(views[i], T_world_cam=T), *views[i + 1 :])
    links = [views_io.linked(view, out, i) for i, view in enumerate(views)]
    views_io.save(out / "views.json", links, held)
    facts: dict[str, Any] = {"photos": len(photos), "matches": len(first[1]), "moved": moved}
    if len(first[1]):
        facts |= {"displaced_px": round(_median(first[1]), 3)}
    if moved:
        facts |= {"displaced_after_px": round(_median(left), 3)}
        facts |= _figures(now, names, photos, *_by_photo(first, (found, left), photos, cameras))
    return Done({"views": out / "views.json"}, facts, warnings if moved else [])


def lenses(views: Sequence[View]) -> tuple[list[str], Numbers]:
    """The names of the cameras that photos are of, and (V,) the index of each one's: one model, photos of one folder.

    Photos of a stereo pair have the same model, and a folder each.
    """
    keys = [(view.camera, view.name.rpartition("/")[0]) for view in views]
    known = list(dict.fromkeys(keys))
    names = [folder or f"{camera.model} {camera.width} x {camera.height}" for camera, folder in known]
    unique = [f"{name} ({k + 1})" if names.count(name) > 1 else name for k, name in enumerate(names)]
    return unique, np.array([known.index(key) for key in keys], np.int64)


def small(camera: Camera) -> Camera:
    """The camera of the size at which photos are compared."""
    return camera.scaled(min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5))


def _median(values: F64) -> float:
    return float(np.nanmedian(values)) if len(values) else 0.0


def _priors(params: RefineParams) -> Priors:
    from scan2sim.texturing.pose_refinement.bundle_adjustment import Priors

    return Priors(params.shift, params.turn / 1000, params.camera_shift, params.camera_turn / 1000, params.wander)


def _pictures(photos: Sequence[View], used: Sequence[int]) -> dict[int, Picture]:
    """Those that can be read, by index; what can't is told by the steps that paint with it."""
    from scan2sim.texturing.photo_cache import Photos
    from scan2sim.texturing.pose_refinement.matches import picture

    masks = Photos(photos)
    out = {}
    for k in used:
        rgb, mask = image.usable_photo(photos[k]), masks.mask(k)
        if rgb is not None and mask is not None:
            out[k] = picture(rgb, mask, small(photos[k].camera))
    return out


def _surface(inputs: Inputs) -> tuple[Scene, Scene]:
    """The meshes, all of them, and what can move of the clouds."""
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
    pictures: dict[int, Picture],
    surface: Scene,
    movable: Scene,
    params: RefineParams,
) -> Matches:
    """Matches of all pictures, at the photos' poses."""
    import cv2

    from scan2sim.pipeline.camera import depth_map as kernel
    from scan2sim.texturing.pose_refinement.matches import matches

    def drawn(k: int, scene: Scene) -> DepthMap:
        camera = cameras[k]
        size = round(COARSE**2 * camera.width * camera.height)
        return kernel.depth_map(camera, photos[k].T_world_cam, scene, time=photos[k].time, pixels=size)

    maps = {k: drawn(k, surface) for k in pictures}
    stands = {}
    for k, picture in pictures.items():
        if len(movable.centres):
            passing = drawn(k, movable).range <= maps[k].range + BEFORE
            near = cv2.dilate(passing.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2))
            size = (cameras[k].width, cameras[k].height)
            apart = np.asarray(cv2.resize(near, size, interpolation=cv2.INTER_NEAREST)) == 0
            picture = replace(picture, usable=picture.usable & apart)
        stands[k] = picture
    given = AgreementParams(max_shift=0, neighbours=AROUND, max_distance=params.max_distance)
    small_views = [replace(view, camera=camera) for view, camera in zip(photos, cameras, strict=True)]
    around = neighbours(small_views, list(pictures), maps.__getitem__, given)
    return matches(
        small_views, stands, maps.__getitem__, around, count=params.corners, max_distance=params.max_distance
    )


def _believed(
    found: Corrections, cameras: Sequence[str], photos: Sequence[str], priors: Priors
) -> tuple[Corrections, list[str]]:
    """The corrections without those that are larger than poses can be wrong by, and sentences about these."""
    from scan2sim.texturing.pose_refinement.bundle_adjustment import Corrections

    def beyond(rows: F64, turn: float, shift: float) -> Bools:
        turned, shifted = np.linalg.norm(rows[:, :3], axis=1), np.linalg.norm(rows[:, 3:], axis=1)
        return np.asarray((turned > BOUND * turn) | (shifted > BOUND * shift))

    lens = beyond(found.camera, priors.camera_turn, priors.camera_shift)
    own = beyond(found.photo, priors.turn, priors.shift)
    warnings = []
    for names, rows, bad, prefix in ((cameras, found.camera, lens, "camera_"), (photos, found.photo, own, "")):
        for k in np.flatnonzero(bad).tolist():
            row = _row(rows[k])
            warnings.append(
                f"{names[k]}: photos ask for {row['shift_cm']:.0f} cm and {row['turn_mrad']:.0f} mrad, more than is "
                f"believed: not moved by it; check its pose (`refine.{prefix}shift`, `refine.{prefix}turn`)"
            )
    return Corrections(np.where(own[:, None], 0.0, found.photo), np.where(lens[:, None], 0.0, found.camera)), warnings


def _by_photo(
    first: tuple[Matches, F64], last: tuple[Matches, F64], photos: Sequence[View], cameras: Sequence[Camera]
) -> tuple[dict[int, float], dict[int, float]]:
    """Median displacement of each photo, pixels of its own, before and after."""

    def of(found: Matches, off: F64) -> dict[int, float]:
        scale = [view.camera.width / camera.width for view, camera in zip(photos, cameras, strict=True)]
        return {int(k): _median(off[found.view == k]) * scale[k] for k in np.unique(found.view)}

    return of(*first), of(*last)


def _row(correction: F64) -> dict[str, float]:
    return {
        "shift_cm": round(100 * float(np.linalg.norm(correction[3:])), 2),
        "turn_mrad": round(1000 * float(np.linalg.norm(correction[:3])), 2),
    }


def _figures(
    by: Corrections,
    cameras: Sequence[str],
    photos: Sequence[View],
    before: dict[int, float],
    after: dict[int, float],
) -> dict[str, Any]:
    """Facts: what cameras (right, down, forward) and photos were moved by."""
    rows = {}
    for k, view in enumerate(photos):
        rows[view.name] = _row(by.photo[k])
        if k in before and k in after:
            rows[view.name] |= {"displaced_px": round(before[k], 2), "displaced_after_px": round(after[k], 2)}
    lens = {
        name: {"shift_cm": (100 * row[3:]).round(2).tolist(), "turn_mrad": (1000 * row[:3]).round(2).tolist()}
        for name, row in zip(cameras, by.camera, strict=True)
    }
    shift, turn = (max(row[key] for row in rows.values()) for key in ("shift_cm", "turn_mrad"))
    return {"largest_shift_cm": shift, "largest_turn_mrad": turn, "cameras": lens, "photos": rows}


REFINE = Step("refine", 2, refine, RefineParams)
