"""Mapping of ROS 2 names to DDS."""

from __future__ import annotations

import pytest

from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.transport import names


def test_names_are_mapped_like_in_ros_2() -> None:
    assert names.qualified("image", "/robot") == "/robot/image"
    assert names.qualified("/image", "/robot") == "/image"
    assert names.dds_topic("/robot/image") == "rt/robot/image"
    assert names.ros_topic("rt/robot/image") == "/robot/image"
    assert names.ros_topic("rq/robot/serviceRequest") is None
    assert names.dds_type("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert names.ros_type("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert names.ros_type("Other::Type") == "Other::Type"


@pytest.mark.parametrize("topic", ["straße", "", "/", "1st", "a b", "a//b", "a/", "~/x", "画像"])
def test_invalid_topic_names_are_rejected(topic: str) -> None:
    with pytest.raises(SettingError, match="letters a to z"):
        names.qualified(topic)


@pytest.mark.parametrize("name", ["String", "std_msgs/String", "std_msgs/msg/", "std_msgs/srv/Empty"])
def test_invalid_type_names_are_rejected(name: str) -> None:
    with pytest.raises(SettingError, match="PACKAGE/msg/NAME"):
        names.checked_type(name)
