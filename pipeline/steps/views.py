"""Views: checks the tile's posed photos, and selects those that are held out of texturing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.step import Context, Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, F64, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

MAX_PHOTO_DISTANCE_M = 100.0  # a photo farther than this from every point sees nothing of the tile
ORTHOPHOTO_MARGIN_PX = 8  # around the points
NOT_USED = "not used; its area is textured from other photos that see it"
MAX_SAMPLED_POINTS = 500_000  # points that are projected into the photos
SAME_MOMENT_S = 0.005
"""Cameras of a rig are triggered together within this time."""
RIG_M = 2.0
"""Largest distance of the cameras of a rig."""


def _not_all(every: int) -> int:
    if every == 1:
        raise ValueError("every photo would be held out of texturing")
    return every


class TileViews(Context):
    """The tile's views as JSON (`pipeline.io.views`), file names without folders."""

    poses: tuple[dict[str, Any], ...] = ()


class ViewsParams(Params):
    """The photos.

    Attributes:
        hold_out: hold every Nth photo, with those a rig took beside it, out of texturing, to score it; 0: none.
    """

    hold_out: Annotated[int, AfterValidator(_not_all)] = Field(
        0, ge=0, le=1_000_000, json_schema_extra={"range": "a whole number, 0 or 2 to 1,000,000"}
    )
    context: TileViews = TileViews()


def views(inputs: Inputs, params: ViewsParams, out: Path, report: Report) -> Done:
    """Check that photos can be opened, have the size of their camera, and see the cloud; skip those that don't.

    Inputs are `photo.N` and `mask.N` by index of the view, and the cloud. Outputs: `views` and `cameras`
    (`pipeline.io.views.save_linked`).

    Raises:
        InputError: a photo's size differs from its camera's; no photo can be read at all.
        DataError: no photo sees any point of the cloud.
    """
    clouds = [PointCloud.load(path).xyz for name, path in inputs.items() if name.startswith("cloud")]
    points = np.concatenate(clouds)
    points = points[:: max(1, len(points) // MAX_SAMPLED_POINTS)]
    kept: list[View] = []
    warnings, sees_nothing = [], []
    for i, entry in enumerate(params.context.poses):
        report(i / len(params.context.poses), entry["name"])
        mask = inputs.get(f"mask.{i}")
        view = replace(views_io.from_json(entry), photo=inputs[f"photo.{i}"], mask=mask)
        problem = _problem(view)
        if problem:
            warnings.append(f"{problem}: {NOT_USED}")
        elif not _sees(view, points):
            sees_nothing.append(view.name)
        elif view.camera.model == "orthographic":
            try:
                kept.append(_crop(view, points, out / "views" / "photos", i))
            except InputError as error:
                warnings.append(f"{view.photo} {error.cause}: {NOT_USED}")
        else:
            kept.append(view)
    if sees_nothing and not kept:
        raise DataError(
            inputs["photo.0"].parent,
            f"none of the {len(sees_nothing)} photos sees a point of the cloud within {MAX_PHOTO_DISTANCE_M:.0f} m",
            "Check CRS, units and axes of the poses (camera to world; x right, y down, z forward)",
        )
    if params.context.poses and not kept:
        raise InputError(
            inputs["photo.0"], "no photo of the tile can be read", "Restore the photos, or remove them from the tile"
        )
    if sees_nothing:
        count = "1 photo sees" if len(sees_nothing) == 1 else f"{len(sees_nothing)} photos see"
        warnings.append(f"{count} no point of the cloud: {', '.join(sees_nothing[:5])}")
    held = held_out(kept, params.hold_out)
    if params.hold_out and kept and not any(held):
        warnings.append(f"{len(kept)} photos are too few to hold out every {params.hold_out}th: none is held out")
    files = views_io.save_linked(out, kept, held)
    # links: moving the tile breaks them, which only rebuilds this step, not the results that depend on the photos
    metrics = {"photos": len(params.context.poses), "usable": len(kept), "held_out": sum(held)}
    return Done(files, metrics, warnings)


def _crop(view: View, points: F32, folder: Path, index: int) -> View:
    """Crop an orthophoto to the points: that of a survey may cover a town."""
    from scan2sim.pipeline.camera.projection import pixels

    camera = view.camera
    uv, _ = pixels(camera, view.T_world_cam, points)
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(uv.min(axis=0)) - ORTHOPHOTO_MARGIN_PX, 0, size - 1).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + ORTHOPHOTO_MARGIN_PX, low + 1, size).astype(int)
    rgb = image.read_rgb(view.photo, (*low.tolist(), *high.tolist()))
    folder.mkdir(exist_ok=True, parents=True)
    file = folder / f"{index:05d}_{view.photo.stem}.png"
    image.write(file, rgb)
    width, height = (high - low).tolist()
    part = replace(camera, width=width, height=height, cx=camera.cx - float(low[0]), cy=camera.cy - float(low[1]))
    return replace(view, camera=part, photo=file)


def held_out(views: Sequence[View], every: int) -> list[bool]:
    """(N,) bool, True for held-out views: every Nth, with those that other cameras took at the same moment.

    They are counted camera by camera, so that every camera is included. What a rig's other cameras took at that moment
    shows nearly the same: with it, the world would be measured by what it was made of.
    """
    moment = _moments(views)
    cameras = list(dict.fromkeys(view.camera for view in views))
    photos = [i for i, view in enumerate(views) if view.camera.model != "orthographic"]
    in_turn = list(dict.fromkeys(moment[i] for i in sorted(photos, key=lambda i: cameras.index(views[i].camera))))
    chosen = set(in_turn[every // 2 :: every] if every else ())
    return [view.camera.model != "orthographic" and one in chosen for view, one in zip(views, moment, strict=True)]


def _moments(views: Sequence[View]) -> list[float | tuple[str, int]]:
    """The same value for views (N,) that a rig took together.

    They have the same time, or without times the same file name, in folders of the cameras, and are near each other.
    """
    start: dict[float, float] = {}
    before = first = -np.inf
    for time in sorted({view.time for view in views if view.time is not None}):
        first = first if time - before < SAME_MOMENT_S else time
        start[time], before = first, time
    places: dict[str, list[F64]] = {}
    return [
        start[view.time]
        if view.time is not None
        else (view.photo.stem, _place(places.setdefault(view.photo.stem, []), view))
        for view in views
    ]


def _place(places: list[F64], view: View) -> int:
    """Index of the first of the places within `RIG_M` of a view, which is added if there is none."""
    for i, place in enumerate(places):
        if np.linalg.norm(place - view.centre) < RIG_M:
            return i
    places.append(view.centre)
    return len(places) - 1


def _problem(view: View) -> str | None:
    """Reason why the photo or its mask can't be used; None if it can.

    Raises:
        InputError: it can be opened, but its size differs from its camera's.
    """
    expected = view.camera.width, view.camera.height
    part = view.camera.model == "orthographic"  # read in parts by `_crop`
    for path in (view.photo, view.mask):
        if path is None:
            continue
        try:
            size = image.size_of(path, parts=part)
            if size == expected and not part:
                image.check_decodes(path)
        except InputError as error:
            return f"{path} {error.cause}"
        if size != expected:
            raise InputError(
                path,
                f"is {size[0]} x {size[1]} pixels, but its camera {expected[0]} x {expected[1]}",
                "Fix the camera's `size` (and focal, centre), or resize the photo",
            )
    return None


def _sees(view: View, points: F32) -> bool:
    """Whether any of the points (N, 3) is inside the image and near enough."""
    from scan2sim.pipeline.camera.projection import pixels

    if view.camera.model != "orthographic":
        points = points[np.linalg.norm(points - view.centre, axis=1) < MAX_PHOTO_DISTANCE_M]
    _, shown = pixels(view.camera, view.T_world_cam, points)
    return bool(shown.any())


VIEWS = Step("views", 4, views, ViewsParams)
