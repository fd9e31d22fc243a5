"""Actors of a Gazebo world: SDF `<actor>` with a link and a trajectory over time, without plugins.

Gazebo shows them in cameras and lidars, moves them along their trajectory, and repeats it; nothing collides with them.
Whoever isn't in the scenario yet, or no longer, waits below the world (`HIDDEN_M`).
"""

from __future__ import annotations

from math import ceil

import numpy as np

from scan2sim.pipeline.core.classes import CODE
from scan2sim.pipeline.scenario.scenario import Actor, Scenario

HIDDEN_M = -500.0
"""Height of an actor while it isn't in the world."""
SWITCH_S = 0.001
"""Time to come from below the world, or to go there."""
LABELS = {"pedestrian": 201, "cyclist": 202}
"""Labels in segmentation cameras beyond those of LAS classes; vehicles have the code of their class."""


def elements(scenario: Scenario) -> str:
    """The `<actor>` elements of all that move, the ego left out: it is whoever is tested.

    Their shapes are found as `model://<actor>/meshes/<actor>.obj`.
    """
    duration = ceil(scenario.duration * 10) / 10
    return "".join(_actor(actor, duration) for actor in scenario.moving)


def _actor(actor: Actor, duration: float) -> str:
    points = "".join(_waypoint(*row) for row in _waypoints(actor, duration))
    label = LABELS.get(actor.track.category, CODE["vehicle"])
    return f"""    <actor name="{actor.name}">
      <link name="link">
        <visual name="shape">
          <geometry>
            <mesh><uri>model://{actor.name}/meshes/{actor.name}.obj</uri></mesh>
          </geometry>
          <plugin filename="gz-sim-label-system" name="gz::sim::systems::Label">
            <label>{label}</label>
          </plugin>
        </visual>
      </link>
      <script>
        <loop>true</loop>
        <auto_start>true</auto_start>
        <trajectory id="0" type="drive" tension="1.0">
{points}        </trajectory>
      </script>
    </actor>
"""


def _waypoints(actor: Actor, duration: float) -> list[tuple[float, float, float, float, float]]:
    """Time and pose (x, y, z, yaw) of each waypoint, from 0 to `duration`."""
    yaw = np.unwrap(actor.track.poses[:, 3])
    rows = np.column_stack([actor.track.times, actor.track.poses[:, :3], yaw])
    before, after = rows[0].copy(), rows[-1].copy()
    before[3] = after[3] = HIDDEN_M
    if actor.begin > SWITCH_S:
        rows = np.vstack([[0.0, *before[1:]], [actor.begin - SWITCH_S, *before[1:]], rows])
    if actor.end < duration - SWITCH_S:
        rows = np.vstack([rows, [actor.end + SWITCH_S, *after[1:]], [duration, *after[1:]]])
    found: list[tuple[float, float, float, float, float]] = [tuple(row) for row in rows.tolist()]
    return found


def _waypoint(time: float, x: float, y: float, z: float, yaw: float) -> str:
    return f"          <waypoint><time>{time:.4f}</time><pose>{x:.3f} {y:.3f} {z:.3f} 0 0 {yaw:.4f}</pose></waypoint>\n"
