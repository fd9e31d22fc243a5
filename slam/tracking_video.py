"""Tracking video: records the tracked features and the camera's path as a video."""

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

MAX_WIDTH_PX, MIN_FRAME_WIDTH_PX = 1280, 960
"""Greatest width of the video; smaller frames are enlarged to the second."""
RATE_HZ = 6.0
"""Approximate frame rate of the recording, in video time."""
OLD_POINTS_MAX = 20_000
"""Greatest number of old map points shown."""
INLIER_BGR, OUTLIER_BGR, CANDIDATE_BGR = np.array([80, 220, 60]), np.array([40, 130, 250]), (0, 230, 250)
PATH_BGR, UNSURE_BGR, BACKGROUND_BGR, TEXT_BGR = (235, 190, 120), (60, 60, 255), (28, 26, 24), (225, 225, 225)
OLD_POINT_BGR, POINT_BGR = (105, 100, 95), (170, 200, 170)


class Recorder:
    """Records odometry: call it after each frame (`watch` of `video_odometry.track`), and `close` it at the end.

    The frame is above, or on the left: map points are green, more red with larger reprojection error; features without
    a point are yellow. The plan view is below, or on the right, in odometry's own world with the first view direction
    upwards: the path, red where it is unsure, and the map points.

    The video is written to `NAME.part.mp4`, which can be played at any time, also after an interruption, and is renamed
    at the end. A recorder can start in the middle of a run: it takes the earlier path from the odometry.
    """

    def __init__(self, file: Path, fps: float) -> None:
        """`file`: MP4 to write; `fps`: frame rate of the calls, of which about `RATE_HZ` are recorded."""
        self.file = file
        self._part = file.with_name(f"{file.stem}.part.mp4")
        self._every = max(1, round(fps / RATE_HZ))
        self._rate = fps / self._every
        self._seen, self._written = -1, 0
        self._encoder: Encoder | None = None
        self._canvas = np.zeros((0, 0, 3), np.uint8)
        self._path, self._final = np.zeros((0, 2)), 0  # plan positions of all frames; number of those that are final
        self._old_points, self._keyframes = np.zeros((0, 2)), 0

    def __call__(self, odometry: Odometry, grey: U8) -> None:
        """Record a frame (H, W) that odometry has processed."""
        self._seen += 1
        if self._seen % self._every or not odometry.map.keyframes:
            return
        image = self.draw(odometry, grey)
        import cv2

        if self._encoder is None:
            size = image.shape[1], image.shape[0]
            try:
                self.file.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise from_os_error(error, self.file) from error
            # fragmented MP4 remains playable after an interruption
            options = {"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"}
            self._encoder = Encoder(
                self._part, size, self._rate, container=options, preset="ultrafast", crf="25", g=f"{4 * self._rate:.0f}"
            )
        self._encoder.add(cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420), self._written / self._rate)
        self._written += 1

    def close(self) -> None:
        """Finish the video and move it into place."""
        if self._encoder is None:
            return
        encoder, self._encoder = self._encoder, None
        encoder.close()
        try:
            _defragment(self._part, self.file)
        except OSError as error:
            raise from_os_error(error, self.file) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def draw(self, odometry: Odometry, grey: U8) -> U8:
        """Image (H, W, 3) BGR of the frame and the plan view; overwritten by the next call."""
        h, w = grey.shape
        beside = w < 1.4 * h
        frame_width = min(MAX_WIDTH_PX, max(MIN_FRAME_WIDTH_PX, w))
        height = MAX_WIDTH_PX * 9 / 16 if beside else min(MAX_WIDTH_PX * 9 / 16, frame_width * h / w)
        height = 2 * round(height / 2)
        width = 2 * round(height * w / h / 2)
        rows, columns = (height, MAX_WIDTH_PX) if beside else (height + 2 * round(0.2 * width), width)
        if self._canvas.shape != (rows, columns, 3):
            self._canvas = np.empty((rows, columns, 3), np.uint8)
        self._draw_frame(self._canvas[:height, :width], odometry, grey)
        self._draw_plan(self._canvas[:, width:] if beside else self._canvas[height:], odometry)
        return self._canvas

    # --- the frame

    def _draw_frame(self, image: U8, odometry: Odometry, grey: U8) -> None:
        import cv2

        height, width = image.shape[:2]
        interpolation = cv2.INTER_AREA if width < grey.shape[1] else cv2.INTER_LINEAR
        image[:] = cv2.resize(grey, (width, height), interpolation=interpolation)[..., None]
        tracks, map_ = odometry.tracker.tracks, odometry.map
        rows, known = map_.landmarks.find(tracks.ids)
        inliers = 0
        if len(tracks):
            camera = odometry.views.camera
            uv, ok = project(camera, tracks.bearing)
            # cv2.circle takes fixed-point coordinates: sixteenths of pixels, with shift 4
            xy = np.round(16 * ((uv + 0.5) * [width / camera.width, height / camera.height] - 0.5))
            xy = np.where(ok[:, None] & np.isfinite(xy), xy, -1000).astype(int)
            for x, y in xy[~known].tolist():
                cv2.circle(image, (x, y), 24, CANDIDATE_BGR, -1, cv2.LINE_8, 4)
            if known.any():
                pose = odometry.pose_of(odometry.placed[-1])
                error = angles(pose, map_.landmarks.xyz[rows[known]], tracks.bearing[known])
                inliers = int((error < map_.gate).sum())
                share = np.clip(error / map_.gate, 0, 1)[:, None]
                colours = ((1 - share) * INLIER_BGR + share * OUTLIER_BGR).tolist()
                for (x, y), colour in zip(xy[known].tolist(), colours, strict=True):
                    cv2.circle(image, (x, y), 40, colour, -1, cv2.LINE_8, 4)
        placed = odometry.placed[-1]
        text = f"{placed.time:7.2f} s   {inliers} inliers of {len(tracks)} tracks"
        _write(image, text, (10, 24))
        if placed.unsure:
            state = "LOST: dead reckoning" if map_.part == 0 else f"LOST: map {map_.part + 1}"
            _write(image, state, (10, 52), UNSURE_BGR)

    # --- the plan view

    def _draw_plan(self, image: U8, odometry: Odometry) -> None:
        """Plan view with the world's x to the right and z upwards: the first camera looks upwards in the image."""
        import cv2

        self._update_path(odometry)
        height, width = image.shape[:2]
        image[:] = BACKGROUND_BGR
        scale, middle = self._zoom(odometry, height, width)

        def pixels(positions: F64) -> F64:
            return (positions - middle) * [scale, -scale] + [width / 2, height / 2]

        points = odometry.map.landmarks.xyz[:, [0, 2]]
        for dots, colour, size in ((self._old_points, OLD_POINT_BGR, 1), (points, POINT_BGR, 2)):
            x, y = np.round(pixels(dots)).astype(int).T
            inside = (x >= 0) & (x < width - 1) & (y >= 1) & (y < height)
            for shift in range(size):
                image[y[inside], x[inside] + shift] = colour
                image[y[inside] - shift, x[inside]] = colour
        unsure = np.array([p.unsure for p in odometry.placed])
        for stretch, is_unsure in _stretches(unsure):
            at = pixels(self._path[stretch])
            at = at[:: max(1, len(at) // 3000)] if len(at) > 3000 else at
            line = np.round(16 * np.clip(at, -4000, 4000)).astype(np.int32)
            cv2.polylines(image, [line], False, UNSURE_BGR if is_unsure else PATH_BGR, 2, cv2.LINE_AA, 4)
        self._draw_car(image, odometry, pixels)
        bar = 10 ** math.floor(math.log10(0.25 * width / scale))
        bar *= max(k for k in (1, 2, 5) if k * bar * scale <= 0.25 * width)
        left, bottom = 12, height - 14
        cv2.line(image, (left, bottom), (left + round(bar * scale), bottom), TEXT_BGR, 2)
        unit = "m" if odometry.gps is not None else "x the first baseline"
        _write(image, f"{bar:g} {unit}", (left, bottom - 8), size=0.45)
        counts = f"{len(odometry.map.keyframes)} keyframes, {len(points)} points, map {odometry.map.part + 1}"
        _write(image, counts, (12, 20), size=0.45)

    def _draw_car(self, image: Any, odometry: Odometry, pixels: Any) -> None:
        import cv2

        pose = odometry.pose_of(odometry.placed[-1])
        ahead, at = pose[[0, 2], 2], pixels(pose[[0, 2], 3])
        ahead = ahead * [1, -1] / max(float(np.linalg.norm(ahead)), 1e-9)
        side = np.array([-ahead[1], ahead[0]])
        arrow = [at + 10 * ahead, at - 6 * ahead + 6 * side, at - 3 * ahead, at - 6 * ahead - 6 * side]
        colour = UNSURE_BGR if odometry.placed[-1].unsure else (255, 255, 255)
        cv2.fillPoly(image, [np.round(arrow).astype(np.int32)], colour, cv2.LINE_AA)

    def _update_path(self, odometry: Odometry) -> None:
        """Update path and old points; frames whose keyframes have left the window don't move any more."""
        placed, map_ = odometry.placed, odometry.map
        moving = np.array([odometry.pose_of(p)[[0, 2], 3] for p in placed[self._final :]]).reshape(-1, 2)
        self._path = np.concatenate([self._path[: self._final], moving])
        fixed_keyframes = len(map_.keyframes) - map_.params.window - map_.params.fixed_keyframes - 2
        while self._final < len(placed) and placed[self._final].keyframe < fixed_keyframes:
            self._final += 1
        if len(map_.keyframes) >= self._keyframes + 5 and len(map_.landmarks):
            self._keyframes = len(map_.keyframes)
            sample = map_.landmarks.xyz[:: max(1, len(map_.landmarks) // 200)][:, [0, 2]]
            self._old_points = np.concatenate([self._old_points, sample])
            if len(self._old_points) > OLD_POINTS_MAX:
                self._old_points = self._old_points[::2]

    def _zoom(self, odometry: Odometry, height: int, width: int) -> tuple[float, F64]:
        """Pixels per metre, and plan position of the view's centre, to show all of the path; changes in discrete steps.

        With continuous changes, the plan would move in every frame.
        """
        low, high = self._path.min(axis=0), self._path.max(axis=0)
        extent = 1.0
        if len(odometry.map.landmarks):
            offset = odometry.map.landmarks.xyz[:, [0, 2]] - self._path[-1]
            extent = 1.5 * float(np.median(np.linalg.norm(offset, axis=1)))
        span = np.maximum(high - low, max(extent, 1e-3)) * 1.25
        scale = float(min(width / span[0], height / span[1]))
        step = 2.0 ** (math.floor(4 * math.log2(scale)) / 4)
        grid = 0.05 * width / step
        return step, np.round((low + high) / 2 / grid) * grid


def _stretches(unsure: Bools) -> list[tuple[slice, bool]]:
    """Runs of frames (slice, unsure) of equal `unsure`; each starts with the last frame of the previous run."""
    edges = np.flatnonzero(np.diff(unsure)) + 1
    bounds = [0, *edges.tolist(), len(unsure)]
    return [(slice(max(0, a - 1), b), bool(unsure[a])) for a, b in pairwise(bounds)]


def _write(
    image: Any, text: str, at: tuple[int, int], colour: tuple[int, int, int] = TEXT_BGR, size: float = 0.6
) -> None:
    import cv2

    (width, height), descent = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    left, right, top, bottom = max(0, at[0] - 4), at[0] + width + 4, max(0, at[1] - height - 3), at[1] + descent
    image[top:bottom, left:right] //= 3
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _defragment(part: Path, file: Path) -> None:
    """Rewrite a fragmented MP4 so that players can seek; replaces `file` atomically."""
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
