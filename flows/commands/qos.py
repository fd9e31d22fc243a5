"""`scan2sim qos`: quality of service of toolboxes, required and measured (services/qos)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from scan2sim.flows.commands import qos_table
from scan2sim.flows.commands.app import App, Json
from scan2sim.flows.commands.display import console, print_line, progress
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.qos_table import Out, or_dash
from scan2sim.pipeline.core import optional_deps
from scan2sim.pipeline.core.types import U8
from scan2sim.services.qos import requirements
from scan2sim.services.qos.compare import IMAGE_RATES, ResourceNeeds, compare_metrics, resource_needs
from scan2sim.services.qos.encoding import ChoiceParams, Jpeg, choose_h264, choose_jpeg, decode_h264, encode_h264
from scan2sim.services.qos.measure import MIN_SECONDS, MeasureParams, duration, measure
from scan2sim.services.qos.requirements import UNITS, Environment, Requirements
from scan2sim.services.toolboxes import frames, sources
from scan2sim.services.toolboxes.detector import agreement
from scan2sim.services.toolboxes.detector.metrics import Predictions
from scan2sim.services.toolboxes.frames import Frame
from scan2sim.services.toolboxes.tasks import detect

MAX_TEST_IMAGES, MAX_DETECTED_IMAGES = 60, 20
"""Number of images, consecutive ones of a video, on which encodings are compared, and how many the detector gets."""

app = App("Quality of service: requirements, measurement, choice of the image encoding.")


@app.command("show")
def qos_show(
    service: Annotated[
        str,
        typer.Argument(
            metavar="SERVICE", help=f"TOML file of requirements, or one of: {', '.join(requirements.names())}."
        ),
    ],
    as_json: Json = False,
) -> None:
    """Show the requirements of a service for each environment: robot, edge, cloud."""
    read = requirements.read(service)
    if as_json:
        print(read.model_dump_json(indent=1, exclude_none=True))
        return
    table = Table("metric", *Environment, title=f"{read.title} ({read.source})", title_justify="left")
    for metric in Requirements.model_fields:
        values = [getattr(getattr(read, one), metric, None) for one in Environment]
        if any(values):
            unit = UNITS.get(metric, "")
            table.add_row(metric.replace("_", " "), *(f"{one} {unit}" if one else "-" for one in values))
    console.print(table)


@app.command("measure")
@options(MeasureParams)
def qos_measure(params: MeasureParams, as_json: Json = False, out: Out = None) -> None:
    """Measure a service over an emulated network, and compare the results with its requirements.

    A toolbox answers a robot that sends images; `teleoperation` is a scripted drive; `traffic` sends events over the
    event bus from a publisher to a subscriber.
    """
    if params.service == "teleoperation":
        _measure_teleoperation(params, as_json, out)
    elif params.service == "traffic":
        _measure_event_bus(params, as_json, out)
    else:
        _measure_toolbox(params, as_json, out)


def _measure_teleoperation(params: MeasureParams, as_json: bool, out: Path | None) -> None:
    from scan2sim.flows.commands.teleop import measure_drive
    from scan2sim.services.teleoperation.settings import MeasureParams as DriveParams

    drive = DriveParams(environment=params.environment, network=params.network, seconds=params.seconds or MIN_SECONDS)
    measure_drive(drive, params.requirements or params.service, as_json=as_json, out=out)


def _measure_event_bus(params: MeasureParams, as_json: bool, out: Path | None) -> None:
    optional_deps.require("qos measure traffic", "psutil", "cyclonedds")
    from scan2sim.services.monitoring.qos import measure as bus

    service = requirements.read(params.requirements or params.service)
    required, seconds = service.of(params.environment), params.seconds or MIN_SECONDS
    with progress(f"event bus {params.environment}") as report:
        measured = bus.measure(params.environment, params.network, params.rate, params.event_bytes, seconds, report)
    events = measured.events
    lines = [f"{events.received} of {events.sent} events of {params.event_bytes:,} bytes were received"]
    title = f"{service.title}, {params.environment} ({service.source})"
    comparisons = compare_metrics(required, measured)
    qos_table.report(params.service, params, title, comparisons, lines, as_json=as_json, out=out, events=asdict(events))


def _measure_toolbox(params: MeasureParams, as_json: bool, out: Path | None) -> None:
    optional_deps.require("qos measure", "psutil", "fastapi", "uvicorn", "prometheus_client")
    service = requirements.read(params.requirements or params.service)
    required = service.of(params.environment)
    seconds, probe_rate = duration(params, required)
    if not as_json:
        print_line(f"measuring for {seconds:.0f} s, with {probe_rate:.0f} packets per second that probe the network")
    with progress(f"{params.service} {params.environment}") as report:
        measured = measure(params, service, report)
    needs = [resource_needs(measured, rate) for rate in IMAGE_RATES]
    answers = measured.requests
    done = answers.states.get("done", 0)
    lines = [
        f"{done} of {answers.sent} images were answered, half of them within {or_dash(answers.response_p50)} ms",
        f"images were sent as JPEGs{_jpeg_text(measured.encoding)}",
        *([f"preferred slice of a 5G network: {required.slice}"] if required.slice else []),
    ]
    if not as_json:
        console.print(_needs_table(needs))
    more = {
        "answers": asdict(answers),
        "encoding": asdict(measured.encoding),
        "needs": [asdict(one) for one in needs],
    }
    title = f"{service.title}, {params.environment} ({service.source})"
    comparisons = compare_metrics(required, measured)
    qos_table.report(params.service, params, title, comparisons, lines, as_json=as_json, out=out, **more)


@app.command("choose")
@options(ChoiceParams, images="IMAGES")
def qos_choose(params: ChoiceParams, as_json: Json = False) -> None:
    """Choose the encoding of images so that they fit into a bandwidth, and what accuracy it costs.

    JPEG quality and size, or H.264 bit rate; the accuracy is the agreement (F1) of detections in encoded images with
    those in the originals.
    """
    images = list(islice(sources.decoded_images(params.images), MAX_TEST_IMAGES))
    jpeg = choose_jpeg(images, params.rate, params.budget)
    stream = choose_h264(images, params.rate, params.budget)
    detector = detect.load(detect.Params(weights=params.weights))
    step = -(-len(images) // MAX_DETECTED_IMAGES)

    def detected(made: Sequence[U8], scale: float = 1.0) -> list[Predictions]:
        return agreement.predictions([detector([one])[0] for one in made], detector.info.labels, scale)

    original = detected(images[::step])
    decoded = [frames.rgb(Frame("", "", None, jpeg.encoded(one), lambda _: None)) for one in images[::step]]
    streamed = list(decode_h264(list(encode_h264(images, params.rate, stream.bitrate))))[::step]
    kept = {
        "jpeg": agreement.agreement(detected(decoded, jpeg.scale), original),
        "h264": agreement.agreement(detected(streamed), original),
    }
    if as_json:
        found = {"jpeg": asdict(jpeg), "h264": asdict(stream)}
        made = {kind: {**one, "agreement": kept[kind]} for kind, one in found.items()}
        print(json.dumps(qos_table.finite({**made, "detector": detector.info.name}), indent=1))
        return
    print_line(f"JPEGs{_jpeg_text(jpeg)}; {_agreement_text(kept['jpeg'])}")
    print_line(
        f"H.264: {stream.bitrate * 1e-6:.3g} Mbit/s for the encoder, at most {stream.megabits:.3g} on the wire; "
        f"{_agreement_text(kept['h264'])}"
    )
    print_line(f"agreement: F1 of the detections of {detector.info.name} relative to those in the original images")


def _agreement_text(share: float) -> str:
    return "agreement unknown: nothing is detected" if math.isnan(share) else f"agreement {share:.2f}"


def _jpeg_text(jpeg: Jpeg) -> str:
    size = "" if jpeg.scale == 1 else f" of {jpeg.scale:g} times the size"
    return f"{size} of quality {jpeg.quality}: at most {jpeg.megabits:.3g} Mbit/s on the wire"


def _needs_table(found: list[ResourceNeeds]) -> Table:
    table = Table(title="Resources needed by image rate (cores of this machine)", title_justify="left")
    for name in ("images per second", "Mbit/s on the network", "cores"):
        table.add_column(name, justify="right")
    for one in found:
        table.add_row(f"{one.rate:g}", or_dash(one.bandwidth), f"{one.cores:.2f}")
    return table
