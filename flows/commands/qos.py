"""`scan2sim qos`: quality of service, as required and as measured (services/qos)."""

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
from scan2sim.services.qos.compare import RATES, Needs, Row, needs, passed, rows
from scan2sim.services.qos.encoding import ChoiceParams, Jpeg, choose_h264, choose_jpeg
from scan2sim.services.qos.measure import MeasureParams, measure
from scan2sim.services.qos.requirements import MACHINE, NETWORK, UNITS, Environment, Requirements
from scan2sim.services.toolboxes import sources

TRIED = 60
"""Images that a choice is tried on, at most: a stream's need to be in a row."""

app = App("Quality of service of toolboxes: what is required, and what a network and a machine give.")


@app.command("show")
def qos_show(
    service: Annotated[
        str, typer.Argument(help=f"TOML of requirements, or one of: {', '.join(requirements.names())}.")
    ],
) -> None:
    """Show what a service requires, by where it runs."""
    read = requirements.read(service)
    table = Table("metric", *Environment, title=f"{read.title} ({read.source})", title_justify="left")
    for metric in Requirements.model_fields:
        asked = [getattr(getattr(read, one), metric, None) for one in Environment]
        if any(asked):
            unit = UNITS.get(metric, "")
            table.add_row(metric.replace("_", " "), *(f"{one} {unit}" if one else "-" for one in asked))
    console.print(table)


@app.command("measure")
@options(MeasureParams)
def qos_measure(
    params: MeasureParams,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="JSON file for all that was measured.")] = None,
) -> None:
    """Run a toolbox and a robot over a network like the environment's, and hold what is measured against its needs."""
    optional_deps.need("measuring", "psutil", "fastapi", "uvicorn", "prometheus_client")
    service = requirements.read(params.requirements or params.toolbox)
    required = service.of(params.environment)
    with progress(f"{params.toolbox} {params.environment}") as report:
        measured = measure(params, service, report)
    found = rows(required, measured)
    console.print(qos_table.table(f"{service.title}, {params.environment} ({service.source})", found))
    console.print(_needs_table([needs(measured, rate) for rate in RATES]))
    answers = measured.answers
    done = answers.states.get("done", 0)
    _say(f"{done} of {answers.sent} images were answered, half of them within {or_dash(answers.response_p50)} ms")
    _say(f"images were sent as JPEGs{_told(measured.encoding)}")
    if required.slice:
        _say(f"preferred slice of a 5G network: {required.slice}")
    for name, metrics in (("service", NETWORK), ("machine", MACHINE)):
        _say(f"{name}: {'passed' if passed(found, metrics) else 'FAILED'}")
    if out:
        told = {
            "toolbox": params.toolbox,
            "environment": params.environment,
            "passed": passed(found, NETWORK),
            "machine_passed": passed(found, MACHINE),
            "rows": [_json(row) for row in found],
            "answers": asdict(answers),
            "encoding": asdict(measured.encoding),
        }
        out.write_text(json.dumps(told, indent=1), encoding="utf-8")


@app.command("choose")
@options(ChoiceParams, images="IMAGES")
def qos_choose(params: ChoiceParams) -> None:
    """Choose how images like these are sent at a rate, so that they fit: as JPEGs, or as a stream of H.264."""
    images = list(islice(sources.images(params.images), TRIED))
    jpeg = choose_jpeg(images, params.rate, params.budget)
    _say(f"JPEGs{_told(jpeg)}")
    stream = choose_h264(images, params.rate, params.budget)
    _say(f"H.264: {stream.bitrate * 1e-6:.3g} Mbit/s for the encoder, at most {stream.megabits:.3g} on the wire")


def _told(jpeg: Jpeg) -> str:
    size = "" if jpeg.scale == 1 else f" of {jpeg.scale:g} times the size"
    return f"{size} of quality {jpeg.quality}: at most {jpeg.megabits:.3g} Mbit/s on the wire"


def _json(row: Row) -> dict[str, object]:
    return asdict(row) | {"required": str(row.required) if row.required else None}


def _needs_table(found: list[Needs]) -> Table:
    table = Table(title="What rates need (of this machine's cores)", title_justify="left")
    for name in ("images a second", "Mbit/s on the network", "cores"):
        table.add_column(name, justify="right")
    for one in found:
        table.add_row(f"{one.rate:g}", or_dash(one.bandwidth), f"{one.cores:.2f}")
    return table


def _say(text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
