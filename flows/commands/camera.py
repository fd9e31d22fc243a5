"""`scan2sim camera`: simulates a robot's camera in a finished world, as a ROS 2 node (services/world_camera)."""

from __future__ import annotations

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.monitor import NODE_OPTIONS, Limits
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.ros_spin import spin
from scan2sim.pipeline.io.worlds.scene import read_scene
from scan2sim.services.world_camera.pose_source import default_origin, pose_of
from scan2sim.services.world_camera.settings import WorldCameraParams

app = App(requirement=("the camera", "psutil"))


@app.command()
@options(WorldCameraParams, **NODE_OPTIONS)
def camera(params: WorldCameraParams, limit: Limits = None) -> None:
    """Simulate a robot's camera in a finished world: a ROS 2 node that publishes images, depth, classes, instances."""
    from scan2sim.services.world_camera.node import WorldCameraNode
    from scan2sim.texturing.world_camera import WorldCamera

    scene = read_scene(params.world)
    if params.origin is None:
        world = scene.tiles[0].folder.parents[1]
        origin = default_origin(world, "" if params.odometry else params.fixed_frame)
    else:
        origin = pose_of(params.origin)
    spin(lambda: WorldCameraNode(WorldCamera(scene, farthest=params.farthest), params, origin))
