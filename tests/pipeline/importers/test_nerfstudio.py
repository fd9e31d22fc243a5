"""nerfstudio's transforms.json by its conventions: points project to their pixels, depth images give a cloud."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.camera.models import project, unproject
from scan2sim.pipeline.camera.renderer import Body, Renderer
from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64, U8, Camera, Mesh
from scan2sim.pipeline.geometry.surface_distance import distances
from scan2sim.pipeline.importers.depth_images import discontinuities
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.images.image import read_mask, read_rgb
from scan2sim.pipeline.io.photogrammetry import read
from scan2sim.pipeline.io.tile import read_tile
from tests.pipeline.importers.test_photogrammetry import (
    TILE,
    H,
    Lens,
    W,
    agrees,
    brown,
    equidistant,
    images,
    shots,
    sphere,
)
from tests.present import present

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
COLMAP_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""`applied_transform` of nerfstudio's importer of COLMAP: y down becomes z up."""
BROWN = {"fl_x": 496.0, "fl_y": 504.0, "cx": 408.0, "cy": 284.0, "k1": -0.12, "k2": 0.03, "p1": 6e-4, "p2": -4e-4}
CAMERAS: dict[str, tuple[dict[str, Any], Lens]] = {
    "OPENCV": (BROWN, brown((496, 504), (408, 284), (-0.12, 0.03), (-4e-4, 6e-4))),
    "OPENCV with k3": (BROWN | {"k3": 2e-3}, brown((496, 504), (408, 284), (-0.12, 0.03, 2e-3), (-4e-4, 6e-4))),
    "distortion_params": (
        {"fl_x": 496.0, "cx": 408.0, "cy": 284.0, "distortion_params": [-0.12, 0.03, 0.0, 0.0, 6e-4, -4e-4]},
        brown((496, 496), (408, 284), (-0.12, 0.03), (-4e-4, 6e-4)),
    ),
    "PINHOLE": ({"fl_x": 496.0, "camera_model": "PINHOLE"}, brown((496, 496), (400, 300), (), (0, 0))),
    "camera_angle_x": ({"camera_angle_x": 2 * math.atan(400 / 496)}, brown((496, 496), (400, 300), (), (0, 0))),
    "intrinsics of a larger image": (
        {"fl_x": 992.0, "cx": 816.0, "cy": 568.0, "w": 1600, "h": 1200},
        brown((496, 496), (408, 284), (), (0, 0)),
    ),
    "OPENCV_FISHEYE": (
        {"camera_model": "OPENCV_FISHEYE", "fl_x": 400.0, "fl_y": 400.0, "cx": 408.0, "cy": 300.0}
        | {"k1": 0.01, "k2": -0.002, "k3": 0.001, "k4": 1e-4},
        equidistant(400, (408, 300), (0.01, -0.002, 0.001, 1e-4)),
    ),
    "EQUIRECTANGULAR": (
        {"camera_model": "EQUIRECTANGULAR", "fl_x": 512.0, "fl_y": 512.0, "cx": 512.0, "cy": 256.0},
        sphere(1024, 512),
    ),
}  # fmt: skip


def write(
    path: Path,
    values: Mapping[str, Any],
    poses: Mapping[str, F64],
    per_frame: bool = False,
    more: Mapping[str, Mapping[str, Any]] | None = None,
) -> Path:
    """A transforms.json of photos with poses (4, 4), camera (x right, y down, z forward) to the file's coordinates."""
    frames = []
    for name, pose in poses.items():
        frame = {"file_path": name, "transform_matrix": (pose @ OPENGL).tolist()} | dict((more or {}).get(name, {}))
        frames.append(frame | (dict(values) if per_frame else {}))
    body = {} if per_frame else dict(values)
    path.write_text(json.dumps(body | {"frames": frames}), encoding="utf-8")
    return path


def plain(size: tuple[int, int] = (W, H)) -> dict[str, F64]:
    return {f"./{name}": pose for name, pose in shots(size)}


@pytest.mark.parametrize("per_frame", [False, True])
@pytest.mark.parametrize("kind", CAMERAS)
def test_points_project_to_their_pixels(tmp_path: Path, kind: str, per_frame: bool) -> None:
    values, lens = CAMERAS[kind]
    size = (1024, 512) if kind == "EQUIRECTANGULAR" else (W, H)
    model = read("nerfstudio", write(tmp_path / "transforms.json", values, plain(size), per_frame), images(size))
    agrees(model, lens, size)
    assert len(model.cameras) == 1 and model.up is None and not model.notes


def test_centre_of_the_first_pixel_is_half_a_pixel_from_its_corner(tmp_path: Path) -> None:
    values = {"fl_x": 500.0, "cx": 400.0, "cy": 300.0}
    (camera,) = read("nerfstudio", write(tmp_path / "transforms.json", values, plain()), images()).cameras.values()
    assert camera == Camera("pinhole", W, H, 500.0, 500.0, 399.5, 299.5)


def saved(pose: F64, applied: F64, scale: float) -> F64:
    out = np.eye(4)
    out[:3, :3] = applied[:, :3] @ pose[:3, :3]
    out[:3, 3] = scale * (applied[:, :3] @ pose[:3, 3] + applied[:, 3])
    return out


def write_ply(path: Path, xyz: F64) -> None:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    properties += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = "".join(f"{x} {y} {z} 7 7 7\n" for x, y, z in xyz.tolist())
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n{properties}end_header\n{rows}", "utf-8")


def copied(folder: Path) -> Path:
    """The sample street's photos in a folder `images`."""
    shutil.copytree(images(), folder / "images")
    return folder


def test_applied_transform_and_scale_are_undone_with_z_up(tmp_path: Path) -> None:
    """Original coordinates with y down, as by COLMAP, become z up at the original scale, for cloud and photos alike."""
    original = np.eye(4)
    original[:3, :3] = COLMAP_UP[:, :3].T  # the street in axes with y down
    applied, scale = COLMAP_UP + [[0, 0, 0, 0.5], [0, 0, 0, -2], [0, 0, 0, 7]], 0.125
    poses = dict(shots())
    files = {f"images/{name}": saved(original @ pose, applied, scale) for name, pose in poses.items()}
    true = np.random.default_rng(3).uniform(-9, 9, (2000, 3))
    in_file = scale * (true @ original[:3, :3].T @ applied[:, :3].T + applied[:, 3])
    folder = copied(tmp_path / "data")
    write_ply(folder / "sparse_pc.ply", in_file)
    values = BROWN | {"applied_transform": applied.tolist(), "applied_scale": scale, "ply_file_path": "sparse_pc.ply"}
    write(folder / "transforms.json", values, files)
    tile = read_tile(import_model("nerfstudio", folder, None, tmp_path / "tile"))
    assert tile.frame.crs == "local" and len(tile.views) == len(poses)
    points = clouds.read(tile.clouds[0], tile.frame)
    assert np.abs(np.sort(tile.frame.to_crs(points.xyz), axis=0) - np.sort(true, axis=0)).max() < 2e-3
    assert points.rgb is not None and (points.rgb == 7).all()
    for view in tile.views:
        pose = poses[view.photo.name]
        assert np.allclose(view.T_world_cam[:3, :3], pose[:3, :3], atol=1e-9)
        assert np.allclose(tile.frame.to_crs(view.centre), pose[:3, 3], atol=1e-6)


def test_original_coordinates_with_z_up_are_kept(tmp_path: Path) -> None:
    applied = np.column_stack([Rotation.from_euler("Z", 0.8).as_matrix(), [500.0, -90.0, 3.0]])
    files = {f"images/{name}": saved(pose, applied, 2.0) for name, pose in shots()}
    folder = copied(tmp_path / "data")
    values = BROWN | {"applied_transform": applied.tolist(), "applied_scale": 2.0}
    path = write(folder / "transforms.json", values, files)
    np.savetxt(tmp_path / "dense.xyz", np.random.default_rng(0).uniform(0, 9, (50, 3)), "%.3f")
    tile = read_tile(import_model("nerfstudio", path, None, tmp_path / "t", cloud=tmp_path / "dense.xyz"))
    for view, (_, pose) in zip(tile.views, shots(), strict=True):
        assert np.allclose(view.T_world_cam[:3, :3], pose[:3, :3], atol=1e-9)
        assert np.allclose(tile.frame.to_crs(view.centre), pose[:3, 3], atol=1e-6)


def street() -> Renderer:
    return Renderer([Body(Mesh.load(present(read_tile(TILE).truth_mesh)))])


def depth_image(renderer: Renderer, camera: Camera, pose: F64, size: tuple[int, int]) -> U8:
    """A PNG of millimetres along the axis (of a panorama: from the centre), at `size`, of the true street."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    scale = np.array([camera.width, camera.height]) / size
    rays = unproject(camera, (np.column_stack([u.ravel(), v.ravel()]) + 0.5) * scale - 0.5)
    hits = renderer._intersect(np.tile(pose[:3, 3], (len(rays), 1)), rays @ pose[:3, :3].T)
    far = hits.range * (1 if camera.model == "equirectangular" else rays[:, 2])
    levels = np.where(np.isfinite(far) & (far < 30), far * 1000, 0).reshape(size[::-1])
    return np.asarray(cv2.imencode(".png", np.rint(levels).astype(np.uint16))[1])


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_depth_images_are_converted_to_a_cloud(tmp_path: Path, scale: float) -> None:
    """Depth images of the true street for all camera models give its points to millimetres, with its colours."""
    tile, renderer, frames, more = read_tile(TILE), street(), {}, {}
    folder = copied(tmp_path / "data")
    (folder / "depth").mkdir()
    for view in tile.views:
        camera, name = view.camera, f"images/{view.photo.name}"
        shutil.copyfile(view.photo, folder / name)
        size = (256, 192) if camera.model != "equirectangular" else (1024, 512)
        depth = f"depth/{view.photo.stem}.png"
        (folder / depth).write_bytes(depth_image(renderer, camera, view.T_world_cam, size).tobytes())
        k1, k2, p1, p2 = camera.distortion or (0.0, 0.0, 0.0, 0.0)
        values: dict[str, Any] = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
        values |= {"k1": k1, "k2": k2, "p1": p1, "p2": p2}
        if camera.model == "equirectangular":
            values = {"camera_model": "EQUIRECTANGULAR"}
        more[name] = values | {"depth_file_path": depth}
        frames[name] = saved(view.T_world_cam, np.eye(4)[:3], scale)
    write(folder / "transforms.json", {"applied_scale": scale}, frames, more=more)
    warned: list[str] = []
    fused = read_tile(import_model("nerfstudio", folder, None, tmp_path / "tile", warn=warned.append))
    cloud = clouds.read(fused.clouds[0], fused.frame)
    truth = Mesh.load(present(tile.truth_mesh))
    local = fused.frame.to_crs(cloud.xyz).astype(np.float32)
    off = distances(local, truth)
    assert not warned and len(cloud) > 50_000
    assert np.median(off) < 0.001 and np.quantile(off, 0.99) < 0.003
    # the colours are those of the photos
    view = next(view for view in fused.views if view.camera.model == "pinhole")
    image = read_rgb(view.photo)
    in_camera = (cloud.xyz - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, :3]
    uv, valid = project(view.camera, in_camera)
    near = valid & (np.linalg.norm(in_camera, axis=1) < 12) & ((uv > 0) & (uv < [W - 1, H - 1])).all(axis=1)
    u, v = np.rint(uv[near]).astype(int).T
    error = np.abs(image[v, u].astype(int) - present(cloud.rgb)[near]).mean(axis=1)
    assert np.median(error) < 12


def test_pixels_at_depth_discontinuities_are_removed() -> None:
    """At a step in depth, but not on a road at a grazing angle."""
    rows = np.arange(1, 120)[:, None] + 0.5
    road = np.repeat(1.5 * 200 / rows, 80, axis=1)  # 1.5 m above it, focal length 200 pixels
    assert not discontinuities(road).any()
    road[40:, 30:50] = 1.0
    found = discontinuities(road)
    assert found[60, 29] and found[60, 30] and not found[60, 33] and not found[60, 40]
    assert not discontinuities(np.zeros((9, 9))).any()


def test_missing_images_masks_and_clouds_are_reported(tmp_path: Path) -> None:
    folder = copied(tmp_path / "data")
    (folder / "masks").mkdir()
    names = [name for name, _ in shots()]
    levels = np.full((H, W), 255, np.uint8)
    levels[400:] = 0
    cv2.imwrite(str(folder / "masks" / "shared.png"), levels)
    cv2.imwrite(str(folder / "masks" / "small.png"), levels[:100])
    cv2.imwrite(str(folder / "masks" / f"{Path(names[4]).stem}.png"), levels)  # has the name of a photo, but isn't one
    (folder / "images" / names[4]).unlink()
    masks = ["masks/shared.png", "masks/shared.png", "masks/small.png", "masks/lost.png"]
    more = {f"images/{name}": {"mask_path": mask} for name, mask in zip(names, masks, strict=False)}
    files = {f"images/{name}": pose for name, pose in shots()}
    values = BROWN | {"ply_file_path": "lost.ply"}
    write(folder / "transforms.json", values, files, more=more)
    np.savetxt(tmp_path / "dense.xyz", np.random.default_rng(0).uniform(0, 9, (50, 3)), "%.3f")
    warned: list[str] = []
    tile = read_tile(
        import_model("nerfstudio", folder, None, tmp_path / "t", cloud=tmp_path / "dense.xyz", warn=warned.append)
    )
    assert sorted(view.photo.name for view in tile.views) == sorted(set(names) - {names[4]})
    by_name = {view.photo.name: view for view in tile.views}
    assert [read_mask(by_name[name]) is not None for name in names[:4]] == [True, True, False, False]
    assert np.array_equal(present(read_mask(by_name[names[1]])), levels)
    for text in (
        f"1 frames have no image, and are left out: images/{names[4]}",
        "1 frames have a mask of another size",
        "1 frames have a `mask_path` that doesn't exist: masks/lost.png",
        "its cloud lost.ply doesn't exist",
    ):
        assert any(text in line for line in warned), warned


def test_model_without_points_and_depths_needs_a_cloud(tmp_path: Path) -> None:
    folder = copied(tmp_path / "data")
    write(folder / "transforms.json", BROWN, {f"images/{name}": pose for name, pose in shots()})
    with pytest.raises(InputError, match=r"has no 3D points.*Give a cloud"):
        import_model("nerfstudio", folder, None, tmp_path / "t")
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match=r"transforms\.json: has no frame with an image.*frames have no image"):
        import_model("nerfstudio", folder, None, tmp_path / "t")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"frames": []}, "has no `frames`"),
        ({"frames": [7]}, "has missing or invalid values"),
        ({"fl_x": "wide"}, "has missing or invalid values: could not convert"),
        ({"fl_x": 0}, "the intrinsics of"),
        ({"camera_model": "FISHEYE624"}, "has the camera model FISHEYE624, which is not supported"),
        ({"k4": 0.1}, "k4, k5, k6 of a perspective camera are not supported"),
        ({"applied_scale": 0}, "can't be undone"),
        ({"applied_transform": [[1, 2], [3, 4]]}, "applied_transform is not a matrix"),
        ({"applied_transform": np.diag([1.0, 1, 3, 1]).tolist()}, "applied_transform is not a rotation"),
    ],
)
def test_invalid_values_are_rejected(tmp_path: Path, change: dict[str, Any], cause: str) -> None:
    path = write(tmp_path / "transforms.json", BROWN, plain())
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    with pytest.raises(InputError, match=f"transforms.json: .*{cause}"):
        read("nerfstudio", path, images())


def test_frame_without_a_valid_pose_is_rejected(tmp_path: Path) -> None:
    path = write(tmp_path / "transforms.json", BROWN, plain())
    body = json.loads(path.read_text(encoding="utf-8"))
    body["frames"][2]["transform_matrix"][0][0] = 5.0
    path.write_text(json.dumps(body), encoding="utf-8")
    with pytest.raises(InputError, match=r"transform_matrix of frame 2 \(.*\) is not a rotation"):
        read("nerfstudio", path, images())
    del body["frames"][2]["transform_matrix"]
    path.write_text(json.dumps(body), encoding="utf-8")
    with pytest.raises(InputError, match="no 'transform_matrix'"):
        read("nerfstudio", path, images())


@pytest.mark.parametrize(
    ("inside", "message"),
    [("keyframes", "raw data of Polycam.*ns-process-data polycam"), ("sparse", "project of COLMAP.*import colmap")],
)
def test_captures_without_a_transforms_json_are_named(tmp_path: Path, inside: str, message: str) -> None:
    (tmp_path / inside).mkdir()
    with pytest.raises(InputError, match=message):
        read("nerfstudio", tmp_path, tmp_path)


def test_command_finds_photos_beside_the_file(tmp_path: Path) -> None:
    folder = copied(tmp_path / "data")
    files = {f"C:\\phone\\images\\{Path(name).stem}": pose for name, pose in shots()}  # no suffix, as by instant-ngp
    write_ply(folder / "p.ply", np.random.default_rng(0).uniform(0, 9, (500, 3)))
    path = write(folder / "transforms.json", BROWN | {"ply_file_path": "p.ply"}, files)
    for given in (folder, path):
        done = CliRunner().invoke(app, ["import", "nerfstudio", str(given), "-o", str(tmp_path / "t"), "--overwrite"])
        assert done.exit_code == 0, done.output
        assert len(read_tile(tmp_path / "t").views) == len(shots())
