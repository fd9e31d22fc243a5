"""Lenses of photos: calibrations of other programs, panoramas, and options that don't apply to all photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import F64, Camera
from scan2sim.pipeline.geometry.similarity import fit_robust
from scan2sim.pipeline.io.photogrammetry import Model, Photos, colmap
from scan2sim.slam.reconstruction.lenses import LensParams, check_options, contradictions, lenses
from scan2sim.slam.reconstruction.photos import Photo
from scan2sim.slam.steps.reconstruct import Reconstructed, reconstruct
from tests.fakes import textured_street

COUNT = 6
FISHEYE = Camera("fisheye", 480, 360, 210.0, 212.0, 246.0, 172.0, (0.03, -0.02, 0.004, -0.001))
RATIONAL = Camera("opencv", 480, 360, 400.0, 402.0, 230.0, 185.0, (3.9, 1.2, 1e-3, -5e-4, 0.05, 4.1, 1.9, 0.1))
"""Its coefficients exceed 1, as those of Azure Kinect do, although its distortion is mild."""
SPHERE = Camera("equirectangular", 720, 360)


def kalibr(path: Path, **cameras: Camera) -> Path:
    """A camchain.yaml of Kalibr."""
    names = {"fisheye": "equidistant", "pinhole": "none", "opencv": "radtan"}
    chain = {
        name: {
            "camera_model": "pinhole", "intrinsics": [one.fx, one.fy, one.cx, one.cy],
            "distortion_model": names[one.model], "distortion_coeffs": list(one.distortion),
            "resolution": [one.width, one.height], "rostopic": f"/{name}/image_raw",
        }
        for name, one in cameras.items()
    }  # fmt: skip
    path.write_text(yaml.safe_dump(chain), encoding="utf-8")
    return path


def ros(path: Path, camera: Camera) -> Path:
    """A camera_info file."""
    K = [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1]
    info: dict[str, Any] = {
        "image_width": camera.width, "image_height": camera.height, "camera_name": "front",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K}, "distortion_model": "rational_polynomial",
        "distortion_coefficients": {"rows": 1, "cols": 8, "data": list(camera.distortion)},
    }  # fmt: skip
    path.write_text(yaml.safe_dump(info), encoding="utf-8")
    return path


def written(folder: Path, camera: Camera) -> F64:
    """Photos of a camera along the street, written to `photos`; true poses (P, 4, 4)."""
    quads, T = textured_street.street(), textured_street.poses(COUNT)
    for i, pose in enumerate(T):
        textured_street.write_photo(folder / "photos" / f"{i:02d}.jpg", quads, pose, camera)
    return T


def reconstructed(folder: Path, camera: Path | None = None) -> Model:
    """The reconstruction of `photos`."""
    pytest.importorskip("pycolmap")
    for name in ("checkpoint", "out"):
        (folder / name).mkdir()
    inputs = {"photos": folder / "photos"} | ({} if camera is None else {"camera": camera})
    done = reconstruct(inputs, Reconstructed(features=1500), folder / "out", silent, folder / "checkpoint")
    return colmap.read(done.files["model"], Photos(folder / "photos"))


def errors(model: Model, T: F64) -> tuple[F64, F64]:
    """Errors of the positions (P,) in metres and of the rotations (P,) in degrees, after a similarity."""
    assert [shot.file for shot in model.shots] == [f"{i:02d}.jpg" for i in range(COUNT)]
    onto, _ = fit_robust(model.centres, T[:, :3, 3], 5.0)
    turns = np.einsum("nji,njk->nik", [onto.rotation @ shot.pose[:3, :3] for shot in model.shots], T[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return np.linalg.norm(onto.apply(model.centres) - T[:, :3, 3], axis=1), angles


@pytest.mark.parametrize("camera", [FISHEYE, RATIONAL], ids=["fisheye", "rational"])
def test_a_calibrated_lens_is_kept_and_poses_are_true(camera: Camera, tmp_path: Path) -> None:
    T = written(tmp_path, camera)
    path = tmp_path / "camera.yaml"
    model = reconstructed(tmp_path, kalibr(path, cam0=camera) if camera is FISHEYE else ros(path, camera))
    (found,) = model.cameras.values()
    assert replace(found, distortion=()) == replace(camera, distortion=())
    assert np.allclose(found.distortion, camera.distortion)
    metres, degrees = errors(model, T)
    assert metres.max() < 0.03 and degrees.max() < 0.3


def test_panoramas_are_recognized_and_poses_are_true(tmp_path: Path) -> None:
    T = written(tmp_path, SPHERE)
    model = reconstructed(tmp_path)
    assert list(model.cameras.values()) == [SPHERE]
    metres, degrees = errors(model, T)
    assert metres.max() < 0.03 and degrees.max() < 0.3


def photo(name: str, width: int = 480, height: int = 360, focal: float | None = None) -> Photo:
    return Photo(name, width, height, focal)


def of(photos: Sequence[Photo], file: Path) -> list[tuple[float, ...]]:
    """Focal length and distortion of each camera by a file."""
    found = lenses(file.parent / "photos", photos, LensParams(), file)
    assert all(lens.fixed for lens in found)
    return [lens.params for lens in found]


def test_cameras_of_a_file_are_those_of_the_folders_named_like_them(tmp_path: Path) -> None:
    other = replace(FISHEYE, fx=300.0)
    file = kalibr(tmp_path / "camchain.yaml", cam0=FISHEYE, cam1=other)
    two = [photo("cam0/1.jpg"), photo("cam1/1.jpg"), photo("cam1/2.jpg")]
    assert [params[0] for params in of(two, file)] == [210.0, 300.0]
    with pytest.raises(InputError, match=r"several cameras of 480x360 \(cam0, cam1\)"):
        of([photo("1.jpg")], file)
    single = kalibr(tmp_path / "single.yaml", cam0=FISHEYE)
    assert [params[0] for params in of([photo("a/1.jpg"), photo("b/1.jpg")], single)] == [210.0, 210.0]
    with pytest.raises(InputError, match="cameras for the folders cam0, but none for cam1"):
        of(two, single)


def test_photos_of_other_sizes_than_the_calibration_are_named(tmp_path: Path) -> None:
    file = kalibr(tmp_path / "camchain.yaml", cam0=FISHEYE)
    mixed = [photo("1.jpg"), photo("2.jpg", 960, 720), photo("3.jpg", 960, 720)]
    with pytest.raises(
        InputError, match=r"no camera of 960x720, the size of 2.jpg and 1 other photo .*480x360"
    ) as small:
        of(mixed, file)
    assert "focal = [420" in small.value.remedy
    with pytest.raises(InputError, match="no camera of 360x480, the size of 1.jpg") as turned:
        of([photo("1.jpg", 360, 480)], file)
    assert "turned by 90 degrees" in turned.value.remedy
    file.write_text("cam0: [", encoding="utf-8")
    with pytest.raises(InputError, match="not valid YAML"):
        of([photo("1.jpg")], file)


@pytest.mark.parametrize(
    ("options", "photos", "cause"),
    [
        ({"focal": 400}, [photo("a.jpg"), photo("b.jpg", 960, 720)], "2 sizes .*480x360: a.jpg, 960x720: b.jpg"),
        ({"centre": (240, 180)}, [photo("a.jpg", 480, 360, 400), photo("b.jpg", 360, 480, 400)], "2 sizes"),
        ({"k1": 0.1}, [photo("a.jpg")], "--k1: needs a focal length, which a.jpg doesn't have in its EXIF"),
        ({"centre": (240, 180)}, [photo("a.jpg")], "--centre: needs a focal length"),
        ({"camera": "equirectangular"}, [photo("a.jpg")], "a.jpg is 480x360, not twice as wide as high"),
    ],
)
def test_options_that_do_not_apply_to_all_photos(
    options: dict[str, Any], photos: list[Photo], cause: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=cause):
        lenses(tmp_path, photos, LensParams(**options))


def test_turned_photos_share_a_given_focal_length(tmp_path: Path) -> None:
    found = lenses(tmp_path, [photo("a.jpg"), photo("b.jpg", 360, 480)], LensParams(focal=400))
    assert [lens.params for lens in found] == [(400, 240, 180, 0), (400, 180, 240, 0)]


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        ({"camera": "camera.yaml", "focal": 400}, "--focal: is given beside a file"),
        ({"camera": "camera.yaml", "k1": 0.1}, "--k1: is given beside a file"),
        ({"camera": "equirectangular", "focal": 400}, "--focal: is given beside --camera equirectangular"),
        ({"camera": "equirectangular", "refine_lens": True}, "no lens to refine"),
        ({"camera": "fisheye"}, "unknown model 'fisheye'"),
        ({"refine_lens": True}, "no lens to refine"),
    ],
)
def test_options_that_contradict_each_other(options: dict[str, Any], cause: str) -> None:
    with pytest.raises(SettingError, match=cause):
        check_options(LensParams(**options))


def test_a_given_focal_length_that_contradicts_exif_is_reported(tmp_path: Path) -> None:
    photos = [photo("a.jpg", focal=400), photo("b.jpg", focal=800), photo("c.jpg", focal=800), photo("d.jpg")]
    found = lenses(tmp_path, photos, LensParams(focal=420))
    (warning,) = contradictions(photos, found)
    assert "focal length of b.jpg and 1 other photo is 800 pixels, but the given one is 420" in warning
    assert not contradictions(photos, lenses(tmp_path, photos, LensParams()))


def test_panoramas_by_their_metadata(tmp_path: Path) -> None:
    grey = np.zeros((64, 128), np.uint8)
    grey[:, 64:] = 255  # its edges don't meet
    cv2.imwrite(str(tmp_path / "a.jpg"), grey)
    wide = photo("a.jpg", 128, 64, focal=50.0)
    assert [lens.model for lens in lenses(tmp_path, [wide], LensParams(), images=tmp_path)] == ["SIMPLE_RADIAL"]
    jpeg = (tmp_path / "a.jpg").read_bytes()
    xmp = b'http://ns.adobe.com/xap/1.0/\0<rdf:Description GPano:ProjectionType="equirectangular"/>'
    segment = b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    assert [lens.model for lens in lenses(tmp_path, [wide], LensParams(), images=tmp_path)] == ["EQUIRECTANGULAR"]
    forced = LensParams(camera="pinhole")
    assert [lens.model for lens in lenses(tmp_path, [wide], forced, images=tmp_path)] == ["SIMPLE_RADIAL"]
