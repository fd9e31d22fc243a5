"""Mapping of ROS 2 names of topics and types to DDS, as all RMW implementations define it.

Source: design.ros2.org, "Topic and Service name mapping to DDS"; REP 2011 (type hashes).
"""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import Field

from scan2sim.pipeline.core.errors import SettingError

TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
TopicName = Annotated[
    str,
    Field(
        pattern=f"^{TOPIC.pattern}$",
        json_schema_extra={"range": "a ROS 2 name: parts of the letters a to z, digits and _, separated by /"},
    ),
]
"""Type of a setting: name of a topic."""
TYPE = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")


def qualified(topic: str, namespace: str = "/") -> str:
    """Full name of a topic, such as "/robot/image".

    Raises:
        SettingError: the name is invalid in ROS 2.
    """
    if not TOPIC.fullmatch(topic):
        raise SettingError(
            f"topic {topic!r}",
            "not a valid name of a ROS 2 topic",
            "Use the letters a to z, digits and _, in parts separated by /; no part may begin with a digit",
        )
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


def dds_topic(topic: str) -> str:
    """DDS name of a topic: "/image" becomes "rt/image"."""
    return "rt" + topic


def ros_topic(name: str) -> str | None:
    """ROS 2 name of a DDS topic; None if it isn't a ROS 2 topic."""
    return name[2:] if name.startswith("rt/") else None


def dds_type(name: str) -> str:
    """DDS name of a type: "std_msgs/msg/String" becomes "std_msgs::msg::dds_::String_"; others are unchanged."""
    package, _, rest = name.partition("/")
    kind, _, leaf = rest.partition("/")
    return f"{package}::{kind}::dds_::{leaf}_" if leaf else name


def ros_type(name: str) -> str:
    """ROS 2 name of a DDS type; unchanged if it isn't a ROS 2 type."""
    parts = name.split("::")
    if len(parts) == 4 and parts[2] == "dds_" and name.endswith("_"):
        return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
    return name


def checked_type(name: str) -> str:
    """Check the name of a message type and return it.

    Raises:
        SettingError: it doesn't have the form PACKAGE/msg/NAME.
    """
    if not TYPE.fullmatch(name):
        cause = "not the name of a message type"
        raise SettingError(f"type {name!r}", cause, "Use PACKAGE/msg/NAME, such as std_msgs/msg/String")
    return name
