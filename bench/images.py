"""Compare OpenCV and OpenImageIO: supported files, accuracy, speed and memory for photos and texture pages.

`python -m bench.images [--width 5760] [--panorama 16384] [--repeats 5] [--parts reading panorama colours writing]`:
all files are generated in a temporary folder from a photo of the demo tile, scaled up, with noise.

- reading: seconds, and maximum error (in 255 levels; JPEG: relative to OpenCV's pixels).
- panorama: a region of 2048 x 2048, and the whole image at an eighth of the size; seconds and growth of peak memory,
  each in its own process.
- colours: error in levels (mean, maximum) of a photo with a colour profile relative to its true sRGB values, which
  follow from the matrices: as decoded; with OpenImageIO and the colour space's name; with Pillow (LittleCMS) and
  the profile.
- writing: seconds, megabytes, and mean error of a page.

Seconds are CPU times of all cores, the minimum of `--repeats` runs. null: not supported by the library. Ends with
`RESULT {json}`.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import re
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
from PIL import Image, ImageCms

from bench.paths import ROOT
from scan2sim.pipeline.core.types import U8
from scan2sim.pipeline.io.images.decoders import openimageio
from tests.fakes.photo_files import ADOBE, P3, SRGB, Pixels, decoded, encoded, profile, to_xyz, write

PHOTO = ROOT / "data_samples" / "tile" / "photos" / "0000_front.jpg"
REGION_PX, REDUCTION, TILE_PX = 2048, 8, 256
LIBRARIES = ("opencv", "openimageio")


def photo(width: int) -> U8:
    """(width / 2, width, 3) RGB: a photo of the demo tile, scaled up, with sensor noise."""
    small = cv2.imread(str(PHOTO))[..., ::-1]
    large = cv2.resize(small, (width, width // 2), interpolation=cv2.INTER_CUBIC).astype(np.int16)
    large += np.random.default_rng(0).integers(-3, 4, large.shape, dtype=np.int16)
    return large.clip(0, 255).astype(np.uint8)


def by_opencv(path: Path) -> Pixels | None:
    """Pixels of a file as stored."""
    try:
        found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return None if found is None else found[..., ::-1]


def by_openimageio(path: Path) -> Pixels:
    """Pixels of a file as stored."""
    source = open_image(path)
    found: Pixels = source.read_image(0, 0, 0, source.spec().nchannels, str(source.spec().format))
    return found


def open_image(path: Path) -> Any:
    """Open a file with OpenImageIO and read its header."""
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise SystemExit(f"{path}: {oiio.geterror()}")
    return source


READERS: dict[str, Callable[[Path], Pixels | None]] = {"opencv": by_opencv, "openimageio": by_openimageio}


def fastest(task: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """CPU seconds of the fastest run, and the result."""
    took = []
    for _ in range(repeats):
        start = time.process_time()
        result = task()
        took.append(time.process_time() - start)
    return round(min(took), 3), result


def files(folder: Path, rgb: U8) -> dict[Path, Pixels | None]:
    """Write all kinds of photos; returns their true pixels from 0 to 1, None: the pixels decoded by OpenCV."""
    share = rgb / np.float32(255)
    fine = (share * 65535 + np.random.default_rng(1).integers(0, 257, rgb.shape)).clip(0, 65535).astype(np.uint16)
    light = decoded(share).astype(np.float32)
    turned, picture = Image.Exif(), Image.fromarray(rgb)
    turned[0x112] = 6
    quality: dict[str, Any] = {"quality": 92}
    picture.save(folder / "baseline.jpg", **quality)
    picture.save(folder / "turned.jpg", **quality, exif=turned)
    picture.save(folder / "progressive.jpg", **quality, progressive=True)
    picture.convert("CMYK").save(folder / "cmyk.jpg", **quality)
    found: dict[Path, Pixels | None] = dict.fromkeys(sorted(folder.glob("*.jpg")))
    deflate: dict[str, Any] = {"compression": "zip"}
    for name, kind, tile, pixels, more in (
        ("8.png", "uint8", 0, rgb, {}),
        ("16.png", "uint16", 0, fine, {}),
        ("8.tif", "uint8", 0, rgb, deflate),
        ("8_tiled.tif", "uint8", TILE_PX, rgb, deflate),
        ("16.tif", "uint16", 0, fine, deflate),
        ("16_tiled.tif", "uint16", TILE_PX, fine, deflate),
        ("float_tiled.tif", "float", TILE_PX, light, deflate),
        ("half.exr", "half", 0, light.astype(np.float16), deflate),
        ("half_tiled.exr", "half", TILE_PX, light.astype(np.float16), deflate),
        ("float.exr", "float", 0, light, deflate),
    ):
        write(folder / name, pixels, kind, tile, **more)
        found[folder / name] = normalized(pixels)
    return found


def normalized(pixels: Pixels) -> Pixels:
    """Pixels divided by the largest value of their type."""
    return pixels / np.float32(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else pixels.astype(np.float32)


def reading(folder: Path, width: int, repeats: int) -> dict[str, Any]:
    """Read every kind of photo."""
    found: dict[str, Any] = {}
    for path, truth in files(folder, photo(width)).items():
        known = normalized(np.asarray(by_opencv(path))) if truth is None else truth
        one: dict[str, Any] = {"mb": round(path.stat().st_size / 1e6, 2)}
        for library, read in READERS.items():
            seconds, pixels = fastest(partial(read, path), repeats)
            error = None if pixels is None else round(float(np.abs(normalized(pixels) - known).max() * 255), 3)
            one[library] = None if pixels is None else {"seconds": seconds, "error": error}
        found[path.name] = one
        print(f"{path.name:20s}", json.dumps(one), flush=True)
    return found


def panorama(folder: Path, width: int) -> dict[str, Any]:
    """Read parts of a panorama, each in a new process."""
    rgb = photo(width)
    cv2.imwrite(str(folder / "p.jpg"), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    write(folder / "p_tiled.tif", rgb, "uint8", TILE_PX, compression="zip")
    write(folder / "p_rows.tif", rgb, "uint8", 0, compression="zip")
    whole = oiio.ImageBuf(rgb)
    if not oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, whole, str(folder / "p_levels.tif")):
        raise SystemExit(whole.geterror())
    found: dict[str, Any] = {}
    for name in ("p.jpg", "p_rows.tif", "p_tiled.tif", "p_levels.tif"):
        for task in ("region", "eighth"):
            one = {library: in_new_process(globals()[f"{task}_{library}"], folder / name) for library in LIBRARIES}
            found[f"{name} {task}"] = one
            print(f"{name:14s}{task:8s}", json.dumps(one), flush=True)
    return found


def in_new_process(task: Callable[[Path], Pixels], path: Path) -> dict[str, float]:
    """CPU seconds, and growth of peak memory in megabytes, in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_measure, (task, path))


def _measure(task: Callable[[Path], Pixels], path: Path) -> dict[str, float]:
    before, start = _peak(), time.process_time()
    task(path)
    return {"seconds": round(time.process_time() - start, 3), "mb": round(_peak() - before)}


def _peak() -> float:
    return int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text(encoding="utf-8"))[0]) / 1e3


def region_opencv(path: Path) -> Pixels:
    """A square in the centre."""
    whole = cv2.imread(str(path))
    x, y = whole.shape[1] // 2, whole.shape[0] // 2
    return whole[y - REGION_PX // 2 : y + REGION_PX // 2, x - REGION_PX // 2 : x + REGION_PX // 2]


def region_openimageio(path: Path) -> Pixels:
    """A square in the centre."""
    width, height, _ = openimageio.header(path)
    x, y = (width - REGION_PX) // 2, (height - REGION_PX) // 2
    return openimageio.pixels(path, box=(x, y, x + REGION_PX, y + REGION_PX))


def eighth_opencv(path: Path) -> Pixels:
    """The image at an eighth of the size; the JPEG decoder reduces it."""
    return cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_8)


def eighth_openimageio(path: Path) -> Pixels:
    """The image at an eighth of the size; from the file's own level if it has one."""
    source, level = open_image(path), REDUCTION.bit_length() - 1
    found: Pixels
    if source.seek_subimage(0, level):
        found = source.read_image(0, level, 0, 3, "uint8")
    else:
        whole = source.read_image(0, 0, 0, 3, "uint8")
        found = cv2.resize(whole, None, fx=1 / REDUCTION, fy=1 / REDUCTION, interpolation=cv2.INTER_AREA)
    return found


SPACES = {
    "Display P3": (P3, None, "srgb_p3d65_scene"),
    "Adobe RGB": (ADOBE, 563 / 256, "g22_adobergb_scene"),
}


def colours(folder: Path, width: int, repeats: int) -> dict[str, Any]:
    """Convert photos with a colour profile; they are lossless, so that there are no other errors."""
    rgb, found = photo(width), {}
    for name, (primaries, gamma, space) in SPACES.items():
        icc, path = profile(primaries, gamma), folder / f"{name}.png"
        Image.fromarray(rgb).save(path, icc_profile=icc)
        light = decoded(rgb[::4] / 255) if gamma is None else (rgb[::4] / 255) ** gamma
        truth = encoded(light @ (np.linalg.inv(to_xyz(SRGB)) @ to_xyz(primaries)).T) * 255

        def named(space: str = space) -> Pixels:
            made: Any = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(rgb), space, "srgb_rec709_scene")
            return np.asarray(made.get_pixels("uint8"))

        def by_profile(icc: bytes = icc) -> Pixels:
            own, srgb = ImageCms.getOpenProfile(io.BytesIO(icc)), ImageCms.createProfile("sRGB")
            return np.asarray(ImageCms.profileToProfile(Image.fromarray(rgb), own, srgb))

        space_name = open_image(path).spec().get_string_attribute("oiio:ColorSpace")
        one: dict[str, Any] = {"openimageio_colour_space": space_name}
        for way, task in (("as decoded", lambda: rgb), ("openimageio, named", named), ("pillow", by_profile)):
            seconds, pixels = fastest(task, repeats)
            away = np.abs(pixels[::4] - truth)
            one[way] = {
                "seconds": seconds,
                "mean": round(float(away.mean()), 2),
                "largest": round(float(away.max()), 1),
            }
        found[name] = one
        print(f"{name:12s}", json.dumps(one), flush=True)
    return found


def writing(folder: Path, width: int, repeats: int) -> dict[str, Any]:
    """Write a page of 4096 x 4096, or less if `width` is smaller."""
    page = photo(2 * min(width, 4096))[:, : min(width, 4096)]
    bgr, found = np.ascontiguousarray(page[..., ::-1]), {}
    rgb = np.ascontiguousarray(page)
    ways: dict[str, tuple[list[int], dict[str, Any]]] = {
        "png": ([cv2.IMWRITE_PNG_COMPRESSION, 2], {"png__compressionLevel": 2}),
        "jpg": ([cv2.IMWRITE_JPEG_QUALITY, 90], {"compression": "jpeg:90"}),
        "webp": ([cv2.IMWRITE_WEBP_QUALITY, 90], {"compression": "webp:90"}),
    }
    for suffix, (options, attributes) in ways.items():
        path, one = folder / f"page.{suffix}", {}
        tasks: dict[str, Callable[[], Any]] = {
            "opencv": partial(cv2.imwrite, str(path), bgr, options),
            "openimageio": partial(write, path, rgb, "uint8", **attributes),
        }
        for library, task in tasks.items():
            seconds, _ = fastest(task, repeats)
            away = np.abs(cv2.imread(str(path))[..., ::-1].astype(np.int16) - rgb).mean()
            size = round(path.stat().st_size / 1e6, 2)
            one[library] = {"seconds": seconds, "mb": size, "error": round(float(away), 3)}
        found[suffix] = one
        print(f"{suffix:6s}", json.dumps(one), flush=True)
    return found


def main() -> None:
    """Run the benchmark and print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=5760)
    parser.add_argument("--panorama", type=int, default=16384)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--parts", nargs="*", default=["reading", "panorama", "colours", "writing"])
    given = parser.parse_args()
    parts: dict[str, Callable[[Path], dict[str, Any]]] = {
        "reading": lambda folder: reading(folder, given.width, given.repeats),
        "panorama": lambda folder: panorama(folder, given.panorama),
        "colours": lambda folder: colours(folder, given.width, given.repeats),
        "writing": lambda folder: writing(folder, given.width, given.repeats),
    }
    result: dict[str, Any] = {"openimageio": oiio.VERSION_STRING, "opencv": cv2.__version__}
    for name in given.parts:
        with tempfile.TemporaryDirectory() as folder:
            result[name] = parts[name](Path(folder))
    print("RESULT", json.dumps(result))


if __name__ == "__main__":
    main()
