"""COLMAP's incremental structure from motion, by pycolmap: features, matches, mapping, dense stereo.

These functions run native code that may crash, and print: call them through `pipeline.core.sandbox`. Features and
matches are kept in COLMAP's database, so an interrupted reconstruction resumes from there.

Source: Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016; Schoenberger et al., Pixelwise View
Selection for Unstructured Multi-View Stereo, ECCV 2016.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scan2sim.pipeline.core.types import F64

SEED = 0
"""Seed of all random samples, so that a reconstruction is repeatable."""

MOTION_PAIRS = 2000
"""Pairs by which the motion of the camera is measured."""
MIN_ERROR_PX = 0.5
"""Least standard deviation of a feature in a photo."""


@dataclass(frozen=True)
class Lens:
    """Lens of a camera as COLMAP needs it.

    Attributes:
        model: name of the camera model.
        params: its parameters in COLMAP's order, where pixels begin at their corner; none if the focal length is
            unknown.
        fixed: whether the mapping keeps it.
    """

    model: str = "SIMPLE_RADIAL"
    params: tuple[float, ...] = ()
    fixed: bool = False


@dataclass(frozen=True)
class Component:
    """Connected part of a reconstruction: `folder` of the model, `names` of its photos, points, error in pixels."""

    folder: Path
    names: tuple[str, ...]
    points: int
    error: float


def add_photos(database: Path, images: Path, names: Sequence[str], lens: Lens) -> int:
    """Add photos of one camera to the database, in order, if they aren't there; returns the camera's id."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = lens.model, ",".join(f"{value:.12g}" for value in lens.params)
    with pycolmap.Database.open(database) as opened:
        there = {image.name: image.camera_id for image in opened.read_all_images()}
    missing = [name for name in names if name not in there]
    if len(missing) < len(names):  # an interrupted run has added some
        reader.existing_camera_id = next(there[name] for name in names if name in there)
    if missing:
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, images, camera_mode=mode, image_names=missing, options=reader)
    with pycolmap.Database.open(database) as opened:
        return int(opened.read_image_with_name(names[0]).camera_id)


def extract(database: Path, images: Path, names: Sequence[str], features: int = 8192) -> None:
    """Extract SIFT features of photos in the database; those that have features already are skipped.

    Args:
        database: COLMAP's database.
        images: folder of the photos.
        names: photos of one camera.
        features: greatest number per photo.
    """
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = features
    pycolmap.extract_features(
        database, images, image_names=list(names), camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=options
    )


def match(database: Path, pairs: Sequence[tuple[str, str]]) -> None:
    """Match and verify pairs of photos; those matched already are skipped."""
    import pycolmap

    pycolmap.set_random_seed(SEED)
    verification, pairing = pycolmap.TwoViewGeometryOptions(), pycolmap.ImportedPairingOptions()
    verification.ransac.random_seed = SEED
    with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
        file.writelines(f"{one} {other}\n" for one, other in pairs)
        file.flush()
        pairing.match_list_path = file.name
        pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)


def displacements(database: Path) -> F64:
    """Median displacement (K,) of the matched features of pairs of photos, relative to the photo's width.

    Of many pairs, `MOTION_PAIRS` are used.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        widths = {camera.camera_id: camera.width for camera in opened.read_all_cameras()}
        matched = [key for key, count in zip(*opened.read_two_view_geometry_num_inliers(), strict=True) if count]
        found = []
        for key in matched[:: -(-len(matched) // MOTION_PAIRS) or 1]:
            one, other = pycolmap.pair_id_to_image_pair(key)
            matches = opened.read_two_view_geometry(one, other).inlier_matches
            moved = opened.read_keypoints(one)[matches[:, 0], :2] - opened.read_keypoints(other)[matches[:, 1], :2]
            found.append(float(np.median(np.linalg.norm(moved, axis=1))) / widths[images[one].camera_id])
    return np.array(found)


def reconstruct(
    database: Path, images: Path, out: Path, fixed_cameras: Sequence[int] = (), names: Mapping[str, str] | None = None
) -> list[Component]:
    """Map the matched photos; returns the connected parts, largest first. Each is a folder in `out`, in binary format.

    The limits for the first pair are those of vehicles, which move forward: COLMAP's defaults find no start then.

    Args:
        database: features and matches.
        images: folder of the photos, for the colours of the points.
        out: existing folder.
        fixed_cameras: ids of cameras whose lenses are kept.
        names: new names of the photos in the models, by their names in the database.
    """
    import pycolmap

    pycolmap.set_random_seed(SEED)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = 1  # the result on several threads depends on their timing
    options.min_model_size = 3
    options.max_num_models = 10
    options.ba_refine_principal_point = False
    options.constant_cameras = options.mapper.constant_cameras = set(fixed_cameras)
    limit = _distortion_limit(database, options.max_extra_param)
    options.max_extra_param = options.mapper.max_extra_param = options.triangulation.max_extra_param = limit
    options.mapper.init_max_forward_motion = 1
    options.mapper.init_min_tri_angle = 2
    models: dict[int, Any] = pycolmap.incremental_mapping(database, images, out, options)
    found = []
    for key, model in models.items():
        for image in model.images.values():
            image.name = (names or {}).get(image.name, image.name)
        model.write_binary(out / str(key))
        posed = tuple(sorted(model.images[i].name for i in model.reg_image_ids()))
        error = float(model.compute_mean_reprojection_error())
        found.append(Component(out / str(key), posed, int(model.num_points3D()), error))
    return sorted(found, key=lambda one: (-len(one.names), one.names))


def _distortion_limit(database: Path, default: float) -> float:
    """Distortion coefficient above which COLMAP rejects a camera: those of given lenses (rational ones) are larger."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        given = [camera.params[camera.extra_params_idxs()] for camera in opened.read_all_cameras()]
    return max([default, *(2 * float(np.abs(values).max()) for values in given if len(values))])


def dense_stereo(model: Path, images: Path, workspace: Path, out: Path, max_image_size: int) -> int:
    """Dense cloud of a model by patch match stereo and fusion, written to the PLY file `out`; returns its points.

    Needs CUDA. Args: the model's folder; folder of the photos; folder for depth maps; file; longer side of the photos.
    """
    import pycolmap

    undistort = pycolmap.UndistortCameraOptions()
    undistort.max_image_size = max_image_size
    pycolmap.undistort_images(workspace, model, images, undistort_options=undistort)
    pycolmap.patch_match_stereo(workspace)
    fused = pycolmap.stereo_fusion(out, workspace, output_type="PLY")
    return int(fused.num_points3D())


def has_cuda() -> bool:
    """Whether pycolmap is built with CUDA, which dense stereo needs."""
    import pycolmap

    return bool(pycolmap.has_cuda)


def transform(model: Path, out: Path, similarity: tuple[float, F64, F64]) -> None:
    """Write a model transformed by a similarity (scale, rotation, translation) into the folder `out`."""
    import pycolmap

    scale, rotation, translation = similarity
    found = pycolmap.Reconstruction(model)
    found.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), translation))
    found.write_binary(out)


def precise_points(model: Path) -> tuple[F64, F64]:
    """Points (N, 3) seen by three photos or more, and their standard deviations (N,) along the ray, model's unit."""
    import pycolmap

    found = pycolmap.Reconstruction(model)
    centres = {key: image.projection_center() for key, image in found.images.items()}
    cameras = {key: found.cameras[image.camera_id] for key, image in found.images.items()}
    focal = {key: one.mean_focal_length() or one.width / (2 * np.pi) for key, one in cameras.items()}  # 0: a panorama
    points, sigma = [], []
    for point in found.points3D.values():
        seen = [element.image_id for element in point.track.elements]
        if len(seen) < 3:
            continue
        rays = point.xyz - np.array([centres[key] for key in seen])
        ranges = np.linalg.norm(rays, axis=1)
        rays /= ranges[:, None]
        parallax = np.arccos(np.clip((rays @ rays[0]).min(), -1.0, 1.0))
        points.append(point.xyz)
        sigma.append(ranges.min() * max(point.error, MIN_ERROR_PX) / focal[seen[0]] / max(parallax, 1e-4))
    return np.array(points).reshape(-1, 3), np.array(sigma)
