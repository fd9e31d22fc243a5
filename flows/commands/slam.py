"""`scan2sim slam`: a video to a trajectory, figures against a truth, and the study of compression."""

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
from scan2sim.flows.commands.run_with_progress import run_shown
from scan2sim.flows.commands.study import study_compression
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE, Planned
from scan2sim.flows.engine.progress import PublishedRun, published
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.video import ALONE, STEPS, Video, recipe
from scan2sim.pipeline.core.cache import Digests, Manifest, Store
from scan2sim.pipeline.core.errors import SettingError, UnsureError
from scan2sim.pipeline.io import trajectory as trajectory_io
from scan2sim.pipeline.io.worlds.merge import link
from scan2sim.slam.trajectory.evaluate import AlignmentKind, Evaluation, evaluate, plot, read_truth

T = TypeVar("T", int, float)
MADE = (
    "trajectory.csv",
    "trajectory.tum",
    "trajectory.kitti",
    "trajectory.geojson",
    "odometry.csv",
    "view.mp4",
    "colmap",
)
"""What a run may leave beside `slam.json`."""
MOSTLY = 0.5
"""Of the poses: where more are unsure, the path is none."""

app = App("Where the camera of a video went: `slam VIDEO --out DIR`.", first=True)


@app.command("video")
@options(Video)
def slam_a_video(
    video: Video,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the trajectory.")],
    set_: Sets = None,
    config: Config = None,
    bus: Bus = None,
) -> None:
    """Poses of a video's frames: TUM, KITTI, CSV, GeoJSON."""
    settings = settings_of(set_, config)
    with published(bus, "slam", str(video.video)) as on_bus:
        done = slam_video(video, out, settings, on_bus)
    figures = _figures(done)
    for text in figures.pop("warnings"):
        warn(text)
    console.print(json.dumps(figures, indent=1), highlight=False, markup=False)
    console.print(f"Trajectory: {out / 'trajectory.csv'}", highlight=False, soft_wrap=True, markup=False)
    check_sure(
        figures["unsure_share"], out, "Give --gps, more frames a second, or a part of the video that is lit and goes on"
    )


@app.command("evaluate")
def slam_evaluate(
    trajectory: Annotated[Path, typer.Argument(help="CSV, TUM or KITTI file.")],
    truth: Annotated[Path, typer.Argument(help="Another, or a GPS track.")],
    segment: Annotated[float, typer.Option(help="Metres of the local error's segments.")] = 400.0,
    alignment: Annotated[str, typer.Option(help="similarity2d, rigid2d or similarity3d.")] = "similarity2d",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="PNG of path and errors.")] = None,
) -> None:
    """Print how far a trajectory is from the truth: D3.2's errors, ATE, RPE, drift."""
    evaluate_trajectory(trajectory, truth, segment=segment, alignment=alignment, out=out)


@app.command("study")
def slam_study(
    source: Annotated[Path, typer.Argument(metavar="DRIVE", help="A drive's folder, a video, or its frames.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of cells, tables and plots.")],
    truth: Annotated[Path | None, typer.Option(help="Trajectory or GPS track; default: the drive's.")] = None,
    gps: Annotated[Path | None, typer.Option(help="Track for the scale; default: the drive's.")] = None,
    mask: Annotated[Path | None, typer.Option(help="Picture: 0 where the car is; default: the drive's.")] = None,
    heights: Annotated[str, typer.Option(help="Pixels.")] = "512,768,1024,1536",
    bitrates: Annotated[str, typer.Option(help="Mbit/s.")] = "1,2,5,10,20,40",
    rates: Annotated[str, typer.Option(help="Frames a second.")] = "30,15",
    jobs: Annotated[int, typer.Option(min=1, help="Cells at a time.")] = 1,
    backend: Annotated[str | None, typer.Option(help="lm, or adam: the mission's.")] = None,
    set_: Sets = None,
    config: Config = None,
    bus: Bus = None,
) -> None:
    """What resolution, bit rate and frame rate of the video cost: D3.2's tables 4 and 5."""
    study_compression(
        source, out, truth=truth, gps=gps, mask=mask, heights=heights, bitrates=bitrates, rates=rates, jobs=jobs,
        settings=settings_of([*(set_ or []), *([f"track.backend={backend}"] if backend else [])], config), bus=bus,
    )  # fmt: skip


def slam_video(video: Video, out: Path, settings: Settings, bus: PublishedRun | None = None) -> dict[str, Manifest]:
    """Write the trajectory of the camera that took a video, in all formats, and `slam.json`; what is finished is kept.

    Returns:
        Results by the steps' names.

    Raises:
        ScanError: see `pipeline.core.errors`; earlier results stay.
    """
    nodes = recipe(video, settings)
    with locked(out):
        store = Store(out / STORE)
        digests = Digests(store.root / "digests.json")
        log = Log(out / "run.log")
        log.write(f"slam {video.video}, settings {json.dumps(settings.values)}")
        with log.errors(out):
            planned, done = run_shown(nodes, store, log, {node.id.name for node in nodes}, digests, bus)
            publish_path(planned, done, store, out)
        store.sweep({item.node.id.name: item.key for item in planned})
        digests.save()
    return done


def publish_path(planned: Iterable[Planned], done: Mapping[str, Manifest], store: Store, out: Path) -> None:
    """Put the trajectory, and what came with it, where users look; of an earlier run nothing stays."""
    out.mkdir(exist_ok=True)
    folder = {item.node.id.name: store.folder(item.node.full_name, item.key) for item in planned}
    made = {path.name: path for path in (folder["place"] / "path").iterdir()}
    if f"place.{ALONE}" in folder:
        made["odometry.csv"] = folder[f"place.{ALONE}"] / "path" / "trajectory.csv"
    if "view" in done["track"].files:
        made["view.mp4"] = folder["track"] / "view.mp4"
    for name in MADE:
        place, source = out / name, made.get(name)
        shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
        if source is not None:
            shutil.copytree(source, place, copy_function=link) if source.is_dir() else link(str(source), str(place))
    (out / "slam.json").write_text(json.dumps(_figures(done), indent=1) + "\n", encoding="utf-8")


def check_sure(unsure: float, out: Path, remedy: str) -> None:
    """Raise an UnsureError where more of the poses of `out`'s trajectory are unsure than makes a path."""
    if unsure > MOSTLY:
        share = f"{100 * unsure:.0f} %"
        raise UnsureError(out / "trajectory.csv", f"{share} of the poses are unsure: they were carried on", remedy)


def _figures(done: Mapping[str, Manifest]) -> dict[str, Any]:
    """All figures of a run, and its warnings."""
    steps = [done[step.name] for step in STEPS if step.name in done]
    facts = {key: value for one in steps for key, value in one.facts.items()}
    return facts | {"warnings": list(dict.fromkeys(text for one in steps for text in one.warnings))}


def evaluate_trajectory(estimate: Path, truth: Path, *, segment: float, alignment: str, out: Path | None) -> Evaluation:
    """Print how far a trajectory is from the truth: a trajectory, or a GPS track."""
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
