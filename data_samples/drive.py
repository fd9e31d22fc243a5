"""Render a drive through a synthetic town: a 360-degree video with ground truth and GPS fixes.

`python -m scan2sim.data_samples.drive OUT --path town --length 300` writes video.mp4, truth.csv, gps.csv, mask.png and
camera.json. Conditions that are difficult to track: `--path zigzag --hills .08 --exposure .01 --rolling-shutter .016
--lens-offset .03 --glare`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from scan2sim.data_samples import gps, hills, paths
from scan2sim.data_samples.panorama import Panorama, linear_light, to_srgb
from scan2sim.data_samples.town import build
from scan2sim.data_samples.traffic import Traffic
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, U8, Trajectory
from scan2sim.pipeline.io.images.image import read_rgb
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.pipeline.io.trajectory import atomic_write

EXPOSURE_SAMPLES = 6
"""Number of renderings that are averaged for motion blur."""


@dataclass(frozen=True)
class DriveConditions:
    """Conditions that make a drive difficult to track; also the contents of `camera.json`.

    Attributes:
        hills: maximum slope, metres per metre.
        exposure: exposure time, seconds, centred at the frame's time; causes motion blur.
        rolling_shutter: readout time from the first to the last row, seconds; a frame's time is that of its middle row.
        lens_offset: distance of the front lens, and of the back lens, from the camera's centre, metres.
        glare: a low sun dazzles the camera.
    """

    hills: float = 0.0
    exposure: float = 0.0
    rolling_shutter: float = 0.0
    lens_offset: float = 0.0
    glare: bool = False


def generate_drive(
    out: Path,
    path_xy: F64,
    *,
    seconds: float | None = None,
    length: float | None = None,
    speed: float = 12.0,
    fps: float = 15.0,
    height: int = 1024,
    bitrate: float = 10e6,
    seed: int = 0,
    conditions: DriveConditions = DriveConditions(),
    bus: tuple[float, float] | None = None,
    gps_rate: float = 1.0,
    gps_gaps: Iterable[tuple[float, float]] = (),
    gps_jumps: Iterable[tuple[float, float]] = (),
    traffic: bool = True,
    samples: int = 3,
    lossless: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    report: Report = silent,
) -> Path:
    """Render a drive into the folder `out`, and return it.

    Writes `video.mp4` (H.264, equirectangular: column 0 looks back, the centre ahead), `truth.csv` (time, x, y, z of
    the camera in metres, z up, and its camera-to-world quaternion, camera axes x right, y down, z forward), `gps.csv`
    (time, latitude, longitude, altitude of a consumer receiver; the world's origin is `gps.ORIGIN`, x east, y north),
    `mask.png` (0 where the camera sees its own car), and `camera.json` (the conditions).

    Args:
        out: output folder.
        path_xy: (N, 2) path, metres (`paths`).
        seconds: maximum duration.
        length: maximum length of the path, metres.
        speed: m/s on straights.
        fps: frames per second.
        height: rows of a frame; it has twice as many columns.
        bitrate: bitrate of the video, bits per second.
        seed: seed of the town, the traffic, the light, and the receiver.
        conditions: conditions of the drive; default: flat, sharp and evenly lit.
        bus: (from, to) seconds in which buses surround the camera.
        gps_rate, gps_gaps, gps_jumps: see `gps.receiver`.
        traffic: whether there are other vehicles on the road.
        samples: rays per pixel at edges, see `panorama.Panorama`.
        lossless: also write the frames as `frames/000000.png` and so on.
        overwrite: replace an existing video.
        resume: with `lossless`: keep the frames that an interrupted call with the same arguments wrote.
        report: receives progress.

    Raises:
        SettingError: a video exists already, or a number is out of range.
    """
    import cv2

    if (out / "video.mp4").exists() and not overwrite:
        raise SettingError("out", f"{out / 'video.mp4'} exists already", "Pass --overwrite, or choose another folder")
    for name, value, least in (
        ("height", height, 64),
        ("fps", fps, 0.1),
        ("bitrate", bitrate, 1e4),
        ("speed", speed, 0.5),
    ):
        if not (np.isfinite(value) and value >= least):
            raise SettingError(name, f"{value} is less than {least:g}", f"Give {least:g} or more")
    path = path_xy if length is None else path_xy[paths.chainage(path_xy) <= length]
    report(0.0, "building the town")
    ground = hills.draw(path, conditions.hills, seed)
    trajectory = hills.lifted(paths.drive(path, speed, fps, seconds=seconds, seed=seed), ground)
    others = Traffic(path, trajectory, seed, bus) if traffic else None
    town = build(path, seed, hills=ground, low_sun=conditions.glare)
    camera = Panorama(town, others, height, seed, samples, conditions.lens_offset)
    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / "mask.png"), camera.mask)
    write_truth(out / "truth.csv", trajectory)
    (out / "camera.json").write_text(json.dumps(asdict(conditions), indent=1) + "\n", encoding="utf-8")
    times, fixes = gps.receiver(trajectory, gps_rate, seed, gaps=tuple(gps_gaps), jumps=tuple(gps_jumps))
    table = np.column_stack([times, gps.geographic(fixes)])
    np.savetxt(
        out / "gps.csv", table, ["%.3f", "%.8f", "%.8f", "%.3f"], delimiter=",",
        header="time,latitude,longitude,altitude", comments="",
    )  # fmt: skip
    frames = _frames(camera, trajectory, conditions, report, out / "frames" if lossless else None, resume)
    encode(frames, out / "video.mp4", fps, bitrate, (2 * height, height))
    report(1.0, "done")
    return out


def _frames(
    camera: Panorama,
    trajectory: Trajectory,
    conditions: DriveConditions,
    report: Report,
    saved: Path | None,
    resume: bool,
) -> Iterator[U8]:
    """Frames (H, W, 3), written to the folder `saved`; with `resume`, those that are there already are read."""
    import cv2

    if saved:
        saved.mkdir(exist_ok=True)
    for i in range(len(trajectory)):
        report(i / len(trajectory), f"frame {i + 1} of {len(trajectory)}")
        file = saved / f"{i:06d}.png" if saved else None
        if file and resume and file.is_file():
            yield read_rgb(file)
            continue
        frame = render_exposed_frame(camera, trajectory, i, conditions)
        if file:
            with atomic_write(file) as fresh:
                fresh.write_bytes(cv2.imencode(".png", frame[..., ::-1])[1].tobytes())
        yield frame


def render_exposed_frame(camera: Panorama, trajectory: Trajectory, i: int, conditions: DriveConditions) -> U8:
    """Frame `i` of a drive (H, W, 3), with motion blur and rolling shutter."""
    count = EXPOSURE_SAMPLES if conditions.exposure else 1
    moments = trajectory.times[i] + ((np.arange(count) + 0.5) / count - 0.5) * conditions.exposure
    poses = [row_poses(trajectory, moment, camera.height, conditions.rolling_shutter) for moment in moments]
    seen = [camera.render(rows, float(moment)).rgb for rows, moment in zip(poses, moments, strict=True)]
    return seen[0] if count == 1 else to_srgb(np.mean([linear_light(rgb) for rgb in seen], axis=0, dtype=np.float32))


def row_poses(trajectory: Trajectory, time: float, height: int, readout: float) -> F64:
    """(H, 4, 4) pose of each row of a frame whose middle row is read at `time`; constant beyond the ends."""
    return trajectory.pose_at(time + ((np.arange(height) + 0.5) / height - 0.5) * readout)


def write_truth(file: Path, trajectory: Trajectory) -> None:
    """Write poses as time, x, y, z, qx, qy, qz, qw (camera to world)."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(trajectory.rotations).as_quat()
    table = np.column_stack([trajectory.times, trajectory.positions, turn])
    np.savetxt(file, table, fmt="%.9f", delimiter=",", header="time,x,y,z,qx,qy,qz,qw", comments="")


def encode(frames: Iterable[U8], file: Path, fps: float, bitrate: float, size: tuple[int, int]) -> int:
    """Encode RGB frames (H, W, 3) as H.264; frame i has the time i / fps. The file is written atomically.

    Args:
        frames: frames; those of another size are scaled.
        file: video to write.
        fps: frames per second.
        bitrate: target bitrate, bits per second.
        size: width and height of the video, both even.

    Returns:
        The number of frames.
    """
    import cv2

    part = file.with_name(f".{file.name}.part")
    options = {"preset": "superfast", "g": str(max(1, round(1.5 * fps)))}
    options |= {"maxrate": str(int(1.5 * bitrate)), "bufsize": str(int(2 * bitrate))}
    try:
        with Encoder(part, size, fps, bitrate=bitrate, container={"movflags": "faststart"}, **options) as encoder:
            for count, image in enumerate(frames):
                if (image.shape[1], image.shape[0]) != size:
                    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
                encoder.add(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), count / fps)
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return encoder.count


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m scan2sim.data_samples.drive", description=__doc__)
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument("--path", default="town", help="path to drive: a KITTI pose file, or town, loop, zigzag")
    parser.add_argument("--length", type=float, help="length of the path in metres (default of town and zigzag: 600)")
    parser.add_argument("--seconds", type=float, help="maximum duration of the video in seconds")
    parser.add_argument("--speed", type=float, default=12.0, help="speed on straights in m/s (default: 12)")
    parser.add_argument(
        "--height", type=int, default=1024, help="rows of a frame; columns are twice that (default: 1024)"
    )
    parser.add_argument("--fps", type=float, default=15.0, help="frames per second (default: 15)")
    parser.add_argument("--bitrate", type=float, default=10.0, help="bitrate of the video in Mbit/s (default: 10)")
    parser.add_argument("--seed", type=int, default=0, help="seed of town, traffic, light and receiver (default: 0)")
    parser.add_argument("--hills", type=float, default=0.0, help="maximum slope in metres per metre (default: flat)")
    parser.add_argument("--exposure", type=float, default=0.0, help="exposure time in seconds, for motion blur")
    parser.add_argument("--rolling-shutter", type=float, default=0.0, help="readout time of a frame in seconds")
    parser.add_argument(
        "--lens-offset", type=float, default=0.0, help="offset of both lenses from the centre in metres"
    )
    parser.add_argument("--glare", action="store_true", help="a low sun dazzles the camera")
    parser.add_argument(
        "--bus", type=float, nargs=2, metavar=("FROM", "TO"), help="seconds between which buses surround the camera"
    )
    parser.add_argument("--gps-rate", type=float, default=1.0, help="GPS fixes per second (default: 1)")
    parser.add_argument(
        "--gps-gap", type=float, nargs=2, action="append", default=[], metavar=("FROM", "TO"),
        help="seconds between which there are no GPS fixes; repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--gps-jump", type=float, nargs=2, action="append", default=[], metavar=("TIME", "METRES"),
        help="offset all GPS fixes after a time in seconds by a distance; repeatable",
    )  # fmt: skip
    parser.add_argument("--samples", type=int, default=3, help="rays per pixel at edges; 1 is fastest (default: 3)")
    parser.add_argument("--no-traffic", dest="traffic", action="store_false", help="no other vehicles on the road")
    parser.add_argument("--lossless", action="store_true", help="also write the frames as PNG")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing video")
    parser.add_argument(
        "--resume", action="store_true", help="keep the PNGs that an interrupted run with the same options wrote"
    )
    a = parser.parse_args()
    synthetic_paths: dict[str, Callable[[], F64]] = {
        "town": lambda: paths.town_path(a.seed, a.length or 600.0), "loop": paths.loop_path,
        "zigzag": lambda: paths.zigzag_path(a.length or 600.0),
    }  # fmt: skip
    path = synthetic_paths[a.path]() if a.path in synthetic_paths else paths.kitti_path(Path(a.path), a.length)
    conditions = DriveConditions(a.hills, a.exposure, a.rolling_shutter, a.lens_offset, a.glare)

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{100 * fraction:5.1f} %  {message:40}", end="", flush=True)

    generate_drive(
        a.out, path, seconds=a.seconds, length=a.length, speed=a.speed, fps=a.fps, height=a.height,
        bitrate=a.bitrate * 1e6, seed=a.seed, conditions=conditions, bus=tuple(a.bus) if a.bus else None,
        gps_rate=a.gps_rate, gps_gaps=[tuple(g) for g in a.gps_gap], gps_jumps=[tuple(j) for j in a.gps_jump],
        traffic=a.traffic, samples=a.samples, lossless=a.lossless, overwrite=a.overwrite,
        resume=a.resume, report=report,
    )  # fmt: skip
    print()


if __name__ == "__main__":
    main()
