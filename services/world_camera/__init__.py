"""World camera: a ROS 2 node that renders what a robot's camera would see in a finished world (docs/camera.md)."""
