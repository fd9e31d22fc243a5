"""Splats of a street's world: held-out photos, the right-hand camera that was never trained on, and held-out sweeps.

Whole frames are compared; pixels of vehicles and people don't count. Splats are shown with the exposure of the world. A
gain per channel is solved for each photo over all pixels that count; without one, photos are compared as they are, and
once more with the splats in the exposure of the nearest photos of the training.
"""

from __future__ import annotations

import contextlib
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bench.paths import ROOT
from bench.street import frame, lidar, score
from bench.street.world import Photo
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.types import F64, I64, U8, Bools, Camera
from scan2sim.pipeline.io import splat_files
from scan2sim.texturing.ms_ssim import ms_ssim
from scan2sim.texturing.splats.view import SplatImage, SplatRenderer

ABLATION = ROOT / "bench-out" / "street_splats" / "rows.json"
"""Rows of `splat_ablation`."""
NEAREST_M = 5.0
"""Distance of what is nearest to the right-hand camera: gives the largest shift between the two images."""
NEAR_SHARE_M = 0.22
"""Range error of returns that count as near."""
HIDDEN_PX, HIDDEN_SHARE = 3, 0.95
"""Returns are compared where none within this number of pixels is nearer than this share of their range: the camera is
beside the scanner and doesn't see all that it sees."""


def metrics(
    layer: SplatLayer,
    used: Mapping[str, float],
    data: Path,
    tile: Path,
    run: Path,
    photos: Mapping[int, Photo],
    hits: Mapping[int, Bools],
    vehicles: Callable[[int, Photo], Bools],
    pictures: Path,
) -> dict[str, Any]:
    """Score the splats of a street.

    Args:
        layer: the splats, in the local metres of the run.
        used: what the training used (`resources`, `resources_of`).
        data, tile, run: folders of the recording, the imported tile and the run.
        photos: held-out photos by number, at their refined poses.
        hits: (H, W) pixels of each where the mesh has a surface.
        vehicles: function of a photo's number and the photo that returns its (H, W) pixels of vehicles and people.
        pictures: folder for pictures of photo, splats and difference.
    """
    renderer = SplatRenderer(layer)
    rows = {}
    for number, photo in photos.items():
        counts = ~vehicles(number, photo)
        rgb = rendered(renderer, photo).rgb
        # one camera takes the photos of these streets
        exposed = renderer.view(camera_of(photo), photo.T, as_photo=next(iter(layer.cameras), "")).rgb
        rows[number] = _similarity(photo.rgb, rgb, counts, hits[number])
        rows[number]["exposed_psnr_db"] = score.psnr(score.squared_error(photo.rgb, exposed, counts))
        frame.picture(pictures / f"splats_{number:02d}.png", photo.rgb, rgb, counts)
    right = _right(data, renderer, photos, vehicles, pictures)
    with tempfile.TemporaryDirectory() as folder:
        spz = Path(folder) / "splats.spz"
        splat_files.write(spz, layer.with_shell().y_up(), np.zeros(3))
        megabytes = spz.stat().st_size / 1e6
    started = time.process_time()
    rendered(renderer, next(iter(photos.values())))
    render_ms = 1000 * (time.process_time() - started)
    return {
        "photos": rows,
        **{key: float(np.mean([row[key] for row in rows.values()])) for key in next(iter(rows.values()))},
        **right,
        **_depth(data, tile, run, renderer, photos, vehicles),
        "splats": len(layer.splats),
        "mb": megabytes,
        "render_ms": render_ms,
        **used,
    }


def resources_of(run: Path) -> dict[str, float]:
    """Processor time and memory of the step `splats` of a run."""
    about = json.loads(lidar.newest(run, "splats", "manifest.json").read_text(encoding="utf-8"))
    return {"cpu_minutes": about["cpu_seconds"] / 60, "memory_gb": about["peak_mb"] / 1000}


@contextlib.contextmanager
def resources() -> Iterator[dict[str, float]]:
    """Processor time of what runs inside, and peak memory of the process, written at the end."""
    used: dict[str, float] = {}
    started = time.process_time()
    yield used
    used["cpu_minutes"] = (time.process_time() - started) / 60
    used["memory_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def rendered(renderer: SplatRenderer, photo: Photo) -> SplatImage:
    """The splats from a photo's pose, with the exposure of the world."""
    return renderer.view(camera_of(photo), photo.T)


def camera_of(photo: Photo) -> Camera:
    """The camera of a photo."""
    height, width = photo.rgb.shape[:2]
    distorted = any(photo.distortion)
    return Camera(
        "opencv" if distorted else "pinhole", width, height, photo.K[0, 0], photo.K[1, 1], photo.K[0, 2], photo.K[1, 2],
        photo.distortion if distorted else (),
    )  # fmt: skip


def _similarity(photo: U8, rgb: U8, used: Bools, hit: Bools) -> dict[str, float]:
    like = score.apply_gain(rgb, score.solve_gain(photo, rgb, used))
    return {
        "psnr_db": score.psnr(score.squared_error(photo, like, used)),
        "nogain_psnr_db": score.psnr(score.squared_error(photo, rgb, used)),
        "ssim": score.ssim(photo, like, used),
        "msssim": ms_ssim(photo, np.round(like).astype(np.uint8), used),
        "surface_psnr_db": score.psnr(score.squared_error(photo, like, used & hit)),
        "elsewhere_psnr_db": score.psnr(score.squared_error(photo, like, used & ~hit)),
    }


def _right(
    data: Path,
    renderer: SplatRenderer,
    photos: Mapping[int, Photo],
    vehicles: Callable[[int, Photo], Bools],
    pictures: Path,
) -> dict[str, Any]:
    """PSNR of the right-hand camera's photos, and by how much it is below that of the left ones of the same frames.

    What vehicles and people hide isn't drawn on the right-hand photos: in both, the left photo's pixels don't count,
    nor do those to their left, where the right-hand camera sees what is at least `NEAREST_M` away.
    """
    from PIL import Image
    from scipy.ndimage import binary_dilation

    offset = _right_offset(data)
    rows = {}
    for number, photo in photos.items():
        files = [*data.rglob(f"image_3/{number:06d}.png"), *data.rglob(f"image_03/data/{number:010d}.png")]
        if offset is None or not files:
            continue
        reach = int(np.ceil(photo.K[0, 0] * np.linalg.norm(offset) / NEAREST_M))
        excluded = vehicles(number, photo)
        excluded = binary_dilation(excluded, np.ones((1, 2 * reach + 1)), origin=(0, reach))  # towards the left
        rgb = np.asarray(Image.open(files[0]).convert("RGB"), np.uint8)
        T = photo.T.copy()
        T[:3, 3] += T[:3, :3] @ offset
        other = Photo(rgb, photo.K, T, photo.time, photo.distortion)
        values = []
        for one in (photo, other):
            drawn = rendered(renderer, one).rgb
            like = score.apply_gain(drawn, score.solve_gain(one.rgb, drawn, ~excluded))
            values.append(score.psnr(score.squared_error(one.rgb, like, ~excluded)))
        frame.picture(pictures / f"right_{number:02d}.png", rgb, drawn, ~excluded)
        rows[number] = values
    if not rows:
        return {"right_psnr_db": None, "right_gap_db": None}
    left, right = np.mean(list(rows.values()), axis=0)
    return {"right_psnr_db": float(right), "right_gap_db": float(left - right)}


def _right_offset(data: Path) -> F64 | None:
    """(3,) centre of the right-hand camera in the left one's axes, metres, from KITTI's projection matrices."""
    names = {"calib.txt": ("P2", "P3"), "calib_cam_to_cam.txt": ("P_rect_02", "P_rect_03")}
    for file in [path for name in names for path in data.rglob(name)]:
        rows = dict(line.split(":", 1) for line in file.read_text(encoding="utf-8").splitlines() if ":" in line)
        left, right = (np.array(rows[name].split(), float).reshape(3, 4) for name in names[file.name])
        return np.asarray(np.linalg.solve(left[:, :3], left[:, 3]) - np.linalg.solve(right[:, :3], right[:, 3]))
    return None


def _depth(
    data: Path,
    tile: Path,
    run: Path,
    renderer: SplatRenderer,
    photos: Mapping[int, Photo],
    vehicles: Callable[[int, Photo], Bools],
) -> dict[str, float]:
    """Range error of the splats at the returns of held-out sweeps that the photo of the same frame sees."""
    origin = np.array(json.loads((run / "world" / "metadata.json").read_text(encoding="utf-8"))["origin_m"])
    sweeps, _ = lidar.held_out(data, tile, origin)
    errors = []
    for number, photo in photos.items():
        local = (sweeps.xyz[sweeps.number == number] - photo.T[:3, 3]) @ photo.T[:3, :3]
        local = local[local[:, 2] > 0.5]
        column, row = np.round(photo.pixels(local)).astype(np.int64).T
        height, width = photo.rgb.shape[:2]
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row, distance = column[inside], row[inside], np.linalg.norm(local[inside], axis=1)
        seen = _unhidden(column, row, distance, (height, width)) & ~vehicles(number, photo)[row, column]
        range_ = rendered(renderer, photo).range
        errors.append(np.abs(range_[row, column] - distance)[seen])
    every = np.concatenate(errors)
    return {
        "depth_median_cm": float(100 * np.median(every)),
        "depth_near_share": float((every < NEAR_SHARE_M).mean()),
    }


def _unhidden(column: I64, row: I64, distance: F64, shape: tuple[int, int]) -> Bools:
    """(N,) returns that none of the others near them in the image hides."""
    from scipy.ndimage import minimum_filter

    nearest = np.full(shape, np.inf)
    np.minimum.at(nearest, (row, column), distance)
    nearest = minimum_filter(nearest, 2 * HIDDEN_PX + 1)
    return np.asarray(nearest[row, column] > HIDDEN_SHARE * distance)


def table(found: Mapping[str, Any]) -> None:
    """Print a street's splats."""
    print(
        f"  splats: {found['psnr_db']:.2f} dB / SSIM {found['ssim']:.3f} / MS-SSIM {found['msssim']:.3f}; without gain "
        f"{found['nogain_psnr_db']:.2f} dB, with the exposure of the nearest photos {found['exposed_psnr_db']:.2f} dB; "
        f"where the mesh has a surface {found['surface_psnr_db']:.2f} dB, elsewhere {found['elsewhere_psnr_db']:.2f} dB"
    )
    if found["right_psnr_db"] is not None:
        print(f"    right-hand camera {found['right_psnr_db']:.2f} dB, on the same frames and pixels", end="")
        print(f" {found['right_gap_db']:.2f} below the left")
    print(
        f"    returns of held-out sweeps: median {found['depth_median_cm']:.1f} cm, {found['depth_near_share']:.1%} "
        f"within {100 * NEAR_SHARE_M:.0f} cm; {found['splats']:,} splats, {found['mb']:.1f} MB as SPZ, "
        f"{found['cpu_minutes']:.1f} minutes of processor time, {found['memory_gb']:.1f} GB, "
        f"{found['render_ms']:.0f} ms a frame"
    )


def gsplat_gap_db(rows: Path) -> float | None:
    """Greatest difference in PSNR of splats trained on the CPU and on a GPU.

    Args:
        rows: rows of `bench.street.splat_ablation --parts cpu gpu`.

    Returns:
        dB, over the streets that have both; None: they weren't measured, as without a GPU.
    """
    found = json.loads(rows.read_text(encoding="utf-8")) if rows.is_file() else {}
    cpu, gpu = found.get("cpu", {}), found.get("gpu", {})
    return max((abs(cpu[name]["psnr_db"] - gpu[name]["psnr_db"]) for name in cpu.keys() & gpu.keys()), default=None)


def result(streets: Mapping[str, Mapping[str, Any]]) -> dict[str, float | None]:
    """Results that have targets: of the worst street, unless a name says otherwise.

    `splat_nogain_gap_db` is with the exposure of the nearest photos, `splat_world_gap_db` with that of the world.
    """
    odo = streets.get("odo04", {})

    def worst(key: str, sign: int = 1) -> float | None:
        return min((one[key] for one in streets.values() if one[key] is not None), key=lambda v: sign * v, default=None)

    def gap(key: str) -> float | None:
        return max((one["psnr_db"] - one[key] for one in streets.values()), default=None)

    return {
        "splat_odo04_psnr_db": odo.get("psnr_db"),
        "splat_odo04_ssim": odo.get("ssim"),
        "splat_psnr_db": worst("psnr_db"),
        "splat_ssim": worst("ssim"),
        "splat_nogain_gap_db": gap("exposed_psnr_db"),
        "splat_world_gap_db": gap("nogain_psnr_db"),
        "right_camera_gap_db": worst("right_gap_db", -1),
        "splat_surface_psnr_db": odo.get("surface_psnr_db"),
        "splat_depth_median_cm": worst("depth_median_cm", -1),
        "splat_depth_near_share": worst("depth_near_share"),
        "splat_cpu_minutes": odo.get("cpu_minutes"),
        "splat_render_ms": worst("render_ms", -1),
        "splat_mb": worst("mb", -1),
        "splat_memory_gb": worst("memory_gb", -1),
        "gsplat_gap_db": gsplat_gap_db(ABLATION),
    }
