"""Synthetic videos of level crossings: correct boxes and speeds, reproducible by seed."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from scan2sim.data_samples import crossing
from scan2sim.data_samples.crossing_traffic import MOVING_SPEED_MIN, TIME_STEP_S
from scan2sim.data_samples.stage import View as FrameGeometry
from scan2sim.data_samples.stage import rotation_z
from scan2sim.pipeline.core.types import Bools


@pytest.fixture(scope="module")
def view() -> crossing.View:
    return crossing.view(0, 4, 40.0)


def test_boxes_agree_with_projected_meshes(view: crossing.View) -> None:
    checked = 0
    for index in range(0, 1000, 90):
        frame = view.frame(index)
        geometry = FrameGeometry(view.backdrop, crossing.FRAME_SIZE_PX, view.shake(index / crossing.FPS))
        for seen in frame.visible:
            points = np.concatenate(
                [p.body.part.vertices @ rotation_z(p.heading).T + p.position for p in seen.actor.pieces]
            )
            pixels, depth = geometry.project(points.astype(np.float64))
            if (depth < 1).any():
                continue
            low, high = pixels.min(axis=0), pixels.max(axis=0) + 1
            if (low < 0).any() or (high > crossing.FRAME_SIZE_PX).any():
                continue  # the box is that of the visible part only
            assert np.abs(np.array(seen.box) - [*low, *high]).max() < 2.5, (index, seen.actor.label)
            checked += 1
    assert checked > 10


def test_objects_change_only_their_own_pixels_and_their_shadows(view: crossing.View) -> None:
    actors = view.traffic.at(500)
    empty = view.stage.frame(view.backdrop, [], crossing.FRAME_SIZE_PX).rgb.astype(int)
    frame = view.stage.frame(view.backdrop, actors, crossing.FRAME_SIZE_PX)
    changed = np.abs(frame.rgb - empty).max(axis=2) > 12
    near_objects: Bools = cv2.dilate((frame.owner >= 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    lighter = (frame.rgb - empty).max(axis=2) > 12
    assert changed[frame.owner >= 0].mean() > 0.7
    assert not (lighter & ~near_objects).any(), "objects darken pixels around them, never brighten"
    for k, seen in enumerate(s for s in frame.visible if s.visible == 1):
        rows, columns = np.nonzero(frame.owner == actors.index(seen.actor))
        x0, y0, x1, y1 = seen.box
        assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == (x0, y0, x1, y1), k


def test_the_same_seed_makes_the_same_frames(view: crossing.View) -> None:
    again = crossing.view(0, 4, 40.0)
    np.testing.assert_array_equal(view.frame(300).rgb, again.frame(300).rgb)
    assert crossing.labels(view.frame(300)) == crossing.labels(again.frame(300))
    other = crossing.view(1, 4, 40.0)
    assert (view.frame(300).rgb != other.frame(300).rgb).mean() > 0.5


def test_speeds_agree_with_displacements(view: crossing.View) -> None:
    kinds = set()
    for index in range(0, 990, 5):
        now = {a.track: a for a in view.traffic.at(index)}
        next_frame = {a.track: a for a in view.traffic.at(index + 1)}
        for track in now.keys() & next_frame.keys():
            a, b = now[track], next_frame[track]
            if len(a.pieces) != len(b.pieces) or not a.pieces:
                continue  # a train that enters or leaves
            speed = np.linalg.norm(b.pieces[0].position - a.pieces[0].position) / TIME_STEP_S
            assert abs(speed - a.speed) < 0.6, (index, a.label)
            if a.speed == 0 == b.speed:
                assert speed == 0
            kinds.add((a.label == "train", a.speed >= MOVING_SPEED_MIN))
    assert len(kinds) == 4, "expected moving and stationary trains and cars"


def test_no_car_is_on_the_crossing_when_a_train_passes() -> None:
    for number in range(4):
        traffic = crossing.view(2, number, 40.0).traffic
        for index in range(0, 1000, 5):
            train_passes = any(t.head[index] > -2 and t.head[index] - t.length < 2 for t in traffic.trains)
            for cars in traffic._lanes.values():
                assert not train_passes or not any(s > 0 > s - car.length for car, s, _ in cars[index]), (number, index)


def test_videos_are_written_with_ground_truth_per_frame(tmp_path: Path) -> None:
    crossing.film(tmp_path, views=2, frames=6, seed=3)
    lines = [json.loads(line) for line in (tmp_path / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [(line["view"], line["frame"]) for line in lines] == [(v, f) for v in (0, 1) for f in range(6)]
    assert {line["light"] for line in lines} == {"day", "dusk"}
    brightness = []
    for number in range(2):
        video = cv2.VideoCapture(str(tmp_path / f"view_{number:02d}.mp4"))
        frames = []
        while (read := video.read())[0]:
            frames.append(read[1])
        assert len(frames) == 6 and frames[0].shape == (360, 640, 3)
        brightness.append(np.mean(frames))
    assert brightness[1] < 0.8 * brightness[0]
    for label in (t for line in lines for t in line["objects"]):
        x0, y0, x1, y1 = label["box"]
        assert 0 <= x0 < x1 <= 640 and 0 <= y0 < y1 <= 360 and 0 <= label["visible"] <= 1
        assert label["moving"] == (label["speed"] >= MOVING_SPEED_MIN)
