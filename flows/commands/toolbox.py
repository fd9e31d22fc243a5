"""`scan2sim toolbox`: ML toolboxes over files, by HTTP and as nodes of ROS 2 (services/toolboxes)."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.flows.commands.monitor import NODE_OPTIONS, Limits
from scan2sim.flows.commands.options import assigned, options
from scan2sim.flows.commands.ros_spin import spin
from scan2sim.pipeline.core import optional_deps
from scan2sim.services.toolboxes import offline, tasks
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.results import State
from scan2sim.services.toolboxes.settings import CameraParams, NodeParams, ServeParams, ToolboxParams
from scan2sim.services.toolboxes.tasks import classify, detect, movement, segment

app = App("ML toolboxes: objects, movement, classes, segments of images, from files or as a service.")

Images = Annotated[Path, typer.Argument(metavar="IMAGES", help="A folder of pictures, a picture or a video.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for results, and pictures or a film with them.")]
Draw = Annotated[bool, typer.Option(help="Draw results into pictures, or a film of a video.")]
Box = Annotated[str, typer.Argument(metavar="TOOLBOX", help=", ".join(tasks.names()))]
Sets = Annotated[list[str] | None, typer.Option("--set", metavar="PARAM=VALUE", help="Change one of its settings.")]


@app.command("detect")
@options(detect.Params)
def toolbox_detect(params: detect.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Find objects, and box them."""
    _over_files("detect", params, images, out, draw)


@app.command("movement")
@options(movement.Params)
def toolbox_movement(params: movement.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Find objects, follow them, and say which move; the camera must stand."""
    _over_files("movement", params, images, out, draw)


@app.command("classify")
@options(classify.Params)
def toolbox_classify(params: classify.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Say what images show."""
    _over_files("classify", params, images, out, draw)


@app.command("segment")
@options(segment.Params)
def toolbox_segment(params: segment.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Say what each pixel shows."""
    _over_files("segment", params, images, out, draw)


@app.command("serve")
@options(ServeParams)
def toolbox_serve(
    params: ServeParams,
    box: Box,
    set_: Sets = None,
    camera: Annotated[
        list[str] | None, typer.Option("--camera", help=ServeParams.model_fields["camera"].description)
    ] = None,
) -> None:
    """Serve a toolbox by HTTP, as the Open Inference Protocol says."""
    optional_deps.need("a toolbox by HTTP", "fastapi", "uvicorn", "prometheus_client")
    from scan2sim.services.http import factory
    from scan2sim.services.toolboxes.api import application
    from scan2sim.services.toolboxes.sources import Cameras

    settings = _params(box, set_)
    with closing(Engine(box, settings)) as engine:
        cameras = Cameras(engine, camera) if camera else None
        served = application(engine, params, cameras)
        if cameras:
            cameras.start()
        try:
            factory.run(served, params, lambda address: _say(f"{address}v2/models/{box}/infer; Ctrl-C ends it"))
        finally:
            if cameras:
                cameras.stop()


@app.command("node")
@options(NodeParams, **NODE_OPTIONS)
def toolbox_node(
    params: NodeParams,
    box: Box,
    images: Annotated[
        list[str], typer.Option("--images", metavar="TOPIC", help=NodeParams.model_fields["images"].description)
    ],
    set_: Sets = None,
) -> None:
    """Run a toolbox as a node of ROS 2: images on topics in, results on a topic out."""
    optional_deps.need("a toolbox as a node", "psutil")
    from scan2sim.services.toolboxes.node import ToolboxNode

    with closing(Engine(box, _params(box, set_))) as engine:
        spin(lambda: ToolboxNode(engine, params))


@app.command("camera")
@options(CameraParams, **NODE_OPTIONS)
def toolbox_camera(params: CameraParams, limit: Limits = None) -> None:
    """Run a camera as a node of ROS 2: images of a folder, a video or a camera on a topic."""
    optional_deps.need("a camera as a node", "psutil")
    from scan2sim.services.toolboxes.camera import CameraNode

    spin(lambda: CameraNode(params), lambda node: node.finished)


def _over_files(box: str, params: ToolboxParams, images: Path, out: Path, draw: bool) -> None:
    """Run a toolbox over files, which can wait."""
    patient = params.model_copy(update={"deadline": offline.PATIENT})
    with closing(Engine(box, patient)) as engine, progress(box) as report:
        ended = offline.work_through(engine, images, out, report, draw=draw)
    _say(f"{ended.pop(State.DONE, 0)} images: {out / offline.RESULTS}")
    for state, count in ended.items():
        warn(f"{count} images were {state}; {out / offline.RESULTS} says why")


def _params(box: str, assignments: list[str] | None) -> ToolboxParams:
    """A toolbox's settings.

    Raises:
        SettingError: there is no such toolbox, or setting.
    """
    given = assigned(assignments or (), "threshold=0.4")
    kind = tasks.find(box).Params
    return kind.of(box, given, remedy=f"`scan2sim toolbox {box} --help` lists its settings")


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
