"""View: a video of what is tracked, and of where the camera has been."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np

from scan2sim.pipeline.camera.models import project
from scan2sim.pipeline.core.errors import from_os_error
from scan2sim.pipeline.core.types import F64, U8, Bools
from scan2sim.pipeline.io.images.video import Encoder
from scan2sim.slam.geometry import angles
from scan2sim.slam.odometry.odometry import Odometry

WIDTH, LEAST = 1280, 960
"""Pixels: the picture is so wide at most; smaller frames are enlarged to the lesser."""
RATE = 6.0
"""Frames a second that are recorded, about."""
DOTS = 20_000
"""Map points of the past that are shown at most."""
KNOWN, OFF, CANDIDATE = np.array([80, 220, 60]), np.array([40, 130, 250]), (0, 230, 250)  # BGR
PATH, UNSURE, PAPER, INK = (235, 190, 120), (60, 60, 255), (28, 26, 24), (225, 225, 225)
PAST, NEAR = (105, 100, 95), (170, 200, 170)


class Recorder:
    """Show it odometry and frame after each frame (`watch` of `video_odometry.track`); `close` it at the end.

    Above or left, the frame: points of the map green, the redder the more they are off; features that are no points
    yet yellow. Below or right, the ground from above as the camera's own world has it, its first view upwards: where
    the camera has been, red where that was bridged, and the map's points.

    The video grows in `NAME.part.mp4`, which players take at any time, after an interruption, too, and moves to its
    place at the end. A recorder can begin in the middle of a run: what was before, it takes from the odometry.
    """

    def __init__(self, file: Path, fps: float) -> None:
        """`file`: MP4 to write; `fps`: of the frames that come, of which about `RATE` a second are recorded."""
        self.file = file
        self._part = file.with_name(f"{file.stem}.part.mp4")
        self._every = max(1, round(fps / RATE))
        self._rate = fps / self._every
        self._seen, self._written = -1, 0
        self._encoder: Encoder | None = None
        self._canvas = np.zeros((0, 0, 3), np.uint8)
        self._path, self._fresh = np.zeros((0, 2)), 0  # ground places of all frames; the first that may still move
        self._dots, self._keyframes = np.zeros((0, 2)), 0

    def __call__(self, odometry: Odometry, grey: U8) -> None:
        """A frame (H, W), after odometry has taken it."""
        self._seen += 1
        if self._seen % self._every or not odometry.map.keyframes:
            return
        picture = self.draw(odometry, grey)
        import cv2

        if self._encoder is None:
            size = picture.shape[1], picture.shape[0]
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise from_os_error(error, self.file) from error
            # in fragments: what is written can be played, whatever happens
            options = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
            self._encoder = Encoder(
                self._part, size, self._rate, container=options, preset="ultrafast", crf="25", g=f"{4 * self._rate:.0f}"
            )
        self._encoder.add(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), self._written / self._rate)
        self._written += 1

    def close(self) -> None:
        """Finish the video and move it into place."""
        if self._encoder is None:
            return
        encoder, self._encoder = self._encoder, None
        encoder.close()
        try:
            _whole(self._part, self.file)
        except OSError as error:
            raise from_os_error(error, self.file) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def draw(self, odometry: Odometry, grey: U8) -> U8:
        """(H, W, 3) BGR: the frame, and the ground from above; the next call draws over it."""
        h, w = grey.shape
        beside = w < 1.4 * h
        height = WIDTH * 9 / 16 if beside else min(WIDTH * 9 / 16, min(WIDTH, max(LEAST, w)) * h / w)
        height = 2 * round(height / 2)
        width = 2 * round(height * w / h / 2)
        low, wide = (height, WIDTH) if beside else (height + 2 * round(0.2 * width), width)
        if self._canvas.shape != (low, wide, 3):
            self._canvas = np.empty((low, wide, 3), np.uint8)
        self._frame(self._canvas[:height, :width], odometry, grey)
        self._ground(self._canvas[:, width:] if beside else self._canvas[height:], odometry)
        return self._canvas

    # the frame

    def _frame(self, picture: U8, odometry: Odometry, grey: U8) -> None:
        import cv2

        height, width = picture.shape[:2]
        way = cv2.INTER_AREA if width < grey.shape[1] else cv2.INTER_LINEAR
        picture[:] = cv2.resize(grey, (width, height), interpolation=way)[..., None]
        tracks, map_ = odometry.tracker.tracks, odometry.map
        rows, known = map_.landmarks.find(tracks.ids)
        inliers = 0
        if len(tracks):
            camera = odometry.facets.camera
            uv, ok = project(camera, tracks.bearing)
            # sixteenths of pixels, as cv2 draws them
            place = np.round(16 * ((uv + 0.5) * [width / camera.width, height / camera.height] - 0.5))
            place = np.where(ok[:, None] & np.isfinite(place), place, -1000).astype(int)
            for x, y in place[~known].tolist():
                cv2.circle(picture, (x, y), 24, CANDIDATE, -1, cv2.LINE_8, 4)
            if known.any():
                pose = odometry.pose_of(odometry.placed[-1])
                error = angles(pose, map_.landmarks.xyz[rows[known]], tracks.bearing[known])
                inliers = int((error < map_.gate).sum())
                share = np.clip(error / map_.gate, 0, 1)[:, None]
                colours = ((1 - share) * KNOWN + share * OFF).tolist()
                for (x, y), colour in zip(place[known].tolist(), colours, strict=True):
                    cv2.circle(picture, (x, y), 40, colour, -1, cv2.LINE_8, 4)
        placed = odometry.placed[-1]
        text = f"{placed.time:7.2f} s   {inliers} of {len(tracks)} tracks are on the map"
        _write(picture, text, (10, 24))
        if placed.unsure:
            _write(picture, "LOST: carried on" if map_.part == 0 else f"LOST: map {map_.part + 1}", (10, 52), UNSURE)

    # the ground

    def _ground(self, picture: U8, odometry: Odometry) -> None:
        """The world's x to the right, its z upwards: the first camera looks up the picture."""
        import cv2

        self._remember(odometry)
        height, width = picture.shape[:2]
        picture[:] = PAPER
        scale, middle = self._zoom(odometry, height, width)

        def pixels(places: F64) -> F64:
            return (places - middle) * [scale, -scale] + [width / 2, height / 2]

        near = odometry.map.landmarks.xyz[:, [0, 2]]
        for dots, colour, thick in ((self._dots, PAST, 1), (near, NEAR, 2)):
            x, y = np.round(pixels(dots)).astype(int).T
            shown = (x >= 0) & (x < width - 1) & (y >= 1) & (y < height)
            for step in range(thick):
                picture[y[shown], x[shown] + step] = colour
                picture[y[shown] - step, x[shown]] = colour
        unsure = np.array([p.unsure for p in odometry.placed])
        for stretch, doubt in _stretches(unsure):
            at = pixels(self._path[stretch])
            at = at[:: max(1, len(at) // 3000)] if len(at) > 3000 else at
            line = np.round(16 * np.clip(at, -4000, 4000)).astype(np.int32)
            cv2.polylines(picture, [line], False, UNSURE if doubt else PATH, 2, cv2.LINE_AA, 4)
        self._car(picture, odometry, pixels)
        bar = 10 ** math.floor(math.log10(0.25 * width / scale))
        bar *= max(k for k in (1, 2, 5) if k * bar * scale <= 0.25 * width)
        left, low = 12, height - 14
        cv2.line(picture, (left, low), (left + round(bar * scale), low), INK, 2)
        unit = "m" if odometry.gps is not None else "x the first step"
        _write(picture, f"{bar:g} {unit}", (left, low - 8), size=0.45)
        facts = f"{len(odometry.map.keyframes)} keyframes, {len(near)} points, map {odometry.map.part + 1}"
        _write(picture, facts, (12, 20), size=0.45)

    def _car(self, picture: Any, odometry: Odometry, pixels: Any) -> None:
        import cv2

        pose = odometry.pose_of(odometry.placed[-1])
        ahead, at = pose[[0, 2], 2], pixels(pose[[0, 2], 3])
        ahead = ahead * [1, -1] / max(float(np.linalg.norm(ahead)), 1e-9)
        side = np.array([-ahead[1], ahead[0]])
        arrow = [at + 10 * ahead, at - 6 * ahead + 6 * side, at - 3 * ahead, at - 6 * ahead - 6 * side]
        colour = UNSURE if odometry.placed[-1].unsure else (255, 255, 255)
        cv2.fillPoly(picture, [np.round(arrow).astype(np.int32)], colour, cv2.LINE_AA)

    def _remember(self, odometry: Odometry) -> None:
        """The path so far; places of keyframes that have left the window don't move any more."""
        placed, map_ = odometry.placed, odometry.map
        fresh = np.array([odometry.pose_of(p)[[0, 2], 3] for p in placed[self._fresh :]]).reshape(-1, 2)
        self._path = np.concatenate([self._path[: self._fresh], fresh])
        settled = len(map_.keyframes) - map_.params.window - map_.params.anchors - 2
        while self._fresh < len(placed) and placed[self._fresh].keyframe < settled:
            self._fresh += 1
        if len(map_.keyframes) >= self._keyframes + 5 and len(map_.landmarks):
            self._keyframes = len(map_.keyframes)
            some = map_.landmarks.xyz[:: max(1, len(map_.landmarks) // 200)][:, [0, 2]]
            self._dots = np.concatenate([self._dots, some])
            if len(self._dots) > DOTS:
                self._dots = self._dots[::2]

    def _zoom(self, odometry: Odometry, height: int, width: int) -> tuple[float, F64]:
        """Pixels a metre, and the place in the middle: all of the path; changes in steps, lest the picture swim."""
        low, high = self._path.min(axis=0), self._path.max(axis=0)
        reach = 1.0
        if len(odometry.map.landmarks):
            away = odometry.map.landmarks.xyz[:, [0, 2]] - self._path[-1]
            reach = 1.5 * float(np.median(np.linalg.norm(away, axis=1)))
        span = np.maximum(high - low, max(reach, 1e-3)) * 1.25
        scale = float(min(width / span[0], height / span[1]))
        step = 2.0 ** (math.floor(4 * math.log2(scale)) / 4)
        grid = 0.05 * width / step
        return step, np.round((low + high) / 2 / grid) * grid


def _stretches(unsure: Bools) -> list[tuple[slice, bool]]:
    """Runs of frames that are all unsure, or all not, each joined to the one before."""
    edges = np.flatnonzero(np.diff(unsure)) + 1
    bounds = [0, *edges.tolist(), len(unsure)]
    return [(slice(max(0, a - 1), b), bool(unsure[a])) for a, b in pairwise(bounds)]


def _write(picture: Any, text: str, at: tuple[int, int], colour: tuple[int, int, int] = INK, size: float = 0.6) -> None:
    import cv2

    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    left, right, top, low = max(0, at[0] - 4), at[0] + width + 4, max(0, at[1] - height - 3), at[1] + below
    picture[top:low, left:right] //= 3
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _whole(part: Path, file: Path) -> None:
    """Bring fragments together, so that players can jump; the file appears whole or not."""
    import av

    fresh = file.with_name(f".{file.name}.fresh")
    try:
        with (
            av.open(str(part)) as source,
            av.open(str(fresh), "w", format="mp4", options={"movflags": "faststart"}) as target,
        ):
            stream = target.add_stream_from_template(source.streams.video[0])
            for packet in source.demux(video=0):
                if packet.dts is not None:
                    packet.stream = stream
                    target.mux(packet)
        fresh.replace(file)
        part.unlink()
    finally:
        fresh.unlink(missing_ok=True)
