"""Scenarios from tracks, impossible motions in them, and their variations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scan2sim.pipeline.scenario.lanes import lane_room
from scan2sim.pipeline.scenario.motion_check import impossible_motions
from scan2sim.pipeline.scenario.scenario import Scenario, from_tracks
from scan2sim.pipeline.scenario.variation import vary
from scan2sim.pipeline.tracking.tracks import Track
from tests.fakes import traffic


@pytest.fixture
def recorded() -> Scenario:
    return from_tracks("street", traffic.tracks())


def flat(places: np.ndarray) -> np.ndarray:
    return np.full(len(places), traffic.HEIGHT_M)


def test_scenario_begins_with_the_recording(recorded: Scenario) -> None:
    assert recorded.start == traffic.START_S and recorded.ego is not None
    assert [actor.name for actor in recorded.moving] == ["car_1", "van_2", "cyclist_3", "pedestrian_4"]
    assert {actor.name: actor.begin for actor in recorded.actors} == pytest.approx(
        {"car_1": 0.0, "van_2": 1.0, "cyclist_3": 0.5, "pedestrian_4": 1.0, "car_6": 0.0}
    )
    assert recorded.duration == pytest.approx(5.0, abs=0.01)


def test_offset_of_the_tile_is_added() -> None:
    moved = from_tracks("street", traffic.tracks(), (100.0, -20.0, 3.0))
    assert moved.ego is not None
    assert moved.ego.track.poses[0].tolist() == pytest.approx([105.0, -21.75, traffic.HEIGHT_M + 3.0, 0.0])


def test_possible_motions_are_not_reported(recorded: Scenario) -> None:
    assert impossible_motions(recorded, flat) == []


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda poses: poses + (0.0, 3.5 - 0.2, 0.0, 0.0), "overlap"),  # of the car ahead, into the path of the van
        (lambda poses: poses + (0.0, 0.0, 0.15, 0.0), "off the ground"),
        (lambda poses: np.where(np.arange(len(poses))[:, None] > 20, poses + (0.0, -0.4, 0.0, 0.0), poses), "jump"),
    ],
)
def test_impossible_motions_are_detected(recorded: Scenario, change: object, kind: str) -> None:
    assert callable(change)
    car = recorded.actors[0]
    wrong = replace(car, track=replace(car.track, poses=change(car.track.poses)))
    found = impossible_motions(replace(recorded, actors=(wrong, *recorded.actors[1:])), flat)
    assert {one.kind for one in found} == {kind} and all("car_1" in one.actors for one in found)
    assert kind in str(found[0])


def test_overlap_with_the_ego_waiting_at_its_end_is_detected(recorded: Scenario) -> None:
    behind = traffic.drive(9, "car", (4.2, 1.8, 1.5), (5.0, 100.0), -1.75, 20.0, 15.0)
    found = impossible_motions(from_tracks("street", [*traffic.tracks(), behind]))
    assert [one.actors for one in found if one.kind == "overlap"] == [("ego", "car_9")]


def test_lane_room_is_measured_on_both_sides() -> None:
    road = traffic.road()
    van = traffic.tracks()[2]
    room = lane_room([road], van)
    assert room is not None and (room.left, room.right) == pytest.approx((0.75, 0.75), abs=0.01)
    assert lane_room([road], replace(van, poses=van.poses + (0.0, 4.0, 0.0, 0.0))) is None
    across: Track = replace(van, poses=np.column_stack([van.poses[:, :3], van.poses[:, 3] + np.pi / 2]))
    assert lane_room([road], across) is None


def test_variations_are_possible_in_their_lanes_and_different(recorded: Scenario) -> None:
    roads = [traffic.road()]
    made = [vary(recorded, roads, 7, number) for number in range(1, 41)]
    in_lane = {
        actor.name: lane_room(roads, actor.track)
        for actor in recorded.moving
        if lane_room(roads, actor.track) is not None
    }
    assert set(in_lane) == {"car_1", "van_2", "cyclist_3"}
    for one in made:
        assert impossible_motions(one.scenario, flat) == []
        assert one.scenario.ego == recorded.ego and one.scenario.actors[-1] == recorded.actors[-1]
        for actor in one.scenario.moving:
            before = in_lane.get(actor.name)
            if before is not None:
                room = lane_room(roads, actor.track)
                assert room is not None and min(room.left, room.right) >= min(0.0, before.left, before.right) - 1e-6
    words = " ".join(words for one in made for words in one.changes.values())
    for kind in (
        "to the left in its lane",
        "to the right in its lane",
        "times as fast",
        "the other way",
        "removed",
        "added on the way of",
    ):
        assert kind in words
    assert len({str(one.changes) for one in made}) > 30


def test_variation_is_reproducible_by_seed(recorded: Scenario) -> None:
    first, again = (vary(recorded, [traffic.road()], 3, 5) for _ in range(2))
    assert first.changes == again.changes
    assert all(
        np.array_equal(one.track.poses, other.track.poses) and np.array_equal(one.track.times, other.track.times)
        for one, other in zip(first.scenario.actors, again.scenario.actors, strict=True)
    )
    assert vary(recorded, [traffic.road()], 4, 5).changes != first.changes
