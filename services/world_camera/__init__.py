"""World camera: a ROS 2 node that shows a robot what its camera would see in a finished world (docs/camera.md)."""
