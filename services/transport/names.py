"""Names of ROS 2 on DDS: topics, types and hashes, as every vendor of its middleware maps them.

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
        json_schema_extra={"range": "a name of ROS 2: the letters a to z, digits and _, parts of them parted by /"},
    ),
]
"""Of a topic, as a setting."""
TYPE = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")


def qualified(topic: str, namespace: str = "/") -> str:
    """The full name of a topic, "/robot/image".

    Raises:
        SettingError: ROS 2 allows no such name.
    """
    if not TOPIC.fullmatch(topic):
        raise SettingError(
            f"topic {topic!r}",
            "ROS 2 has no topics of such names",
            "Names are made of the letters a to z, digits and _, parts of them parted by /; none begins with a digit",
        )
    return topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"


def dds_topic(topic: str) -> str:
    """What a topic is called on DDS: "/image" is "rt/image"."""
    return "rt" + topic


def ros_topic(name: str) -> str | None:
    """A topic's name by what it is called on DDS; None: it is none of ROS."""
    return name[2:] if name.startswith("rt/") else None


def dds_type(name: str) -> str:
    """What a type is called on DDS: "std_msgs/msg/String" is "std_msgs::msg::dds_::String_"; others stay."""
    package, _, rest = name.partition("/")
    kind, _, leaf = rest.partition("/")
    return f"{package}::{kind}::dds_::{leaf}_" if leaf else name


def ros_type(name: str) -> str:
    """A type's name by what it is called on DDS; what isn't of ROS stays as it is."""
    parts = name.split("::")
    if len(parts) == 4 and parts[2] == "dds_" and name.endswith("_"):
        return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
    return name


def checked_type(name: str) -> str:
    """The name of a type of messages, if it is one.

    Raises:
        SettingError: it isn't of the form PACKAGE/msg/NAME.
    """
    if not TYPE.fullmatch(name):
        raise SettingError(f"type {name!r}", "no name of a message", "Give it as PACKAGE/msg/NAME: std_msgs/msg/String")
    return name
