"""COLMAP models: text and binary give the same tile, and points project onto their observations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.types import F64, Frame, PointCloud
from scan2sim.pipeline.importers.photogrammetry import import_model
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.photogrammetry import Photos
from scan2sim.pipeline.io.photogrammetry.colmap import camera_of, read
from scan2sim.pipeline.io.tile import read_tile
from tests.present import present

pycolmap = pytest.importorskip("pycolmap")

CAMERAS = {
    "SIMPLE_PINHOLE": [500, 320.5, 240],
    "PINHOLE": [500, 510, 320.5, 240],
    "SIMPLE_RADIAL": [500, 320.5, 240, -0.05],
    "RADIAL": [500, 320.5, 240, -0.05, 0.01],
    "OPENCV": [500, 510, 320.5, 240, -0.05, 0.01, 0.001, -0.002],
    "FULL_OPENCV": [500, 510, 320.5, 240, -0.05, 0.01, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001],
    "SIMPLE_FISHEYE": [300, 320.5, 240],
    "FISHEYE": [300, 310, 320.5, 240],
    "SIMPLE_RADIAL_FISHEYE": [300, 320.5, 240, 0.01],
    "RADIAL_FISHEYE": [300, 320.5, 240, 0.01, -0.002],
    "OPENCV_FISHEYE": [300, 310, 320.5, 240, 0.01, -0.002, 0.001, 0.0005],
    "EQUIRECTANGULAR": [640, 480],
}


def make_model(folder: Path, kinds: list[str], n: int = 40) -> tuple[Any, dict[str, F64]]:
    """A reconstruction with a camera and a photo of each kind, and COLMAP's own projections of its points."""
    rng = np.random.default_rng(1)
    model = pycolmap.Reconstruction()
    points = rng.uniform([97, 48, 4], [103, 52, 9], (n, 3))
    for point in points:
        model.add_point3D(point, pycolmap.Track(), rng.integers(0, 256, 3).astype(np.uint8))
    pixels = {}
    (folder / "images" / "cam").mkdir(parents=True)
    for i, kind in enumerate(kinds, start=1):
        camera = pycolmap.Camera(camera_id=i, model=kind, width=640, height=480, params=CAMERAS[kind])
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"cam/{i:03d}.png", camera_id=i, image_id=i)
        turn = pycolmap.Rotation3d(np.array([0.02 * i, -0.1, 0.05]))
        centre = np.array([100.0 + 0.3 * i, 50.1, 0.2])
        pose = pycolmap.Rigid3d(turn, -turn.matrix() @ centre)
        model.add_image_with_trivial_frame(image, pose)
        local = points @ pose.rotation.matrix().T + pose.translation
        pixels[f"cam/{i:03d}"] = np.array([camera.img_from_cam(point) for point in local])
        cv2.imwrite(str(folder / "images" / f"cam/{i:03d}.png"), np.full((480, 640, 3), i, np.uint8))
    for form in ("bin", "txt"):
        (folder / form).mkdir()
    model.write_binary(folder / "bin")
    model.write_text(folder / "txt")
    return model, pixels


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_points_project_onto_their_observations(tmp_path: Path, form: str) -> None:
    model, pixels = make_model(tmp_path, list(CAMERAS))
    tile = read_tile(import_model("colmap", tmp_path / form, tmp_path / "images", tmp_path / "tile"))
    points = tile.frame.to_local([point.xyz for _, point in sorted(model.points3D.items())])
    assert len(tile.views) == len(CAMERAS)
    for view in tile.views:
        local = (points - view.centre) @ view.T_world_cam[:3, :3]
        uv, _ = project(view.camera, local)
        expected = pixels[view.name.removeprefix("photos/")] - 0.5  # centre of the top left pixel at (0, 0)
        assert np.abs(uv - expected).max() < 1e-3, view.camera


def test_text_and_binary_give_the_same_tile(tmp_path: Path) -> None:
    make_model(tmp_path, ["OPENCV", "PINHOLE"])
    tiles = [
        import_model("colmap", tmp_path / f, tmp_path / "images", tmp_path / f"t_{f}", name="t") for f in ("bin", "txt")
    ]
    assert tiles[0].read_text(encoding="utf-8") == tiles[1].read_text(encoding="utf-8")
    first, second = (read_tile(tile) for tile in tiles)
    a, b = (clouds.read(tile.clouds[0], tile.frame) for tile in (first, second))
    assert np.array_equal(a.xyz, b.xyz) and np.array_equal(present(a.rgb), present(b.rgb))


def test_photos_without_lines_of_observations_are_all_read(tmp_path: Path) -> None:
    """Scripts and apps write images.txt without the (empty) second line of each photo."""
    make_model(tmp_path, ["OPENCV", "PINHOLE", "PINHOLE"])
    file = tmp_path / "txt" / "images.txt"
    rows = [line for line in file.read_text(encoding="utf-8").splitlines() if line.startswith("#") or ".png" in line]
    before = read(tmp_path / "txt", Photos(tmp_path / "images"))
    file.write_text("\n".join(rows), encoding="utf-8")
    after = read(tmp_path / "txt", Photos(tmp_path / "images"))
    assert [shot.file for shot in after.shots] == [shot.file for shot in before.shots] and len(after.shots) == 3
    assert np.allclose(after.centres, before.centres)


def test_sparse_points_keep_position_and_colour(tmp_path: Path) -> None:
    model, _ = make_model(tmp_path, ["PINHOLE"])
    tile = read_tile(import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "tile"))
    cloud = clouds.read(tile.clouds[0], tile.frame)
    points = [point for _, point in sorted(model.points3D.items())]
    assert np.abs(tile.frame.to_crs(cloud.xyz) - [p.xyz for p in points]).max() < 1e-3
    assert np.array_equal(present(cloud.rgb), [p.color for p in points])


def test_up_and_scale_transform_photos_and_points_alike(tmp_path: Path) -> None:
    make_model(tmp_path, ["PINHOLE"])
    plain = read_tile(import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "a"))
    turned = read_tile(
        import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "b", up="photos", scale=2.0)
    )
    up = -turned.views[0].T_world_cam[:3, 1]
    assert np.allclose(up, [0, 0, 1], atol=1e-6)
    distances = [
        np.linalg.norm(clouds.read(tile.clouds[0], tile.frame).xyz - tile.views[0].centre, axis=1)
        for tile in (plain, turned)
    ]
    assert np.allclose(2 * distances[0], distances[1], atol=5e-3)


def test_given_cloud_replaces_the_sparse_points(tmp_path: Path) -> None:
    make_model(tmp_path, ["PINHOLE"])
    first = import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "a")
    tile = read_tile(
        import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "b", cloud=first.parent / "cloud.laz")
    )
    assert tile.clouds[0].read_bytes() == (first.parent / "cloud.laz").read_bytes()


def test_cloud_is_transformed_with_its_model_unless_it_has_a_crs(tmp_path: Path) -> None:
    model, _ = make_model(tmp_path, ["PINHOLE"])
    points = np.array([point.xyz for _, point in sorted(model.points3D.items())])
    cloud = tmp_path / "dense.xyz"
    np.savetxt(cloud, points, "%.4f")
    tile = read_tile(
        import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "a", cloud=cloud, scale=2.0)
    )
    moved = clouds.read(tile.clouds[0], tile.frame)
    assert np.abs(moved.frame.to_crs(moved.xyz) - 2 * points).max() < 2e-3
    placed = tmp_path / "placed.laz"
    las.write(placed, PointCloud(Frame("EPSG:32632", (5e5, 5e6, 0.0)), points.astype(np.float32)))
    with pytest.raises(SettingError, match="Align model and cloud first"):
        import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "c", cloud=placed, scale=2.0)


def test_unsupported_camera_model_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    camera = pycolmap.Camera.create_from_model_name(3, "FOV", 500.0, 640, 480)
    with pytest.raises(InputError, match=r"model_folder: camera 3 has the model FOV.*image_undistorter"):
        camera_of(Path("model_folder"), camera)


def test_failed_import_leaves_no_files(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: contains no COLMAP model.*sparse/0"):
        import_model("colmap", tmp_path / "empty", tmp_path, tmp_path / "tile")
    make_model(tmp_path, ["PINHOLE", "OPENCV"])
    (tmp_path / "images/cam/002.png").unlink()
    with pytest.raises(InputError, match=r"002\.png: file not found"):
        import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "tile")
    cameras = tmp_path / "bin" / "cameras.bin"
    cameras.write_bytes(cameras.read_bytes()[:20])
    with pytest.raises(InputError, match="is not a readable COLMAP model"):
        import_model("colmap", tmp_path / "bin", tmp_path / "images", tmp_path / "tile")
    assert not (tmp_path / "tile").exists() and not list(tmp_path.glob(".tile*"))


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_damaged_models_are_rejected_or_read_without_a_crash(tmp_path: Path, form: str) -> None:
    make_model(tmp_path, ["OPENCV", "PINHOLE"])
    rng = np.random.default_rng(0)
    refused = 0
    for file in sorted((tmp_path / form).glob("[cip]*")):
        whole = file.read_bytes()
        for i in range(100):
            at = int(rng.integers(len(whole)))
            flipped = bytearray(whole)
            flipped[at] = int(rng.integers(256))
            file.write_bytes(whole[:at] if i % 2 else bytes(flipped))
            try:
                read(tmp_path / form, Photos(tmp_path / "images"))
            except InputError:
                refused += 1
        file.write_bytes(whole)
    assert refused > 100
    read(tmp_path / form, Photos(tmp_path / "images"))


def fused(folder: Path) -> Path:
    """Stereo fusion by COLMAP of six photos of a wall 5 m away, red left of x = 0, green right of it.

    The depth maps, whose computation needs a GPU, are synthetic.
    """
    width, height, f, n = 64, 48, 60.0, 6
    for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / name).mkdir(parents=True)

    def write(kind: str, name: str, values: np.ndarray) -> None:
        head = f"{width}&{height}&{values.shape[2]}&".encode()
        body = values.astype(np.float32).transpose(2, 0, 1).tobytes()
        (folder / "stereo" / kind / f"{name}.geometric.bin").write_bytes(head + body)

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=width, height=height, params=[f, f, 32, 24])
    model.add_camera_with_trivial_rig(camera)
    random = np.random.default_rng(0)
    wall = np.column_stack([random.uniform(-1, 2.5, 60), random.uniform(-1, 1, 60), np.full(60, 5.0)])
    for i in range(n):
        centre = np.array([0.3 * i, 0.0, 0.0])
        pixels = pycolmap.Point2DList([pycolmap.Point2D(f * (p - centre)[:2] / 5 + [32, 24]) for p in wall])
        image = pycolmap.Image(name=f"{i}.png", camera_id=1, image_id=i + 1, points2D=pixels)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -centre))
        write("depth_maps", f"{i}.png", np.full((height, width, 1), 5.0))
        write("normal_maps", f"{i}.png", np.tile([0.0, 0.0, -1.0], (height, width, 1)))
        right = (np.arange(width) + 0.5 - 32) * 5 / f + centre[0] > 0
        row = np.where(right[:, None], [20, 200, 30], [30, 20, 200]).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{i}.png"), np.tile(row, (height, 1, 1)))
    for k, point in enumerate(wall):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, k) for i in range(n)])
        model.add_point3D(point, track, np.array([9, 9, 9], np.uint8))
    (folder / "stereo" / "fusion.cfg").write_text("".join(f"{i}.png\n" for i in range(n)), encoding="utf-8")
    model.write(folder / "sparse")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.check_num_images = 2, n - 1
    pycolmap.stereo_fusion(folder / "fused.ply", folder, options=options, output_type="PLY")
    return folder / "fused.ply"


def test_dense_cloud_fused_by_colmap_is_imported(tmp_path: Path) -> None:
    cloud = fused(tmp_path)
    assert b"property float nx" in cloud.read_bytes()[:300]
    path = import_model("colmap", tmp_path / "sparse", tmp_path / "images", tmp_path / "tile", cloud=cloud)
    tile = read_tile(path)
    read = clouds.read(tile.clouds[0], tile.frame)
    xyz = tile.frame.to_crs(read.xyz)
    assert len(xyz) > 1000 and np.abs(xyz[:, 2] - 5).max() < 1e-3 and np.ptp(xyz[:, 0]) > 5
    assert read.rgb is not None
    left, right = read.rgb[xyz[:, 0] < -0.2], read.rgb[xyz[:, 0] > 0.2]
    assert (left == [200, 20, 30]).all() and (right == [30, 200, 20]).all() and len(left) and len(right)


@pytest.mark.slow
def test_real_photos_are_placed_by_their_gps(real_data: Path, tmp_path: Path) -> None:
    """Reconstruction by COLMAP of a walk along a street; the photos contain a phone's GPS positions."""
    images, database = real_data / "opensfm_lund" / "images", tmp_path / "database.db"
    extraction, mapping = pycolmap.FeatureExtractionOptions(), pycolmap.IncrementalPipelineOptions()
    extraction.num_threads = 1
    extraction.max_image_size, extraction.sift.max_num_features = 800, 2000
    mapping.mapper.init_min_num_inliers, mapping.mapper.abs_pose_min_num_inliers = 60, 15
    pycolmap.set_random_seed(0)
    mapping.num_threads, mapping.random_seed = 1, 0  # maps are not reproducible with several threads
    mapping.mapper.num_threads, mapping.mapper.random_seed = 1, 0
    mapping.ba_refine_extra_params = False  # not observable on a straight walk
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction)
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    pycolmap.match_exhaustive(database, matching_options=matching)
    maps = pycolmap.incremental_mapping(database, images, tmp_path, options=mapping)
    best = max(maps.values(), key=lambda found: found.num_reg_images())
    assert best.num_reg_images() >= 15
    (tmp_path / "model").mkdir()
    best.write(tmp_path / "model")
    warned: list[str] = []
    tile = read_tile(
        import_model("colmap", tmp_path / "model", images, tmp_path / "tile", gps=True, warn=warned.append)
    )
    assert tile.frame.crs == "EPSG:32633" and "georeferenced by the GPS of" in warned[0]
    poses = np.array([view.T_world_cam for view in tile.views])
    assert -poses[:, 2, 1].mean() > 0.9  # the phone was held upright, which GPS does not observe
    assert 50 < np.ptp(poses[:, 1, 3]) < 250 and np.ptp(poses[:, 2, 3]) < 15  # a level street of 170 m to the north
    assert poses[:, 1, 2].mean() > 0.8  # the photos look along the street
