"""Reader of URDF files, descriptions of robots: the fixed joints between their links (wiki.ros.org/urdf/XML/joint)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.types import F64
from scan2sim.pipeline.io import xml

REMEDY = "Give the URDF file of the robot; one of xacro must be expanded: xacro robot.urdf.xacro > robot.urdf"


def read_fixed_joints(path: Path) -> dict[tuple[str, str], F64]:
    """T_parent_child (4, 4) of all fixed joints, by the names of parent and child link; others move, and are left out.

    Raises:
        InputError: not a URDF file, or without fixed joints.
    """
    from scipy.spatial.transform import Rotation

    robot = xml.root(path, REMEDY)
    if robot.tag != "robot":
        raise InputError(path, f"is not a URDF file (its root is <{robot.tag}>, not <robot>)", REMEDY)
    found = dict[tuple[str, str], F64]()
    for joint in robot.findall("joint"):
        if joint.get("type") != "fixed":
            continue
        links = [end.get("link", "") if end is not None else "" for end in map(joint.find, ("parent", "child"))]
        origin, T = joint.find("origin"), np.eye(4)
        try:
            values = {"xyz": "0 0 0", "rpy": "0 0 0"} | ({} if origin is None else dict(origin.attrib))
            position, angles = (np.array(values[name].split(), np.float64) for name in ("xyz", "rpy"))
            if position.shape != (3,) or angles.shape != (3,) or not np.isfinite([position, angles]).all():
                raise ValueError(f"origin {dict(origin.attrib) if origin is not None else {}}")
            if not all(links):
                raise ValueError("it needs a parent and a child link")
        except ValueError as error:
            raise InputError(path, f"joint {joint.get('name')!r} is invalid ({error})", REMEDY) from None
        T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), position
        found[links[0].lstrip("/"), links[1].lstrip("/")] = T
    if not found:
        raise InputError(path, "has no fixed joints", REMEDY)
    return found
