"""`scan2sim qos`: quality of service of toolboxes, required and measured (services/qos)."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from scan2sim.flows.commands import qos_table
from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.qos_table import or_dash
from scan2sim.pipeline.core import optional_deps
from scan2sim.services.qos import requirements
from scan2sim.services.qos.compare import (
    IMAGE_RATES,
    MetricComparison,
    ResourceNeeds,
    compare_metrics,
    passed,
    resource_needs,
)
from scan2sim.services.qos.encoding import ChoiceParams, Jpeg, choose_h264, choose_jpeg
from scan2sim.services.qos.measure import MeasureParams, measure
from scan2sim.services.qos.requirements import MACHINE_METRICS, NETWORK_METRICS, UNITS, Environment, Requirements
from scan2sim.services.toolboxes import sources

MAX_TEST_IMAGES = 60
"""Number of images, consecutive ones of a video, on which encodings are compared."""

app = App("Quality of service of the toolboxes: requirements, measurement, choice of the image encoding.")


@app.command("show")
def qos_show(
    service: Annotated[
        str,
        typer.Argument(
            metavar="SERVICE", help=f"TOML file of requirements, or one of: {', '.join(requirements.names())}."
        ),
    ],
) -> None:
    """Show the requirements of a service for each environment: robot, edge, cloud."""
    read = requirements.read(service)
    table = Table("metric", *Environment, title=f"{read.title} ({read.source})", title_justify="left")
    for metric in Requirements.model_fields:
        values = [getattr(getattr(read, one), metric, None) for one in Environment]
        if any(values):
            unit = UNITS.get(metric, "")
            table.add_row(metric.replace("_", " "), *(f"{one} {unit}" if one else "-" for one in values))
    console.print(table)


@app.command("measure")
@options(MeasureParams)
def qos_measure(
    params: MeasureParams,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="JSON file for the measurements; input of `orchestrate place`.")
    ] = None,
) -> None:
    """Measure a toolbox with a robot over an emulated network, and compare the results with its requirements."""
    optional_deps.require("qos measure", "psutil", "fastapi", "uvicorn", "prometheus_client")
    service = requirements.read(params.requirements or params.toolbox)
    required = service.of(params.environment)
    with progress(f"{params.toolbox} {params.environment}") as report:
        measured = measure(params, service, report)
    comparisons = compare_metrics(required, measured)
    console.print(qos_table.table(f"{service.title}, {params.environment} ({service.source})", comparisons))
    console.print(_needs_table([resource_needs(measured, rate) for rate in IMAGE_RATES]))
    answers = measured.requests
    done = answers.states.get("done", 0)
    _say(f"{done} of {answers.sent} images were answered, half of them within {or_dash(answers.response_p50)} ms")
    _say(f"images were sent as JPEGs{_jpeg_text(measured.encoding)}")
    if required.slice:
        _say(f"preferred slice of a 5G network: {required.slice}")
    for name, metrics in (("service", NETWORK_METRICS), ("machine", MACHINE_METRICS)):
        _say(f"{name}: {'passed' if passed(comparisons, metrics) else 'FAILED'}")
    if out:
        document = {
            "toolbox": params.toolbox,
            "environment": params.environment,
            "passed": passed(comparisons, NETWORK_METRICS),
            "machine_passed": passed(comparisons, MACHINE_METRICS),
            "rows": [_json(row) for row in comparisons],
            "answers": asdict(answers),
            "encoding": asdict(measured.encoding),
        }
        out.write_text(json.dumps(document, indent=1), encoding="utf-8")


@app.command("choose")
@options(ChoiceParams, images="IMAGES")
def qos_choose(params: ChoiceParams) -> None:
    """Choose the encoding of images so that they fit into a bandwidth: JPEG quality and size, or H.264 bit rate."""
    images = list(islice(sources.decoded_images(params.images), MAX_TEST_IMAGES))
    jpeg = choose_jpeg(images, params.rate, params.budget)
    _say(f"JPEGs{_jpeg_text(jpeg)}")
    stream = choose_h264(images, params.rate, params.budget)
    _say(f"H.264: {stream.bitrate * 1e-6:.3g} Mbit/s for the encoder, at most {stream.megabits:.3g} on the wire")


def _jpeg_text(jpeg: Jpeg) -> str:
    size = "" if jpeg.scale == 1 else f" of {jpeg.scale:g} times the size"
    return f"{size} of quality {jpeg.quality}: at most {jpeg.megabits:.3g} Mbit/s on the wire"


def _json(row: MetricComparison) -> dict[str, object]:
    return asdict(row) | {"required": str(row.required) if row.required else None}


def _needs_table(found: list[ResourceNeeds]) -> Table:
    table = Table(title="Resources needed by image rate (cores of this machine)", title_justify="left")
    for name in ("images per second", "Mbit/s on the network", "cores"):
        table.add_column(name, justify="right")
    for one in found:
        table.add_row(f"{one.rate:g}", or_dash(one.bandwidth), f"{one.cores:.2f}")
    return table


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
