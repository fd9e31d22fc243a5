"""OpenSCENARIO XML 1.3 (ASAM): a scenario's road users with trajectories over time, in the world's OpenDRIVE network.

- Positions are `WorldPosition`, the inertial system of the OpenDRIVE file: world metres. The origin of a vehicle is the
  middle of its rear axle on the ground, as the standard demands, that of a pedestrian the middle of its box's bottom.
- Whoever appears later than at the start or leaves before the end is added and deleted (`EntityAction`).
- The ego repeats the recorded drive. With the parameter `replay_ego` set to false it only gets its first pose and
  speed, and is driven by the system under test.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import from_os_error
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.scenario.scenario import Actor, Scenario
from scan2sim.pipeline.scenario.shapes import axles

REPLAY_EGO = "replay_ego"
"""Parameter: whether the ego repeats the recorded drive."""
VEHICLE_CATEGORY = {"cyclist": "bicycle", "motorcycle": "motorbike", "ego": "car"}
"""OpenSCENARIO's name of a category, where it differs."""
MAX_SPEED_MPS = {"cyclist": 15.0, "truck": 30.0, "bus": 30.0}
"""Limit of the performance of a category; others 70 m/s."""
MAX_ACCELERATION_MPS2, MAX_DECELERATION_MPS2, MAX_STEERING_RAD = 10.0, 10.0, 0.6
PEDESTRIAN_MASS_KG = 75.0


def write(path: Path, scenario: Scenario, roads: str | None, models: Mapping[str, str]) -> None:
    """Write a scenario.

    Args:
        path: the .xosc file.
        scenario: its road users; world metres.
        roads: the OpenDRIVE file, relative to `path`; None: the world has no roads with lanes.
        models: file with the shape of an actor, relative to `path`, by the actor's name.

    Raises:
        SpaceError: the disk is full or not writable.
    """
    root = ET.Element("OpenSCENARIO")
    begin = datetime.fromtimestamp(scenario.start, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    about = f"Recorded traffic of {scenario.name}: {len(scenario.moving)} moving, {scenario.duration:.1f} s"
    ET.SubElement(root, "FileHeader", revMajor="1", revMinor="3", date=begin, description=about, author="scan2sim")
    declarations = ET.SubElement(root, "ParameterDeclarations")
    if scenario.ego:
        ET.SubElement(declarations, "ParameterDeclaration", name=REPLAY_EGO, parameterType="boolean", value="true")
    ET.SubElement(root, "CatalogLocations")
    network = ET.SubElement(root, "RoadNetwork")
    if roads:
        ET.SubElement(network, "LogicFile", filepath=roads)
    entities = ET.SubElement(root, "Entities")
    for actor in scenario.everyone:
        entities.append(_entity(actor, models.get(actor.name)))
    root.append(_storyboard(scenario))
    try:
        ET.indent(root)
        ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise from_os_error(error, path) from None


def rear_axle(actor: Actor) -> float:
    """Distance in metres of an actor's OpenSCENARIO origin forward of the middle of its box (negative: behind)."""
    found = axles(actor.track.category, actor.track.size)
    return found.rear if found else 0.0


def _entity(actor: Actor, model: str | None) -> ET.Element:
    element = ET.Element("ScenarioObject", name=actor.name)
    track, found = actor.track, axles(actor.track.category, actor.track.size)
    shape = {} if model is None else {"model3d": model}
    if found is None:
        about = {"name": actor.name, "pedestrianCategory": "pedestrian", "mass": _text(PEDESTRIAN_MASS_KG)}
        body = ET.SubElement(element, "Pedestrian", about | shape)
    else:
        category = VEHICLE_CATEGORY.get(track.category, track.category)
        body = ET.SubElement(element, "Vehicle", {"name": actor.name, "vehicleCategory": category} | shape)
    box = ET.SubElement(body, "BoundingBox")
    length, width, height = map(float, track.size)
    ET.SubElement(box, "Center", x=_text(-rear_axle(actor)), y="0", z=_text(height / 2))
    ET.SubElement(box, "Dimensions", width=_text(width), length=_text(length), height=_text(height))
    if found is not None:
        ET.SubElement(
            body, "Performance", maxSpeed=_text(MAX_SPEED_MPS.get(track.category, 70.0)),
            maxAcceleration=_text(MAX_ACCELERATION_MPS2), maxDeceleration=_text(MAX_DECELERATION_MPS2),
        )  # fmt: skip
        pair = ET.SubElement(body, "Axles")
        for name, steering, x in (("FrontAxle", MAX_STEERING_RAD, found.front - found.rear), ("RearAxle", 0.0, 0.0)):
            ET.SubElement(
                pair, name, maxSteering=_text(steering), wheelDiameter=_text(found.wheel_diameter),
                trackWidth=_text(found.track_width), positionX=_text(x), positionZ=_text(found.wheel_diameter / 2),
            )  # fmt: skip
    properties = ET.SubElement(body, "Properties")
    if track.colour:
        ET.SubElement(properties, "Property", name="colour", value="#{:02x}{:02x}{:02x}".format(*track.colour))
    return element


def _storyboard(scenario: Scenario) -> ET.Element:
    board = ET.Element("Storyboard")
    actions = ET.SubElement(ET.SubElement(board, "Init"), "Actions")
    for actor in scenario.everyone:
        if actor is scenario.ego or actor.begin == 0.0:
            own = ET.SubElement(actions, "Private", entityRef=actor.name)
            _position(ET.SubElement(ET.SubElement(own, "PrivateAction"), "TeleportAction"), _origins(actor)[0])
            if actor.track.moving:
                _speed(ET.SubElement(own, "PrivateAction"), float(actor.track.speeds()[0]))
    if not scenario.duration:
        ET.SubElement(board, "StopTrigger")
        return board
    act = ET.SubElement(ET.SubElement(board, "Story", name="traffic"), "Act", name="recorded")
    for actor in scenario.everyone:
        if actor.track.moving:
            act.append(_maneuvers(actor, scenario))
    _at(ET.SubElement(act, "StartTrigger"), "start", 0.0)
    _at(ET.SubElement(board, "StopTrigger"), "end", scenario.duration)
    return board


def _maneuvers(actor: Actor, scenario: Scenario) -> ET.Element:
    group = ET.Element("ManeuverGroup", name=f"{actor.name}_group", maximumExecutionCount="1")
    actors = ET.SubElement(group, "Actors", selectTriggeringEntities="false")
    ET.SubElement(actors, "EntityRef", entityRef=actor.name)
    maneuver = ET.SubElement(group, "Maneuver", name=f"{actor.name}_maneuver")
    is_ego = actor is scenario.ego
    if not is_ego and actor.begin > 0:
        event = _event(maneuver, f"{actor.name}_appears", actor.begin)
        change = ET.SubElement(event[0], "GlobalAction")
        entity = ET.SubElement(change, "EntityAction", entityRef=actor.name)
        _position(ET.SubElement(entity, "AddEntityAction"), _origins(actor)[0])
    event = _event(maneuver, f"{actor.name}_drives", actor.begin, if_true=REPLAY_EGO if is_ego else None)
    private = ET.SubElement(event[0], "PrivateAction")
    follow = ET.SubElement(ET.SubElement(private, "RoutingAction"), "FollowTrajectoryAction")
    trajectory = ET.SubElement(
        ET.SubElement(follow, "TrajectoryRef"), "Trajectory", name=f"{actor.name}_trajectory", closed="false"
    )
    line = ET.SubElement(ET.SubElement(trajectory, "Shape"), "Polyline")
    for time, pose in zip(actor.track.times.tolist(), _origins(actor), strict=True):
        _position(ET.SubElement(line, "Vertex", time=_text(time)), pose)
    reference = ET.SubElement(follow, "TimeReference")
    ET.SubElement(reference, "Timing", domainAbsoluteRelative="absolute", scale="1", offset="0")
    ET.SubElement(follow, "TrajectoryFollowingMode", followingMode="position")
    if not is_ego and actor.end < scenario.duration:
        event = _event(maneuver, f"{actor.name}_leaves", actor.end)
        change = ET.SubElement(event[0], "GlobalAction")
        ET.SubElement(ET.SubElement(change, "EntityAction", entityRef=actor.name), "DeleteEntityAction")
    return group


def _event(maneuver: ET.Element, name: str, time: float, if_true: str | None = None) -> ET.Element:
    """An event with an action (its first child) at a time, and a parameter that must be true."""
    event = ET.SubElement(maneuver, "Event", name=name, priority="parallel", maximumExecutionCount="1")
    ET.SubElement(event, "Action", name=f"{name}_action")
    _at(ET.SubElement(event, "StartTrigger"), name, time, if_true)
    return event


def _at(trigger: ET.Element, name: str, time: float, if_true: str | None = None) -> None:
    """Fill a trigger: from a time of the simulation on."""
    group = ET.SubElement(trigger, "ConditionGroup")
    condition = ET.SubElement(group, "Condition", name=f"{name}_time", delay="0", conditionEdge="none")
    by_value = ET.SubElement(condition, "ByValueCondition")
    ET.SubElement(by_value, "SimulationTimeCondition", value=_text(time), rule="greaterOrEqual")
    if if_true:
        condition = ET.SubElement(group, "Condition", name=f"{name}_{if_true}", delay="0", conditionEdge="none")
        by_value = ET.SubElement(condition, "ByValueCondition")
        ET.SubElement(by_value, "ParameterCondition", parameterRef=if_true, value="true", rule="equalTo")


def _speed(action: ET.Element, speed: float) -> None:
    own = ET.SubElement(ET.SubElement(action, "LongitudinalAction"), "SpeedAction")
    ET.SubElement(own, "SpeedActionDynamics", dynamicsShape="step", dynamicsDimension="time", value="0")
    ET.SubElement(ET.SubElement(own, "SpeedActionTarget"), "AbsoluteTargetSpeed", value=_text(speed))


def _position(parent: ET.Element, pose: Sequence[float]) -> None:
    x, y, z, yaw = pose
    world = {"x": _text(x), "y": _text(y), "z": _text(z), "h": _text(yaw), "p": "0", "r": "0"}
    ET.SubElement(ET.SubElement(parent, "Position"), "WorldPosition", world)


def _origins(actor: Actor) -> list[list[float]]:
    """Poses (T, 4) of the actor's origin in OpenSCENARIO, world metres; yaw without jumps."""
    poses: F64 = actor.track.poses.copy()
    poses[:, 3] = np.unwrap(poses[:, 3])
    poses[:, 0] += rear_axle(actor) * np.cos(poses[:, 3])
    poses[:, 1] += rear_axle(actor) * np.sin(poses[:, 3])
    found: list[list[float]] = poses.tolist()
    return found


def _text(value: float) -> str:
    return f"{round(value, 6):.12g}"
