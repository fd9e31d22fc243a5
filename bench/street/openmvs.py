"""OpenMVS's TextureMesh on the world's own mesh and photos, and its texture beside the world's on the same pixels.

`bench.street --openmvs FOLDER`: FOLDER has the programs `InterfaceCOLMAP` and `TextureMesh` (version 2), which are run
for each street, or for each street a folder (`FOLDER/odo04`) with a textured mesh (`*.obj`) in the world's local frame.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.street import score
from bench.street.world import Meshes, Photo, Rendering, sample
from scan2sim.pipeline.core.types import F64, U8, Bools

FILL_RGB = ((255, 127, 39), (255, 136, 41), (39, 127, 255), (41, 136, 255))
"""Colour of faces that no photo sees, as it is by default and sharpened, in either order of channels: no texture."""
FILL_TOLERANCE = 12
SAME_SURFACE_SHARE, SAME_SURFACE_M = 0.01, 0.05
"""Difference in distance up to which both show the same surface: holes of the textured mesh show what is behind."""


def textured_mesh(folder: Path, street: str, mesh: Meshes, photos: Mapping[int, Photo], out: Path) -> Meshes:
    """The street's mesh as textured by OpenMVS, without faces that no photo sees.

    Args:
        folder: as the command line's.
        street: name of the street.
        mesh: surfaces of the world.
        photos: photos to texture it with, by number: without those held out.
        out: folder for OpenMVS's files, if it is run.
    """
    found = sorted((folder / street).glob("*.obj"))
    return Meshes(found or [_run(folder, mesh, photos, out)], is_textured)


def is_textured(uv: npt.NDArray[Any], page: U8) -> Bools:
    """(F,) whether faces with UV coordinates (F, 3, 2) have another colour than the fill colour at their centre."""
    colour = sample(page, uv.mean(axis=1))
    apart = np.abs(colour[:, None] - np.array(FILL_RGB)).max(axis=2)
    return np.asarray((apart > FILL_TOLERANCE).all(axis=1))


def compare(views: Iterable[tuple[Photo, Rendering, Bools]], other: Meshes) -> dict[str, float]:
    """Means over the photos of PSNR in dB, ours minus OpenMVS's, on pixels of surface that both have textured.

    `gain_db` is after a gain per channel (each has its own), `nogain_db` as rendered; `pixels` is their share.

    Args:
        views: held-out photos, the world's renderings, and (H, W) pixels that count.
        other: OpenMVS's mesh.
    """
    rows = []
    for photo, rendering, counts in views:
        rgb, distance, _ = other.render(photo, (0, 0, 0))
        with np.errstate(invalid="ignore"):  # inf - inf
            apart = np.abs(distance - rendering.range)
        same = counts & (apart < SAME_SURFACE_M + SAME_SURFACE_SHARE * rendering.range)
        ours, theirs = (score.similarity(photo.rgb, image, same) for image in (rendering.rgb, rgb))
        gains = [ours[key] - theirs[key] for key in ("psnr_db", "nogain_psnr_db")]
        rows.append((*gains, float(same.mean()), theirs["psnr_db"], theirs["nogain_psnr_db"]))
    keys = ("gain_db", "nogain_db", "pixels", "theirs_psnr_db", "theirs_nogain_psnr_db")
    return {key: float(mean) for key, mean in zip(keys, np.mean(rows, axis=0), strict=True)}


def _run(programs: Path, mesh: Meshes, photos: Mapping[int, Photo], out: Path) -> Path:
    """Texture a mesh; returns the OBJ file. Existing results are reused."""
    import trimesh

    result = out / "textured.obj"
    if result.is_file():
        return result
    _write_colmap(out, photos)
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    plain.export(out / "mesh.ply")
    for program, arguments in (
        ("InterfaceCOLMAP", ("-i", ".", "-o", "scene.mvs", "--image-folder", "images")),
        ("TextureMesh", ("-i", "scene.mvs", "-m", "mesh.ply", "-o", "textured.mvs", "--export-type", "obj")),
    ):
        subprocess.run([str(programs / program), "-w", str(out), *arguments], check=True, cwd=out)
    return result


def _write_colmap(out: Path, photos: Mapping[int, Photo]) -> None:
    """Write photos, without distortion, and cameras as a COLMAP text model; its pixel centres are at half pixels."""
    import cv2
    from PIL import Image
    from scipy.spatial.transform import Rotation

    for name in ("images", "sparse"):
        (out / name).mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for i, (number, photo) in enumerate(sorted(photos.items()), start=1):
        straight = cv2.undistort(photo.rgb, photo.K, np.array(photo.distortion)) if any(photo.distortion) else photo.rgb
        Image.fromarray(straight).save(out / "images" / f"{number:06d}.png")
        height, width = photo.rgb.shape[:2]
        lens: F64 = photo.K[[0, 1, 0, 1], [0, 1, 2, 2]] + np.array([0, 0, 0.5, 0.5])
        cameras.append(f"{i} PINHOLE {width} {height} {' '.join(map(repr, lens.tolist()))}\n")
        T_cam_world = np.linalg.inv(photo.T)
        x, y, z, w = Rotation.from_matrix(T_cam_world[:3, :3]).as_quat().tolist()
        pose = " ".join(map(repr, (w, x, y, z, *T_cam_world[:3, 3].tolist())))
        images.append(f"{i} {pose} {i} {number:06d}.png\n\n")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", [])):
        (out / "sparse" / f"{name}.txt").write_text("".join(lines), encoding="utf-8")
