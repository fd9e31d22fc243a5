"""Pictures: images of the report, rendered headless."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field

from scan2sim.pipeline.core.classes import CEILING, CODE, SURFACES, colour_of
from scan2sim.pipeline.core.step import Done, Inputs, Params, Report, Step
from scan2sim.pipeline.core.types import F64, U8, Camera, Frame, Mesh, PointCloud, Trajectory
from scan2sim.pipeline.io import sky
from scan2sim.pipeline.io import views as views_io
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.images.album import Album
from scan2sim.pipeline.io.worlds.scene import NAVIGATION_FILE
from scan2sim.pipeline.simulation.robot import ROBOT

if TYPE_CHECKING:
    from scan2sim.pipeline.camera.renderer import Image, Renderer

GROUP_RGB = {
    "terrain": (176, 158, 138),
    "building": (206, 160, 132),
    "vegetation": (126, 172, 104),
    "vehicle": (120, 140, 190),
    "ceiling": (220, 220, 214),
    "furniture": (120, 148, 176),
}
SEEN_RGB = {255: (92, 160, 96), 128: (222, 170, 70), 64: (196, 84, 76)}
DRIVER_EYE_HEIGHT_M = 1.6  # above the ground
POINT_MAP_PIXEL_M = 0.17  # smallest pixel of the map of points, so that every voxel fills its pixel
AERIAL_PITCH_RAD = math.radians(38)  # downward pitch of the aerial view
COVERAGE_WIDTH_PX = 96  # width of renderings that measure how much of a photo the world covers


class PicturesParams(Params):
    """Images of the report.

    Attributes:
        width: width in pixels.
        compared: number of photos to compare with renderings.
    """

    width: int = Field(1280, ge=160, le=4096)
    compared: int = Field(3, ge=0, le=100)


def pictures(inputs: Inputs, params: PicturesParams, out: Path, report: Report) -> Done:
    """Render the tile: classes, meshes, triangles, texture pages, the textured world, and comparisons with photos.

    Held-out photos are compared first. The textured world is shown from above, without the ceilings of rooms, and from
    the scanner's viewpoint: that of a driver if there is a path, else an aerial view of the whole tile. The world of a
    robot's map is also shown from the supplied robot's camera at its spawn pose (`navigation`).
    """
    from scan2sim.pipeline.camera import renderer as render

    folder = out / "pictures"
    folder.mkdir()
    album = Album(folder)
    cloud = PointCloud.join([PointCloud.load(file) for name, file in inputs.items() if name.startswith("cloud.")])
    path = Trajectory.load(inputs["path"]) if "path" in inputs else None
    groups = [g for g in SURFACES if g in inputs]
    plain = render.Renderer([render.Body(Mesh.load(inputs[f"decimate.{g}"]), colour=GROUP_RGB[g]) for g in groups])
    world = render.Renderer([render.textured(inputs[g]) for g in groups], sky.read(inputs.get("sky")))
    open_plain, open_world = without_ceilings(groups, plain), without_ceilings(groups, world)
    low, high = bounds([body.mesh.vertices for body in world.bodies if len(body.mesh)] or [cloud.xyz])
    camera = render.pinhole(params.width, params.width * 9 // 16, field=75)
    shown = np.concatenate([body.mesh.vertices for body in world.bodies if len(body.mesh)] or [cloud.xyz])
    eye, where, what = whole_pose(shown.clip(low, high), camera), "From the air", "The whole world."
    first_plain, first_world = open_plain, open_world
    if path is not None and len(path) > 1:
        eye, where = driver_pose(path.positions, low, high, plain), "From a driver's eye"
        what = "The textured world as a robot's camera sees it."
        first_plain, first_world = plain, world

    def above(renderer: render.Renderer, **how: Any) -> U8:
        return landscape(renderer.above(low, high, width=params.width, **how).rgb)

    report(0.1, where)
    first = first_world.view(camera, eye)
    album.add("hero", first.rgb, "hero", where, "")
    album.add("eye", first.rgb, "world", f"{where}.", what)
    robot = robot_pose(inputs["navigation"], world.bodies[0].mesh.frame) if "navigation" in inputs else None
    if robot is not None:
        album.add("robot", world.view(camera, robot).rgb, "world", "From the robot's eye.", "Where it starts.")
    album.add(
        "above", above(open_world), "world", "From above.", f"{high[0] - low[0]:.0f} m by {high[1] - low[1]:.0f} m."
    )
    report(0.3, "aerial view")
    album.add("bird", open_world.view(camera, bird_pose(low, high)).rgb, "world", "From a bird's eye.", "")
    album.add(
        "seen",
        seen_colours(first),
        "world",
        "Where colours come from.",
        "Green: photos. Yellow: the cloud's points. Red: filled.",
    )

    report(0.4, "classes")
    assert cloud.classification is not None
    album.add(
        "classes",
        points_from_above(cloud.take(cloud.classification != CODE["ceiling"]), low, high, params.width),
        "step",
        "Classes.",
        "The thinned points by class.",
    )
    album.add(
        "mesh",
        first_plain.view(camera, eye, shaded=True).rgb,
        "step",
        "Mesh.",
        "After Poisson, trimming and decimation, by class.",
    )
    lines = first_plain.view(camera, eye, shaded=True, wireframe=True)
    total = sum(len(body.mesh) for body in plain.bodies)
    album.add("wireframe", lines.rgb, "step", "Triangles.", f"{total:,} of them, each class to its own target.")
    album.add("mesh_above", above(open_plain, shaded=True), "step", "Mesh from above.", "")

    report(0.6, "pages")
    for group, body in zip(groups, world.bodies, strict=True):
        for i, page in enumerate(body.pages[:2]):
            pages = f"page {i + 1} of {len(body.pages)}"
            album.add(
                f"atlas_{group}_{i}",
                thumbnail(page, params.width // 2),
                "atlas",
                f"{group.capitalize()}.",
                f"Texture {pages}.",
            )

    views, held = views_io.load(inputs["views"]), views_io.load_held_out(inputs["views"])
    coverage = [
        world.covers(view.camera.scaled(COVERAGE_WIDTH_PX / view.camera.width), view.T_world_cam) for view in views
    ]
    for i in _compared(held, coverage, params.compared):
        report(0.7 + 0.3 * i / max(1, len(views)), views[i].name)
        photo = image.usable_photo(views[i])
        if photo is None:
            continue
        small = views[i].camera.scaled(min(1.0, params.width / views[i].camera.width))
        shot = world.view(small, views[i].T_world_cam)
        how = "held out of texturing" if held[i] else "used for texturing"
        album.add(
            f"photo_{i}", resized(photo, small), "compare", views[i].name, f"({how}): drag to compare.", other=shot.rgb
        )
    album.save()
    return Done({"pictures": folder}, {"pictures": len(album.index)})


def without_ceilings(groups: Sequence[str], renderer: Renderer) -> Renderer:
    """Renderer of the bodies (one for each of `groups`) but the ceilings of rooms, which hide the rooms from above."""
    from scan2sim.pipeline.camera.renderer import Renderer

    bodies = [body for group, body in zip(groups, renderer.bodies, strict=True) if group != CEILING]
    return renderer if len(bodies) == len(groups) else Renderer(bodies, renderer.sky)


def bounds(parts: list[Any]) -> tuple[F64, F64]:
    """Low and high corner of the points, without outliers (0.2nd and 99.8th percentile)."""
    xyz = np.concatenate(parts)
    low, high = np.percentile(xyz, 0.2, axis=0), np.percentile(xyz, 99.8, axis=0)
    return low.astype(np.float64), high.astype(np.float64)


def whole_pose(points: npt.NDArray[np.floating], camera: Camera) -> F64:
    """Pose (4, 4) of an aerial camera facing the longer side, as near as possible with all points (N, 3) in view."""
    from scan2sim.pipeline.camera.renderer import look_at

    size = np.ptp(points, axis=0)
    side = np.array([-0.35, -0.94]) if size[0] >= size[1] else np.array([-0.94, -0.35])
    pose = look_at(np.array([*side * math.cos(AERIAL_PITCH_RAD), math.sin(AERIAL_PITCH_RAD)]), np.zeros(3))
    x, y, z = (points @ pose[:3, :3]).T
    middle, back = [], []
    for across, slope in ((x, camera.width / 2 / camera.fx), (y, camera.height / 2 / camera.fy)):
        # a point at (across, z) is in the image of a camera at (m, e) where |across - m| <= slope (z - e)
        right, left = float((across - slope * z).max()), float((-across - slope * z).max())
        middle.append((right - left) / 2)
        back.append((right + left) / 2 / slope)
    pose[:3, 3] = pose[:3, :3] @ np.array([*middle, -max(back)])
    return pose


def robot_pose(navigation: Path, frame: Frame) -> F64 | None:
    """Pose (4, 4) of the supplied robot's camera at its spawn pose, in local coordinates; None: there is no such pose.

    `navigation` is the folder of the step of this name.
    """
    from scan2sim.pipeline.camera.renderer import look_at

    file = navigation / NAVIGATION_FILE
    if not file.exists():
        return None
    about = json.loads(file.read_text(encoding="utf-8"))
    link = ROBOT.link(ROBOT.camera.link)
    heading = about["spawn"]["angles_rad"][2]
    forward = np.array([math.cos(heading), math.sin(heading), 0.0])
    base = np.add(about["world_origin_m"], about["spawn"]["position_m"]) - np.asarray(frame.origin)
    eye = base + (link.place[0] + ROBOT.camera.ahead) * forward + [0.0, 0.0, link.place[2]]
    return look_at(eye, eye + forward)


def driver_pose(path: F64 | None, low: F64, high: F64, ground: Any) -> F64:
    """Pose (4, 4) of a camera on the path, after an eighth of its length, looking along it, or along the tile."""
    from scan2sim.pipeline.camera.renderer import look_at

    if path is not None and len(path) > 1:
        inside = path[((path[:, :2] > low[:2]) & (path[:, :2] < high[:2])).all(axis=1)]
        path = inside if len(inside) > 1 else path
        axis = np.linalg.svd(path - path.mean(axis=0), full_matrices=False)[2][0]
        along = (path - path.mean(axis=0)) @ axis
        ends = path[np.argsort(along)[[len(along) // 8, -1]]]
        start, end = ends if (ends[1] - ends[0])[:2].any() else (path[0], path[-1])
    else:
        middle, size = (low + high) / 2, high - low
        axis = np.array([1.0, 0, 0]) if size[0] >= size[1] else np.array([0, 1.0, 0])
        start, end = middle - axis * size * 0.45, middle + axis * size * 0.45
    start, end = start.copy(), end.copy()
    for point in (start, end):
        point[2] = ground_height(ground, point, low, high) + DRIVER_EYE_HEIGHT_M
    if np.linalg.norm(end - start) < 0.5:
        end = start + (1.0, 0, 0)
    return look_at(start, end - (0, 0, 0.02 * np.linalg.norm(end - start)))


def ground_height(renderer: Any, point: F64, low: F64, high: F64) -> float:
    """Height of the lowest surface around a point, metres; of the tile's lowest point if there is none."""
    corner = np.array([point[0] - 1, point[1] - 1, low[2] - 50]), np.array([point[0] + 1, point[1] + 1, high[2] + 50])
    shot = renderer.above(*corner, width=9)
    if not shot.hit.any():
        return float(low[2])
    return float(corner[1][2] + 1.0 - shot.range[shot.hit].max())


def bird_pose(low: F64, high: F64) -> F64:
    """Pose (4, 4) of a camera above one end of the tile that overlooks it."""
    from scan2sim.pipeline.camera.renderer import look_at

    size = high - low
    along = 0 if size[0] >= size[1] else 1
    across = 1 - along
    distance = max(size[along] * 0.45, size[across] * 0.7, 10.0)
    eye, target = (low + high) / 2, (low + high) / 2
    eye[along] -= size[along] * 0.5 + distance * 0.25
    eye[across] -= size[across] * 0.35
    eye[2] = low[2] + distance
    target[along] -= size[along] * 0.12
    target[2] = low[2]
    return look_at(eye, target)


def points_from_above(cloud: PointCloud, low: F64, high: F64, width: int) -> U8:
    """Map of the points by class; the highest point of a pixel is on top, colours are darker at lower heights."""
    assert cloud.classification is not None
    pixel_m = max(float((high - low)[:2].max()) / width, POINT_MAP_PIXEL_M)
    size = np.maximum(np.ceil((high - low)[:2] / pixel_m).astype(int), 1)
    inside = ((cloud.xyz[:, :2] >= low[:2]) & (cloud.xyz[:, :2] < high[:2])).all(axis=1)
    xyz, classification = cloud.xyz[inside], cloud.classification[inside]
    order = np.argsort(xyz[:, 2], kind="stable")
    cell = ((xyz[order, :2] - low[:2]) / pixel_m).astype(int).clip(max=size - 1)
    rgb = np.full((size[1], size[0], 3), 250, np.uint8)
    light = np.clip(0.75 + 0.35 * (xyz[order, 2] - low[2]) / max(high[2] - low[2], 1e-3), 0.6, 1.15)
    rgb[size[1] - 1 - cell[:, 1], cell[:, 0]] = np.clip(colour_of()[classification[order]] * light[:, None], 0, 255)
    return landscape(rgb.repeat(max(1, width // max(size)), axis=0).repeat(max(1, width // max(size)), axis=1))


def landscape(rgb: U8) -> U8:
    """Rotate a portrait image to landscape."""
    return np.ascontiguousarray(np.rot90(rgb)) if rgb.shape[0] > rgb.shape[1] * 1.3 else rgb


def seen_colours(shot: Image) -> U8:
    """The image tinted by the source of each texel's colour."""
    tint = np.full(shot.rgb.shape, 230, np.uint8)
    for value, rgb in SEEN_RGB.items():
        tint[shot.hit & (shot.seen == value)] = rgb
    grey = shot.rgb.mean(axis=2, keepdims=True) / 255
    return np.where(shot.hit[..., None], tint * (0.45 + 0.6 * grey), 250).clip(0, 255).astype(np.uint8)


def thumbnail(page: Path, width: int) -> U8:
    """A texture page scaled to at most `width` pixels."""
    import cv2

    pixels = image.read_rgb(page)
    factor = min(1.0, width / max(pixels.shape[:2]))
    return cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def resized(photo: U8, camera: Camera) -> U8:
    """The photo resized to the size of a scaled camera."""
    import cv2

    return cv2.resize(np.ascontiguousarray(photo), (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _compared(held: Sequence[bool], coverage: Sequence[float], count: int) -> list[int]:
    """Indices of views to compare: held-out ones first, then by how much of the photo the world covers."""
    return sorted(range(len(held)), key=lambda i: (not held[i], -coverage[i]))[:count]


PICTURES = Step("pictures", 7, pictures, PicturesParams, memory=(1.3, 3))
