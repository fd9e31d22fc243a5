"""`scan2sim toolbox`: ML toolboxes on files, as HTTP services and as ROS 2 nodes (services/toolboxes)."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import print_line, progress, warn
from scan2sim.flows.commands.monitor import NODE_OPTIONS, Limits
from scan2sim.flows.commands.options import assigned, options
from scan2sim.flows.commands.ros_spin import spin
from scan2sim.pipeline.core import optional_deps
from scan2sim.services.toolboxes import offline, tasks
from scan2sim.services.toolboxes.engine import Engine
from scan2sim.services.toolboxes.results import State
from scan2sim.services.toolboxes.settings import CameraParams, NodeParams, ServeParams, ToolboxParams
from scan2sim.services.toolboxes.tasks import classify, detect, movement, segment

app = App("Run ML toolboxes on images: detection, movement, classification, segmentation.")

Images = Annotated[Path, typer.Argument(metavar="IMAGES", help="An image, a folder of images, or a video.")]
Out = Annotated[
    Path,
    typer.Option(
        "--out", "-o", help="Folder for the results (JSON lines), and for images or a video with the results drawn."
    ),
]
Draw = Annotated[bool, typer.Option(help="Draw the results into copies of the images or the video.")]
Box = Annotated[str, typer.Argument(metavar="TOOLBOX", help=f"Toolbox to run: {', '.join(tasks.names())}.")]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="PARAM=VALUE",
        help="Setting of the toolbox, such as threshold=0.4; repeatable; `scan2sim toolbox TOOLBOX --help` lists them.",
    ),
]


@app.command("detect")
@options(detect.Params)
def toolbox_detect(params: detect.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Detect objects: label, score and bounding box of each."""
    _over_files("detect", params, images, out, draw)


@app.command("movement")
@options(movement.Params)
def toolbox_movement(params: movement.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Detect and track objects, and report which of them move; for a stationary camera."""
    _over_files("movement", params, images, out, draw)


@app.command("classify")
@options(classify.Params)
def toolbox_classify(params: classify.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Classify whole images: the most likely classes of each."""
    _over_files("classify", params, images, out, draw)


@app.command("segment")
@options(segment.Params)
def toolbox_segment(params: segment.Params, images: Images, out: Out, draw: Draw = True) -> None:
    """Segment images: a class for each pixel."""
    _over_files("segment", params, images, out, draw)


@app.command("train")
def toolbox_train(
    drives: Annotated[
        list[Path],
        typer.Option(
            "--drives",
            metavar="TILE",
            help="Drive to learn from: a tile with a lidar's cloud and photos, its folder or tile.toml; repeatable.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="Output folder: vehicles.onnx, labels, cached results. The same command resumes an interrupted run.",
        ),
    ],
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", metavar="TILE", help="Drive that is only used for the evaluation; repeatable."),
    ] = None,
    minutes: Annotated[float, typer.Option(min=0, help="Time limit of the training in minutes; 0: none.")] = 60,
    steps: Annotated[int, typer.Option(min=1, help="Number of optimiser steps.")] = 3000,
    synthetic: Annotated[
        int,
        typer.Option(help="Number of generated images beside the photos, so that other classes are not forgotten."),
    ] = 900,
    start: Annotated[
        Path | None, typer.Option(help="Weights (.safetensors) to start from; default: those of the included network.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
    seed: Annotated[int, typer.Option(help="Random seed of crops and augmentation.")] = 0,
) -> None:
    """Train the detector on drives: the lidar's vehicles, projected into the photos, are the labels."""
    from scan2sim.flows.commands.toolbox_train import train_on_drives

    train_on_drives(
        drives, out, held_out or [], minutes=minutes, steps=steps, synthetic=synthetic, start=start, threads=threads,
        seed=seed,
    )  # fmt: skip


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
    """Serve a toolbox by HTTP, and by gRPC if --grpc-port is given (Open Inference Protocol)."""
    optional_deps.require("a toolbox by HTTP", "fastapi", "uvicorn", "prometheus_client")
    from scan2sim.services.http import factory
    from scan2sim.services.toolboxes.api import application
    from scan2sim.services.toolboxes.sources import Cameras

    settings = _params(box, set_)
    if params.grpc_port is not None:
        optional_deps.require("--grpc-port", "grpc")
    with ExitStack() as stack:
        engine = stack.enter_context(closing(Engine(box, settings)))
        cameras = Cameras(engine, camera) if camera else None
        served = application(engine, params, cameras)
        if params.grpc_port is not None:
            from scan2sim.services.toolboxes.inference import grpc_server

            grpc_address = stack.enter_context(grpc_server.serving(engine, params, params.grpc_port))
            print_line(f"gRPC: {grpc_address}")
        if cameras:
            stack.callback(cameras.stop)
            cameras.start()
        factory.run(served, params, lambda address: print_line(f"{address}v2/models/{box}/infer; Ctrl-C stops it"))


@app.command("node")
@options(NodeParams, **NODE_OPTIONS)
def toolbox_node(
    params: NodeParams,
    box: Box,
    images: Annotated[
        list[str], typer.Option("--images", metavar="TOPIC", help=NodeParams.model_fields["images"].description)
    ],
    set_: Sets = None,
    limit: Limits = None,
) -> None:
    """Run a toolbox as a ROS 2 node: subscribes to image topics, publishes results to a topic."""
    optional_deps.require("a toolbox as a node", "psutil")
    from scan2sim.services.toolboxes.node import ToolboxNode

    with closing(Engine(box, _params(box, set_))) as engine:
        spin(lambda: ToolboxNode(engine, params))


@app.command("camera")
@options(CameraParams, **NODE_OPTIONS)
def toolbox_camera(params: CameraParams, limit: Limits = None) -> None:
    """Run a camera as a ROS 2 node: publishes the images of a folder, a video or a camera to a topic."""
    optional_deps.require("a camera as a node", "psutil")
    from scan2sim.services.toolboxes.camera import CameraNode

    spin(lambda: CameraNode(params), lambda node: node.finished)


def _over_files(box: str, params: ToolboxParams, images: Path, out: Path, draw: bool) -> None:
    """Run a toolbox on files, without the deadline of live images."""
    patient = params.model_copy(update={"deadline": offline.OFFLINE_DEADLINE_S})
    with closing(Engine(box, patient)) as engine, progress(box) as report:
        ended = offline.process_files(engine, images, out, report, draw=draw)
    print_line(f"{ended.pop(State.DONE, 0)} images: {out / offline.RESULTS_FILE}")
    for state, count in ended.items():
        warn(f"{count} images were {state}; {out / offline.RESULTS_FILE} has the reasons")


def _params(box: str, assignments: list[str] | None) -> ToolboxParams:
    """Settings of a toolbox from option --set.

    Raises:
        SettingError: there is no such toolbox or setting, or a value is out of range.
    """
    given = assigned(assignments or (), "threshold=0.4")
    kind = tasks.find(box).Params
    return kind.of(box, given, remedy=f"`scan2sim toolbox {box} --help` lists its settings")
