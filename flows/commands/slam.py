"""`scan2sim slam`: trajectory of a video, and its evaluation against ground truth."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import typer

from scan2sim.flows.commands.app import App, Bus, Config, Sets, settings_of
from scan2sim.flows.commands.display import console, warn
from scan2sim.flows.commands.log import Log
from scan2sim.flows.commands.options import options
from scan2sim.flows.commands.run_with_progress import plan_and_run
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.output_folder import check_own
from scan2sim.flows.engine.planning import STORE, PlannedTask
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.video import ODOMETRY_GROUP, STEPS, Video, build_graph
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import LowConfidenceError, SettingError
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.file_checks import copy_tree
from scan2sim.pipeline.io.worlds.merge import link
from scan2sim.slam.trajectory.evaluate import AlignmentKind, Evaluation, evaluate, plot, read_truth

T = TypeVar("T", int, float)
OUTPUTS = (
    "trajectory.csv",
    "trajectory.tum",
    "trajectory.kitti",
    "trajectory.geojson",
    "odometry.csv",
    "colmap",
)
"""Files and folders that a run may write next to `slam.json`."""
MAX_UNSURE_SHARE = 0.5
"""Share of extrapolated poses above which a trajectory is rejected."""

app = App("Estimate the trajectory of a video's camera (visual SLAM): `slam VIDEO --out DIR`.", first=True)


@app.command("video")
@options(Video)
def slam_a_video(
    video: Video,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Output folder: trajectory in several formats, slam.json, cached results."),
    ],
    set_: Sets = None,
    config: Config = None,
    bus: Bus = None,
) -> None:
    """Estimate the camera poses of a video's frames; write them as CSV, TUM, KITTI and GeoJSON."""
    settings = settings_of(set_, config)
    with published(bus, "slam", str(video.video)) as on_bus:
        done = slam_video(video, out, settings, on_bus)
    figures = _figures(done)
    for text in figures.pop("warnings"):
        warn(text)
    console.print(json.dumps(figures, indent=1), highlight=False, markup=False)
    console.print(f"Trajectory: {out / 'trajectory.csv'}", highlight=False, soft_wrap=True, markup=False)
    check_sure(
        figures["unsure_share"], out, "Give --gps, more frames per second, or a well-lit part of the video without cuts"
    )


@app.command("evaluate")
def slam_evaluate(
    trajectory: Annotated[
        Path, typer.Argument(metavar="TRAJECTORY", help="Trajectory to evaluate: a CSV, TUM or KITTI file.")
    ],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="Ground truth: a trajectory or a GPS track.")],
    segment: Annotated[
        float, typer.Option(help="Length in metres of the segments over which local errors are measured.")
    ] = 400.0,
    alignment: Annotated[
        str, typer.Option(help="Transform fitted to the truth before comparing: similarity2d, rigid2d or similarity3d.")
    ] = "similarity2d",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="PNG file for a plot of both paths and the errors.")
    ] = None,
) -> None:
    """Print the errors of a trajectory against ground truth: global and local error, ATE, RPE, drift."""
    evaluate_trajectory(trajectory, truth, segment=segment, alignment=alignment, out=out)


def slam_video(video: Video, out: Path, settings: Settings, bus: PublishedRun | None = None) -> dict[str, Manifest]:
    """Estimate the trajectory of a video's camera; write it in all formats, and `slam.json`.

    Returns:
        Results by step name.

    Raises:
        ScanError: see `pipeline.core.errors`; results of earlier runs stay.
    """
    tasks = build_graph(video, settings)
    check_own(out, (*OUTPUTS, "slam.json"))
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        log = Log(out / "run.log")
        log.write(f"slam {video.video}, settings {json.dumps(settings.values)}")
        with log.errors(out):
            planned, done = plan_and_run(tasks, store, log, {task.id.name for task in tasks}, digests, bus)
            publish_path(planned, done, store, out)
        store.sweep({item.task.id.name: item.key for item in planned})
        digests.save()
    return done


def publish_path(planned: Iterable[PlannedTask], done: Mapping[str, Manifest], store: Store, out: Path) -> None:
    """Link the trajectory and related files into `out`, write `slam.json`, and remove files of earlier runs."""
    out.mkdir(exist_ok=True)
    folder = {item.task.id.name: store.folder(item.task.full_name, item.key) for item in planned}
    sources = {path.name: path for path in (folder["georeference"] / "path").iterdir()}
    if f"georeference.{ODOMETRY_GROUP}" in folder:
        sources["odometry.csv"] = folder[f"georeference.{ODOMETRY_GROUP}"] / "path" / "trajectory.csv"
    for name in OUTPUTS:
        place, source = out / name, sources.get(name)
        shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
        if source is not None:
            copy_tree(source, place, link) if source.is_dir() else link(str(source), str(place))
    (out / "slam.json").write_text(json.dumps(_figures(done), indent=1) + "\n", encoding="utf-8")


def check_sure(unsure: float, out: Path, remedy: str) -> None:
    """Raise a LowConfidenceError if too large a share of the poses of `out`'s trajectory is extrapolated."""
    if unsure > MAX_UNSURE_SHARE:
        share = f"{100 * unsure:.0f} %"
        raise LowConfidenceError(out / "trajectory.csv", f"{share} of the poses are extrapolated, not measured", remedy)


def _figures(done: Mapping[str, Manifest]) -> dict[str, Any]:
    """All metrics of a run, and its warnings."""
    steps = [done[step.name] for step in STEPS if step.name in done]
    facts = {key: value for one in steps for key, value in one.metrics.items()}
    return facts | {"warnings": list(dict.fromkeys(text for one in steps for text in one.warnings))}


def evaluate_trajectory(estimate: Path, truth: Path, *, segment: float, alignment: str, out: Path | None) -> Evaluation:
    """Print the errors of a trajectory against the ground truth, a trajectory or a GPS track."""
    kinds: tuple[AlignmentKind, ...] = get_args(AlignmentKind)
    kind = next((k for k in kinds if k == alignment), None)
    if kind is None:
        raise SettingError("--alignment", f"there is no `{alignment}`", f"Choose one of {', '.join(kinds)}")
    path = trajectory_io.read(estimate)
    known = read_truth(truth)
    result = evaluate(path, known, segment=segment, alignment=kind)
    for name, value in result.figures().items():
        console.print(f"{name:<24}{'-' if value is None else f'{value:.4f}':>14}", highlight=False, markup=False)
    if out is not None:
        plot(result, out)
        console.print(f"Plot: {out}", highlight=False, soft_wrap=True, markup=False)
    return result
