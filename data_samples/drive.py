"""Film a drive through a synthetic town: a 360-degree video with its ground truth and a receiver's fixes.

`python -m scan2sim.data_samples.drive OUT --path town --length 300` writes video.mp4, truth.csv, gps.csv, mask.png, and
camera.json. A hard one: `--path zigzag --hills .08 --exposure .01 --rolling-shutter .016 --lens-offset .03 --glare`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from scan2sim.data_samples import gps, hills, paths
from scan2sim.data_samples.panorama import Panorama, light_of, shown
from scan2sim.data_samples.town import build
from scan2sim.data_samples.traffic import Traffic
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.step import Report, silent
from scan2sim.pipeline.core.types import F64, U8, Trajectory
from scan2sim.pipeline.io.images.video import Encoder

MOMENTS = 6
"""Of an exposure that are seen, and added up."""


@dataclass(frozen=True)
class Hardships:
    """What makes a drive hard to follow.

    Attributes:
        hills: the steepest climb, metres a metre of way.
        exposure: seconds that a frame gathers light for, about its time: what moves is blurred.
        rolling_shutter: seconds from reading the first row to the last; a frame's time is its middle row's.
        lens_offset: metres from the camera's place to the front lens, and to the back one.
        glare: the sun stands low, and dazzles.
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
    hard: Hardships = Hardships(),
    bus: tuple[float, float] | None = None,
    gps_rate: float = 1.0,
    gps_gaps: Iterable[tuple[float, float]] = (),
    gps_jumps: Iterable[tuple[float, float]] = (),
    traffic: bool = True,
    samples: int = 3,
    lossless: bool = False,
    overwrite: bool = False,
    report: Report = silent,
) -> Path:
    """Write the folder `out` and return it.

    `video.mp4` (H.264, equirectangular: column 0 looks back, the centre ahead), `truth.csv` (time, x, y, z of the
    camera in metres, z up, and its camera-to-world quaternion, camera axes x right, y down, z forward),
    `gps.csv` (time, latitude, longitude, altitude of a consumer receiver; the world's origin is `gps.ORIGIN`,
    x east, y north), `mask.png` (0 where the camera sees its own car), `camera.json` (what `hard` says).

    Args:
        path_xy: (N, 2) metres, see `paths`.
        seconds, length: stop after so much of the path.
        speed: m/s on straights.
        height: rows of a frame; it has twice as many columns.
        bitrate: of the video, bits a second.
        seed: of the town, the traffic, the light, and the receiver.
        hard: see there; a flat, sharp and evenly lit drive by default.
        bus: (from, to) seconds in which buses hem the camera in.
        gps_rate, gps_gaps, gps_jumps: see `gps.receiver`.
        traffic: whether there is anyone else on the road.
        samples: rays of a pixel at edges, see `panorama.Panorama`.
        lossless: also write `frames/000000.png` and so on.
        overwrite: replace a video that is there already.

    Raises:
        SettingError: there is a video already, or a number makes no sense.
    """
    import cv2

    if (out / "video.mp4").exists() and not overwrite:
        raise SettingError("out", f"{out / 'video.mp4'} exists already", "Pass overwrite, or choose another folder")
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
    ground = hills.draw(path, hard.hills, seed)
    trajectory = hills.lifted(paths.drive(path, speed, fps, seconds=seconds, seed=seed), ground)
    others = Traffic(path, trajectory, seed, bus) if traffic else None
    town = build(path, seed, hills=ground, low_sun=hard.glare)
    camera = Panorama(town, others, height, seed, samples, hard.lens_offset)
    out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out / "mask.png"), camera.mask)
    write_truth(out / "truth.csv", trajectory)
    (out / "camera.json").write_text(json.dumps(asdict(hard), indent=1) + "\n", encoding="utf-8")
    times, fixes = gps.receiver(trajectory, gps_rate, seed, gaps=tuple(gps_gaps), jumps=tuple(gps_jumps))
    table = np.column_stack([times, gps.geographic(fixes)])
    np.savetxt(
        out / "gps.csv", table, ["%.3f", "%.8f", "%.8f", "%.3f"], delimiter=",",
        header="time,latitude,longitude,altitude", comments="",
    )  # fmt: skip
    frames = _frames(camera, trajectory, hard, report)
    if lossless:
        (out / "frames").mkdir(exist_ok=True)
        frames = _kept(frames, out / "frames")
    encode(frames, out / "video.mp4", fps, bitrate, (2 * height, height))
    report(1.0, "done")
    return out


def _frames(camera: Panorama, trajectory: Trajectory, hard: Hardships, report: Report) -> Iterator[U8]:
    for i in range(len(trajectory)):
        report(i / len(trajectory), f"frame {i + 1} of {len(trajectory)}")
        yield exposed(camera, trajectory, i, hard)


def exposed(camera: Panorama, trajectory: Trajectory, i: int, hard: Hardships) -> U8:
    """(H, W, 3) frame `i` of a drive: what is seen while it is exposed, row after row, added up."""
    count = MOMENTS if hard.exposure else 1
    moments = trajectory.times[i] + ((np.arange(count) + 0.5) / count - 0.5) * hard.exposure
    poses = [row_poses(trajectory, moment, camera.height, hard.rolling_shutter) for moment in moments]
    seen = [camera.render(rows, float(moment)).rgb for rows, moment in zip(poses, moments, strict=True)]
    return seen[0] if count == 1 else shown(np.mean([light_of(rgb) for rgb in seen], axis=0, dtype=np.float32))


def _kept(frames: Iterable[U8], folder: Path) -> Iterator[U8]:
    import cv2

    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{i:06d}.png"), frame[..., ::-1])
        yield frame


def row_poses(trajectory: Trajectory, time: float, height: int, readout: float) -> F64:
    """(H, 4, 4) the pose of each row of a frame whose middle row is taken at `time`; held beyond the ends."""
    return trajectory.pose_at(time + ((np.arange(height) + 0.5) / height - 0.5) * readout)


def write_truth(file: Path, trajectory: Trajectory) -> None:
    """Write poses as time, x, y, z, qx, qy, qz, qw (camera to world)."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(trajectory.rotations).as_quat()
    table = np.column_stack([trajectory.times, trajectory.positions, turn])
    np.savetxt(file, table, fmt="%.9f", delimiter=",", header="time,x,y,z,qx,qy,qz,qw", comments="")


def encode(frames: Iterable[U8], file: Path, fps: float, bitrate: float, size: tuple[int, int]) -> int:
    """Encode RGB frames (H, W, 3) as H.264 of a target bit rate; frame i is shown at i / fps.

    Args:
        size: width and height of the video, both even; frames of another size are scaled.

    Returns:
        The number of frames. The file appears when it is complete.
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
    parser.add_argument("out", type=Path)
    parser.add_argument("--path", default="town", help="a KITTI pose file, or town, loop, zigzag")
    parser.add_argument("--length", type=float, help="metres of the path (town: 600)")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--speed", type=float, default=12.0, help="m/s on straights")
    parser.add_argument("--height", type=int, default=1024)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--bitrate", type=float, default=10.0, help="Mbit/s")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hills", type=float, default=0.0, help="the steepest climb, metres a metre")
    parser.add_argument("--exposure", type=float, default=0.0, help="seconds that blur what moves")
    parser.add_argument("--rolling-shutter", type=float, default=0.0, help="seconds from the first row to the last")
    parser.add_argument("--lens-offset", type=float, default=0.0, help="metres, of either lens from their middle")
    parser.add_argument("--glare", action="store_true", help="the sun stands low, and dazzles")
    parser.add_argument("--bus", type=float, nargs=2, metavar=("FROM", "TO"), help="seconds")
    parser.add_argument("--gps-rate", type=float, default=1.0)
    parser.add_argument("--gps-gap", type=float, nargs=2, action="append", default=[], metavar=("FROM", "TO"))
    parser.add_argument("--gps-jump", type=float, nargs=2, action="append", default=[], metavar=("TIME", "METRES"))
    parser.add_argument("--samples", type=int, default=3, help="rays of a pixel at edges; 1 is fastest")
    parser.add_argument("--no-traffic", dest="traffic", action="store_false")
    parser.add_argument("--lossless", action="store_true", help="also write PNG frames")
    parser.add_argument("--overwrite", action="store_true")
    a = parser.parse_args()
    made_up: dict[str, Callable[[], F64]] = {
        "town": lambda: paths.town_path(a.seed, a.length or 600.0), "loop": paths.loop_path,
        "zigzag": lambda: paths.zigzag_path(a.length or 600.0),
    }  # fmt: skip
    path = made_up[a.path]() if a.path in made_up else paths.kitti_path(Path(a.path), a.length)
    hard = Hardships(a.hills, a.exposure, a.rolling_shutter, a.lens_offset, a.glare)

    def report(fraction: float, message: str = "") -> None:
        print(f"\r{100 * fraction:5.1f} %  {message:40}", end="", flush=True)

    generate_drive(
        a.out, path, seconds=a.seconds, length=a.length, speed=a.speed, fps=a.fps, height=a.height,
        bitrate=a.bitrate * 1e6, seed=a.seed, hard=hard, bus=tuple(a.bus) if a.bus else None,
        gps_rate=a.gps_rate, gps_gaps=[tuple(g) for g in a.gps_gap], gps_jumps=[tuple(j) for j in a.gps_jump],
        traffic=a.traffic, samples=a.samples, lossless=a.lossless, overwrite=a.overwrite, report=report,
    )  # fmt: skip
    print()


if __name__ == "__main__":
    main()
