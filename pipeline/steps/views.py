"""Views: the tile's posed photos, checked, and which of them are held out of texturing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from scan2sim.pipeline.core.errors import DataError, InputError
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F32, PointCloud, View
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image

REACH = 100.0  # metres; a photo further than this from every point sees nothing of the tile
MARGIN = 8  # pixels of an orthophoto around the points
LEFT_OUT = "left out, its place is textured from other photos where they see it"
SAMPLE = 500_000  # points that are looked for in the photos


def _not_all(every: int) -> int:
    if every == 1:
        raise ValueError("every photo would be kept out of texturing")
    return every


class ViewsParams(Params):
    """What becomes of the photos.

    Attributes:
        hold_out: keeps every nth photo out of texturing (of all cameras in turn), to score it; 0: none.
        poses: the views as JSON (`pipeline.io.views`), file names without folders; set by the recipe.
    """

    hold_out: Annotated[int, AfterValidator(_not_all)] = Field(
        0, ge=0, le=1_000_000, json_schema_extra={"range": "a whole number, 0 or 2 to 1,000,000"}
    )
    poses: tuple[dict[str, Any], ...] = ()


def views(inputs: Inputs, params: ViewsParams, out: Path, report: Report) -> Done:
    """Check that photos can be opened, have their camera's size, and meet the cloud; skip those that don't.

    Inputs are `photo.N` and `mask.N` by the views' index, and the cloud.

    Raises:
        InputError: a photo's size is not its camera's; no photo can be read at all.
        DataError: no photo sees any point of the cloud.
    """
    clouds = [PointCloud.load(path).xyz for name, path in inputs.items() if name.startswith("cloud")]
    points = np.concatenate(clouds)
    points = points[:: max(1, len(points) // SAMPLE)]
    kept: list[View] = []
    warnings, sees_nothing = [], []
    for i, entry in enumerate(params.poses):
        report(i / len(params.poses), entry["name"])
        mask = inputs.get(f"mask.{i}")
        view = replace(views_io.from_json(entry), photo=inputs[f"photo.{i}"], mask=mask)
        problem = _problem(view)
        if problem:
            warnings.append(f"{problem}: {LEFT_OUT}")
        elif not _sees(view, points):
            sees_nothing.append(view.name)
        elif view.camera.model == "orthographic":
            try:
                kept.append(_cut(view, points, out / "photos", i))
            except InputError as error:
                warnings.append(f"{view.photo} {error.cause}: {LEFT_OUT}")
        else:
            kept.append(views_io.linked(view, out, i))
    if sees_nothing and not kept:
        raise DataError(
            inputs["photo.0"].parent,
            f"cloud and cameras never meet: none of {len(sees_nothing)} photos sees a point within {REACH:.0f} m",
            "Check CRS, units and axes of the poses (camera to world; x right, y down, z forward)",
        )
    if params.poses and not kept:
        raise InputError(inputs["photo.0"], "no photo of the tile can be read", "Put the photos back, or take them out")
    if sees_nothing:
        many = "1 photo sees" if len(sees_nothing) == 1 else f"{len(sees_nothing)} photos see"
        warnings.append(f"{many} no point of the cloud: {', '.join(sees_nothing[:5])}")
    held = held_out(kept, params.hold_out)
    if params.hold_out and kept and not any(held):
        warnings.append(f"{len(kept)} photos are too few to hold every {params.hold_out}th out: none is")
    views_io.save(out / "views.json", kept, held)
    # links: a moved tile breaks them, which rebuilds this step alone, not what was made from the photos
    facts = {"photos": len(params.poses), "usable": len(kept), "held_out": sum(held)}
    return Done({"views": out / "views.json"}, facts, warnings)


def _cut(view: View, points: F32, folder: Path, index: int) -> View:
    """An orthophoto cut to what it shows of the points: a survey's may cover a town."""
    from scan2sim.pipeline.camera.projection import pixels

    camera = view.camera
    uv, _ = pixels(camera, view.T_world_cam, points)
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(uv.min(axis=0)) - MARGIN, 0, size - 1).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + MARGIN, low + 1, size).astype(int)
    rgb = image.read_rgb(view.photo, (*low.tolist(), *high.tolist()))
    folder.mkdir(exist_ok=True)
    file = folder / f"{index:05d}_{view.photo.stem}.png"
    image.write(file, rgb)
    width, height = (high - low).tolist()
    part = replace(camera, width=width, height=height, cx=camera.cx - float(low[0]), cy=camera.cy - float(low[1]))
    return replace(view, camera=part, photo=file.relative_to(folder.parent))


def held_out(views: Sequence[View], every: int) -> list[bool]:
    """Which views are held out: every nth, counted camera after camera, so that every camera has its turn."""
    held = [False] * len(views)
    cameras = list(dict.fromkeys(view.camera for view in views))
    photos = [i for i, view in enumerate(views) if view.camera.model != "orthographic"]
    in_turn = sorted(photos, key=lambda i: cameras.index(views[i].camera))
    for i in in_turn[every // 2 :: every] if every else ():
        held[i] = True
    return held


def _problem(view: View) -> str | None:
    """Why the photo or its mask can't be used; None if it can.

    Raises:
        InputError: it opens, but is not of its camera's size.
    """
    wanted = view.camera.width, view.camera.height
    part = view.camera.model == "orthographic"  # what `_cut` reads
    for path in (view.photo, view.mask):
        if path is None:
            continue
        try:
            size = image.size_of(path, parts=part)
            if size == wanted and not part:
                image.check_decodes(path)
        except InputError as error:
            return f"{path} {error.cause}"
        if size != wanted:
            raise InputError(
                path,
                f"is {size[0]} x {size[1]} pixels, but its camera {wanted[0]} x {wanted[1]}",
                "Mend the camera's `size` (and focal, centre), or resize the photo",
            )
    return None


def _sees(view: View, points: F32) -> bool:
    """Whether any of the points (N, 3) is inside the image and within reach."""
    from scan2sim.pipeline.camera.projection import pixels

    if view.camera.model != "orthographic":
        points = points[np.linalg.norm(points - view.centre, axis=1) < REACH]
    _, shown = pixels(view.camera, view.T_world_cam, points)
    return bool(shown.any())


VIEWS = Step("views", 2, views, ViewsParams)
