"""Real streets from raw data to a scored world, with an independent renderer; OpenMVS beside (`openmvs.py`).

`python -m bench.street [--parts odo04 raw0009 raw0013 keep few border demo synthetic time] [--out bench-out/street]
[--score-only] [--set KEY=VALUE ...] [--openmvs FOLDER] [--vertical-angle-offset DEGREES]`

The streets are 25 frames each of KITTI odometry 04 (traffic) and of KITTI raw drive 0009 (parked cars), and 22 frames
of KITTI raw drive 0013 (verges, fences, trees; no outlines and signs are drawn on its photos); every 8th photo and
every 8th sweep is held out. The world is read from its exported files (OBJ and PNG) and rendered with 3 x 3 rays per
pixel. A gain per channel is solved for each photo; metrics are means over the three photos, all of which count.

**Whole frames** (`bench/street/frame.py`): every pixel that shows neither a vehicle nor a person, sky, backdrop and
missing surface, too, after the gain that was solved on the surfaces; `shell_frame_psnr_db` after one that was solved on
all of these pixels, as for the splats.

**Which pixels count** otherwise: those whose central ray hits the world, whether the surface is textured by a photo or
not; not those that show moving objects or, if vehicles are removed, any vehicle: from KITTI's tracking boxes on raw
0009, drawn by hand on the others (`truth.json`). Sky and pixels without surface don't count; `uncovered` is the share
of the held-out frame's own returns within 30 m that fall on such pixels, so that missing surface is visible.

**Sweeps**: every return of the held-out sweeps up to 80 m, except those of moving objects, people and removed vehicles,
is compared with the first surface along its ray (`bench/street/lidar.py`); the `lidar_*` and `returns_*` results are
those of the worst street.

- odo04, raw0009, raw0013: the streets with default settings and splats. keep: raw 0009 with `split.vehicles=keep`,
  counting all pixels.
- few: splats of odo04 trained with eleven photos held out (`bench/street/few.py`). border: raw 0009 as a survey of two
  tiles, and what splats show on both sides of their border (`bench/street/border.py`). demo: time that splats add to
  `make demo`, of two runs from scratch.
- synthetic: metrics with ground truth on a synthetic street (`bench/street/synthetic.py`), and straightness of edges
  (`bench.edges`).
- time: the street of nine million points with this checkout and with an older one (`--old FOLDER`).

Keys of the result that name no street are those of the worst street (a gain over OpenMVS: the smallest).
Results of a part are stored in its `figures.json` below `--out`; parts that aren't run again are read from there.
Images of photo and rendering are written beside it. Ends with `RESULT {json}`; null, with a reason before it, without a
result.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.measure import measure
from bench.paths import DATA, ROOT
from bench.street import border, boxes, few, frame, lidar, openmvs, score, splats
from bench.street import synthetic as street_synthetic
from bench.street.world import BACKGROUND, Photo, Rendering, World, photos
from scan2sim.pipeline.core.splats import SplatLayer
from scan2sim.pipeline.core.types import F64, I64, U8, Bools
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.pipeline.lidar.sweeps import every_nth

HOLD_OUT = 8
"""Every Nth photo is held out."""
MAX_RANGE_M, SWEEP_WINDOW_S = 30.0, 0.05
"""Range within which returns must be covered, and maximum time from the photo to the returns of its own sweep."""
RETURN_RADIUS_PX = 3
"""Radius around a return that counts as reached by the lidar."""
PARTS = ("odo04", "raw0009", "raw0013", "keep", "few", "border", "demo", "synthetic", "time")
EDGES = "bench.edges"
"""Module that measures `edge_cm`."""
MEANS = (
    "psnr_db", "nogain_psnr_db", "ssim", "sharpness", "counted", "frame_psnr_db", "frame_nogain_psnr_db", "frame_ssim",
    "frame_msssim", "shell_frame_psnr_db", "no_surface", "clipped_photo", "clipped_rendered",
)  # fmt: skip
"""Metrics of a street that are means over its held-out photos."""
MIN_SIGN_PX = 12.0
"""Minimum size of a sign in which it must be readable."""
DEMO = (ROOT / "data_samples" / "tile", "--hold-out", 8, "--set", "segment.overwrite=true")
"""Arguments of `make demo`, without splats."""
NOTHING: dict[str, Any] = {}


@dataclass(frozen=True)
class Street:
    """A real street: arguments of its import, and its vehicles' boxes (None: drawn by hand only).

    `vertical_angle_offset` is that of the import, degrees; its sweeps are held out with the same.
    """

    name: str
    data: Path
    importing: tuple[str, ...]
    labels: Path | None = None
    vertical_angle_offset: float = 0.0


RAW = DATA / "kitti_raw0009_f00-24"
RAW_13 = DATA / "kitti_raw0013_f62-83"
ODO = DATA / "kitti_odo04_f00-24"
WHOLE_SWEEP = ("--max-range", "80")
"""All returns that the measures of the literature count."""
STREETS = {
    "odo04": Street("odo04", ODO, ("kitti-odometry", str(ODO), *WHOLE_SWEEP)),
    "raw0009": Street(
        "raw0009",
        RAW,
        ("kitti-raw", str(RAW), "--poses", str(RAW / "T_velo0_velo_icp_frames_0-24.txt"), *WHOLE_SWEEP),
        RAW / "tracking_gt_0001_frames_0-24.txt",
    ),
    "raw0013": Street("raw0013", RAW_13, ("kitti-raw", str(RAW_13), *WHOLE_SWEEP)),
}


def scan2sim(*arguments: object, code: Path | None = None) -> float:
    """Run the command, optionally from another checkout; returns seconds."""
    at = code or ROOT  # the folder that it runs in is first on Python's search path
    command = [sys.executable, "-m", "scan2sim.flows.cli", *map(str, arguments)]
    measured = measure(["env", f"--chdir={at}", f"PYTHONPATH={at}", *command])
    if measured.status:
        sys.exit(f"scan2sim {arguments[0]} failed with exit status {measured.status}")
    return measured.seconds


def build_world(street: Street, folder: Path, settings: tuple[str, ...] = (), *, run: bool = True) -> tuple[Path, Path]:
    """Import the street and build its world; returns the folders of tile and run. Existing results are reused."""
    tile, out = folder / "tile", folder / "run"
    if not (tile / "tile.toml").is_file():
        offset = ("--vertical-angle-offset", street.vertical_angle_offset) if street.vertical_angle_offset else ()
        scan2sim("import", *street.importing, *offset, "--out", tile)
    if run:
        scan2sim("run", tile, "--out", out, "--hold-out", 8, *(x for s in settings for x in ("--set", s)))
    return tile, out


def score_world(
    street: Street, tile: Path, run: Path, pictures: Path, *, keep: bool = False, mvs: Path | None = None
) -> dict[str, Any]:
    """All metrics of a street's world; `mvs` is the folder of OpenMVS."""
    import laspy

    world = World(run / "world")
    views = photos(tile, run, world.origin)
    frames = sorted(views)
    rows, shifts, scanned, signs, parts, shown = {}, [], [], {}, [], {}
    cloud = laspy.read(tile / "cloud.laz")
    returns = np.stack([cloud.x, cloud.y, cloud.z], axis=1) - world.origin
    times_of = np.asarray(cloud.gps_time)
    for index in every_nth(len(frames), HOLD_OUT).tolist():
        number = frames[index]
        photo, drawn = views[number], score.truth()[street.name][str(number)]
        rendering = world.render(photo)
        masked = np.zeros(photo.rgb.shape[:2], bool) if keep else vehicles(street, number, photo)
        counts = rendering.hit & ~masked
        own = np.abs(times_of - photo.time) < SWEEP_WINDOW_S
        gain = score.solve_gain(photo.rgb, rendering.rgb, counts)
        sky = frame.sky_pixels(run, index, photo.rgb.shape)
        whole, part = frame.metrics(photo, rendering, world, ~masked, gain, sky)
        parts.append(part)
        shown[number] = (photo, rendering, counts)
        rows[number] = score.similarity(photo.rgb, rendering.rgb, counts) | whole
        rows[number] |= {
            "counted": float(counts.mean()),
            "uncovered": _uncovered(returns[own], photo, rendering, masked),
        }
        reached = _reached(returns, photo)
        corrected = np.round(score.apply_gain(rendering.rgb, gain)).astype(np.uint8)
        for kind, lines in drawn["outlines"].items():
            for i, line in enumerate(lines):
                shift, (column, row) = _shifts(photo.rgb, corrected, line)
                shifts.append((f"{number} {kind} {i}", shift))
                scanned.append(reached[row, column])
        for name, polygon in drawn["signs"].items():
            if np.ptp(np.array(polygon), axis=0).max() >= MIN_SIGN_PX:
                at = score.filled([polygon], photo.rgb.shape)
                signs[f"{number} {name}"] = score.psnr(score.squared_error(photo.rgb, corrected, at))
        _picture(pictures / f"{street.name}_{number:02d}.png", photo.rgb, corrected, counts)
        frame.picture(pictures / f"frame_{number:02d}.png", photo.rgb, rendering.whole, ~masked)
    beside: dict[str, Any] = {}
    if mvs:
        others = {number: photo for number, photo in views.items() if number not in shown}
        mesh = openmvs.textured_mesh(mvs, street.name, world.meshes, others, run.parent / "openmvs")
        beside = {"openmvs": openmvs.compare(shown.values(), mesh)}
    parked = boxes.boxes(street.labels, views) if street.labels and not keep else []
    path = np.array([views[f].T[:3, 3] for f in sorted(views)])
    left = boxes.remains(world, parked)
    together = np.concatenate([np.zeros(0), *(s for _, s in shifts)])
    return {
        "photos": rows,
        **{k: float(np.mean([r[k] for r in rows.values()])) for k in MEANS},
        "frame_parts": frame.pooled(parts),
        **beside,
        "psnr_pooled_db": score.psnr(
            sum(r["mse"] * r["pixels"] for r in rows.values()) / sum(r["pixels"] for r in rows.values())
        ),
        "uncovered": float(np.mean([r["uncovered"] for r in rows.values()])),
        "inside_mesh": int((world.distance(path) < 1.0).sum()),
        "nearest_m": float(world.distance(path).min()),
        "corridor_m2": boxes.corridor(world, path),
        "residue_m2": left,
        "outlines": {name: float(np.median(s)) for name, s in shifts if len(s)},
        "displacements_px": together.tolist(),
        "displacements_scanned_px": together[np.concatenate([np.zeros(0, bool), *scanned])].tolist(),
        "signs_db": signs,
        "seen_share": json.loads((run / "report.json").read_text(encoding="utf-8"))["texture"]["coverage"],
    }


def splats_of(
    street: Street, tile: Path, run: Path, pictures: Path, layer: SplatLayer, used: Mapping[str, float]
) -> dict[str, Any]:
    """Metrics of a street's splats, in the local metres of its run; `used` is what the training used."""
    world = World(run / "world")
    views = photos(tile, run, world.origin)
    held_out = {sorted(views)[i]: views[sorted(views)[i]] for i in every_nth(len(views), HOLD_OUT).tolist()}
    hits = {number: world.render(photo).hit for number, photo in held_out.items()}
    return splats.metrics(layer, used, street.data, tile, run, held_out, hits, partial(vehicles, street), pictures)


def vehicles(street: Street, number: int, photo: Photo) -> Bools:
    """(H, W) pixels of a held-out photo that show a vehicle or a person, by hand and from KITTI's tracking boxes."""
    drawn = score.truth()[street.name][str(number)]["vehicles"]
    masked = score.filled(drawn, photo.rgb.shape)
    return masked | boxes.mask(street.labels, number, photo.rgb.shape) if street.labels else masked


def _shifts(photo: U8, rendering: U8, line: Sequence[Sequence[float]]) -> tuple[F64, I64]:
    shift, at = score.displacements(photo, rendering, line)
    return shift, at.T


def _reached(returns: F64, photo: Photo) -> Bools:
    """(H, W) pixels near any sweep's return within 60 m: the part of the photo that the lidar reached."""
    from scipy.ndimage import binary_dilation

    column, row = _pixels(returns, photo, 2 * MAX_RANGE_M)
    out = np.zeros(photo.rgb.shape[:2], bool)
    out[row, column] = True
    return np.asarray(binary_dilation(out, iterations=RETURN_RADIUS_PX))


def _pixels(returns: F64, photo: Photo, far: float) -> tuple[I64, I64]:
    """Columns and rows of points (N, 3) in front of a photo, nearer than `far` metres, that project into it."""
    local = (returns - photo.T[:3, 3]) @ photo.T[:3, :3]
    local = local[(local[:, 2] > 0.5) & (np.linalg.norm(local, axis=1) < far)]
    column, row = np.round(photo.pixels(local)).astype(np.int64).T
    height, width = photo.rgb.shape[:2]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return column[inside], row[inside]


def _uncovered(own: F64, photo: Photo, rendering: Rendering, masked: Bools) -> float:
    """Share of returns of the photo's own sweep, on unmasked pixels, without surface."""
    column, row = _pixels(own, photo, MAX_RANGE_M)
    free = ~masked[row, column]
    return float((~rendering.hit[row, column])[free].mean())


def _picture(path: Path, photo: U8, rendering: U8, counts: Bools) -> None:
    """Photo, rendering, and their difference where it counts, one below the other."""
    from PIL import Image

    apart = np.abs(photo.astype(np.float64) - rendering).mean(axis=2, keepdims=True) * 3
    difference = np.where(counts[..., None], np.clip(apart, 0, 255), BACKGROUND).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack([photo, rendering, difference])).save(path)


def can_keep() -> bool:
    """Whether the pipeline has the setting to keep vehicles."""
    from scan2sim.pipeline.steps.split import SPLIT

    return "vehicles" in SPLIT.params.model_fields


def synthetic(folder: Path) -> dict[str, Any]:
    """Metrics with ground truth; null for edges if their benchmark isn't available."""
    out: dict[str, Any] = dict(street_synthetic.metrics(folder, scan2sim))
    if importlib.util.find_spec(EDGES) is None:
        print(f"edge_cm: null, {EDGES} isn't available")
        return out | {"edge_cm": None}
    command = [sys.executable, "-m", EDGES, str(folder / "tile"), str(folder / "run")]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    print(output, end="")
    result = next(line for line in reversed(output.splitlines()) if line.startswith("RESULT "))
    return out | {"edge_cm": json.loads(result.removeprefix("RESULT "))["edge_cm"]}


def times(folder: Path, old: Path | None) -> dict[str, Any]:
    """Time of the street of nine million points with an older checkout and with this one, one after the other."""
    if old is None or not (old / "pyproject.toml").is_file():
        print("time_ratio: null, no older checkout was given (--old)")
        return {"time_ratio": None}
    old = old.resolve()
    tile = folder / "street_9m"
    if not (tile / "tile.toml").is_file():
        scan2sim("sample", "--length=100", "--points=9e6", "--photos=40", "--seed=0", tile)
    seconds = {}
    for name, code in (("old", old), ("new", ROOT)):
        sample = code / "data_samples" / "tile"
        scan2sim("run", sample, "--out", folder / f"warm_{name}", code=code)  # warm up: compile kernels
        shutil.rmtree(folder / name, ignore_errors=True)
        seconds[name] = scan2sim("run", tile, "--out", folder / name, code=code)
    return {"time_ratio": seconds["new"] / seconds["old"], "seconds": seconds}


def few_photos(street: Street, out: Path, pictures: Path, *, run: bool) -> dict[str, Any]:
    """Score of the splats of odometry 04, trained with eleven photos held out (`few.metrics`)."""
    tile, world = build_world(street, out / street.name, ("splats.when=auto",), run=run)
    views = photos(tile, world, World(world / "world").origin)
    return few.metrics(world, views, partial(vehicles, street), out / "few", pictures)


def survey(street: Street, folder: Path, pictures: Path, *, run: bool) -> dict[str, Any]:
    """Splats on both sides of the border of a survey's tiles (`border.metrics`)."""
    tile, _ = build_world(street, folder, run=False)
    tiles, made = folder / "tiles", folder / "made"
    if run:
        border.build(tile, tiles, made, scan2sim)
    return border.metrics(tile, tiles, made, pictures)


def demo(folder: Path) -> dict[str, float]:
    """Seconds of the demo from scratch, without splats and with them, after a run that compiles the kernels."""
    seconds = {}
    for name, when in (("warm", "auto"), ("without", "never"), ("with", "auto")):
        shutil.rmtree(folder / name, ignore_errors=True)
        seconds[name] = scan2sim("run", *DEMO, "--set", f"splats.when={when}", "--out", folder / name)
    return {**seconds, "added_seconds": seconds["with"] - seconds["without"]}


def measured(part: str, street: Street | None, out: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Results of a part; `street` is the one that it needs, if any."""
    folder, pictures, run = out / part, out / "pictures" / part, not arguments.score_only
    if part == "synthetic":
        return synthetic(folder)
    if part == "time":
        return times(folder, arguments.old)
    if street is None:
        return demo(folder)
    if part == "few":
        return few_photos(street, out, pictures, run=run)
    if part == "border":
        return survey(street, folder, pictures, run=run)
    settings = ("split.vehicles=keep" if part == "keep" else "splats.when=auto", *arguments.set)
    tile, world = build_world(street, folder, settings, run=run)
    mvs = arguments.openmvs.resolve() if arguments.openmvs and part in STREETS else None
    found = score_world(street, tile, world, pictures, keep=part == "keep", mvs=mvs)
    if part in STREETS:
        offset = street.vertical_angle_offset
        found["lidar"] = lidar.metrics(street.data, tile, world, pictures, street.labels, offset)
        if layer := read_scene(world).tiles[0].splats():
            found["splats"] = splats_of(street, tile, world, pictures, layer, splats.resources_of(world))
        found["wrongly_removed"] = lidar.wrongly_removed(street.data, tile, world, partial(vehicles, street), offset)
    return found


def table(figures: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the results."""
    if "few" in figures:
        few.table(figures["few"])
    if "border" in figures:
        border.table(figures["border"])
    for name in ("odo04", "raw0009", "raw0013", "keep"):
        one = figures.get(name)
        if one and "lidar" in one:
            print(f"\n{name}:")
            lidar.table(one["lidar"])
        if not one or "psnr_db" not in one:
            continue
        print(f"\n{name}: {one['psnr_db']:.2f} dB / {one['ssim']:.3f} / sharpness {one['sharpness']:.2f}", end="")
        print(f" (all pixels as one: {one['psnr_pooled_db']:.2f} dB)")
        for number, row in one["photos"].items():
            print(
                f"  frame {number}: {row['psnr_db']:.2f} dB / {row['ssim']:.3f} / {row['sharpness']:.2f}, "
                f"{row['counted']:.0%} of the pixels count, {row['uncovered']:.1%} of near returns without surface"
            )
        print(
            f"  cameras within 1 m of a surface: {one['inside_mesh']} of 25, nearest {one['nearest_m']:.2f} m;", end=""
        )
        print(
            f" surface where the car drove: {one['corridor_m2']:.1f} m2; textured from photos {one['seen_share']:.0%}"
        )
        if one["residue_m2"]:
            left = {track: round(area, 2) for track, area in one["residue_m2"].items()}
            print(f"  surface remaining of vehicles, m2 by track: {left}")
        if "wrongly_removed" in one:
            frame.table(one)
        if one.get("splats"):
            splats.table(one["splats"])
        if "openmvs" in one:
            mvs = one["openmvs"]
            print(
                f"  same pixels as OpenMVS ({mvs['pixels']:.0%}), ours minus theirs: {mvs['gain_db']:+.2f} dB", end=""
            )
            print(f" (theirs {mvs['theirs_psnr_db']:.2f}), without gain {mvs['nogain_db']:+.2f} dB", end="")
            print(f" (theirs {mvs['theirs_nogain_psnr_db']:.2f})")
        near = one["displacements_scanned_px"]
        if not one["displacements_px"]:
            continue
        print(f"  outlines that the lidar reached: median {np.median(near):.2f} px, {len(near)} of", end="")
        print(f" {len(one['displacements_px'])} places")
        print(f"  outlines, median px: { ({k: round(v, 2) for k, v in one['outlines'].items()}) }")
        if one["signs_db"]:
            print(f"  signs, dB: { ({k: round(v, 1) for k, v in one['signs_db'].items()}) }")


def result(figures: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Results that have targets."""
    odo, raw, keep, few_part, border_part, demo_part, synthetic_part, time = (
        figures.get(name, NOTHING) for name in ("odo04", "raw0009", *PARTS[3:])
    )
    streets = [figures[name] for name in STREETS if "frame_psnr_db" in figures.get(name, NOTHING)]

    def worst(values: Iterable[float | None], sign: int = 1) -> float | None:
        """The smallest of the known values; with `sign` -1 the largest."""
        return min((value for value in values if value is not None), key=lambda value: sign * value, default=None)

    found = {
        "odo04_psnr_db": odo.get("psnr_db"),
        "odo04_ssim": odo.get("ssim"),
        "raw0009_psnr_db": raw.get("psnr_db"),
        "raw0009_ssim": raw.get("ssim"),
        "raw0009_keep_psnr_db": keep.get("psnr_db"),
        "sharpness_min": worst(street["sharpness"] for street in streets),
        "inside_mesh": sum(street["inside_mesh"] for street in streets) if streets else None,
        "residue_m2": max(raw["residue_m2"].values()) if raw.get("residue_m2") else None,
        "static_lost": synthetic_part.get("static_lost"),
        "pole_recall": synthetic_part.get("pole_recall"),
        "seen_share_min": worst(street["seen_share"] for street in streets),
        "edge_cm": synthetic_part.get("edge_cm"),
        "time_ratio": time.get("time_ratio"),
        "frame_psnr_db": worst(street["frame_psnr_db"] for street in streets),
        "frame_msssim": worst(street["frame_msssim"] for street in streets),
        "shell_frame_psnr_db": worst(street.get("shell_frame_psnr_db") for street in streets),
        "nogain_psnr_db": worst(street["nogain_psnr_db"] for street in streets),
        "clipped_share": worst((frame.clipped_share(street["photos"].values()) for street in streets), -1),
        "outline_px": worst((_median(street["displacements_px"]) for street in streets), -1),
        "sign_psnr_db": worst(_mean(street["signs_db"].values()) for street in streets),
        "wrongly_removed": worst((street["wrongly_removed"] for street in streets), -1),
        "openmvs_ahead_db": worst(street["openmvs"]["gain_db"] for street in streets if "openmvs" in street),
        "openmvs_ahead_nogain_db": worst(street["openmvs"]["nogain_db"] for street in streets if "openmvs" in street),
        **lidar.result([street["lidar"] for street in streets]),
        **splats.result(
            {name: part["splats"] for name in STREETS if (part := figures.get(name)) and part.get("splats")}
        ),
        "few_photos_gap_db": odo["splats"]["psnr_db"] - few_part["psnr_db"] if few_part and odo.get("splats") else None,
        "border_grey_levels": border_part.get("border_grey_levels"),
        "border_step_grey_levels": border_part.get("border_step_grey_levels"),
        "demo_added_seconds": demo_part.get("added_seconds"),
    }
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in found.items()}


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return float(np.mean(known)) if known else None


def main() -> None:
    """Run the parts, and print tables and the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "street")
    parser.add_argument("--old", type=Path, help="an older checkout, for `time`")
    parser.add_argument("--openmvs", type=Path, help="folder of OpenMVS's programs, or of its results by street")
    parser.add_argument("--score-only", action="store_true", help="score existing worlds")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings of the real streets' runs")
    parser.add_argument("--vertical-angle-offset", type=float, default=0.0, help="of the imports, degrees")
    arguments = parser.parse_args()
    out: Path = arguments.out.resolve()
    for part in arguments.parts:
        folder = out / part
        folder.mkdir(parents=True, exist_ok=True)
        street = STREETS.get({"keep": "raw0009", "few": "odo04", "border": "raw0009"}.get(part, part))
        if street and not street.data.is_dir():
            print(f"{part}: skipped, {street.data} doesn't exist")
            continue
        if part == "keep" and not can_keep():
            print("raw0009_keep_psnr_db: null, this version has no split.vehicles")
            continue
        if street:
            street = replace(street, vertical_angle_offset=arguments.vertical_angle_offset)
        found = measured(part, street, out, arguments)
        (folder / "figures.json").write_text(json.dumps(found, indent=1), encoding="utf-8")
    files = {part: out / part / "figures.json" for part in PARTS}
    figures = {part: json.loads(f.read_text(encoding="utf-8")) for part, f in files.items() if f.is_file()}
    table(figures)
    print("RESULT " + json.dumps(result(figures)))
