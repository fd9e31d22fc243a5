"""The `scan2sim` command. What is heavy is imported inside the commands: it starts in a blink."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperGroup

app = typer.Typer(
    name="scan2sim",
    help="Street scans (lidar clouds and posed photos) to textured worlds for robot simulators.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
imports = typer.Typer(no_args_is_help=True, help="Make a tile from your files.")
app.add_typer(imports, name="import")


class _TileIsDefault(TyperGroup):
    """`segment TILE` is `segment tile TILE`."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands:
            args = ["tile", *args]
        return super().resolve_command(ctx, args)


segments = typer.Typer(
    cls=_TileIsDefault, no_args_is_help=True, help="Classes of a tile's points and photos: `segment TILE --out DIR`."
)
app.add_typer(segments, name="segment")

INTERRUPTED = 130  # as typer turns Ctrl-C into

TilePath = Annotated[Path, typer.Argument(metavar="TILE", help="A tile.toml, or the folder that holds one.")]
OutDir = Annotated[Path, typer.Option("--out", "-o", help="Folder for the world, the report and kept results.")]
Sets = Annotated[list[str] | None, typer.Option("--set", metavar="STEP.PARAM=VALUE", help="Change a setting.")]
Config = Annotated[Path | None, typer.Option("--config", help="Settings as a TOML file.")]
HoldOut = Annotated[
    int | None, typer.Option("--hold-out", metavar="N", help="Keep every Nth photo out of texturing, to score it.")
]
Force = Annotated[bool, typer.Option("--force", help="Run everything again.")]
From = Annotated[str | None, typer.Option("--from", metavar="STEP", help="Run this step and what follows again.")]
Name = Annotated[str | None, typer.Option("--name", help="The tile's name; default: from the folder.")]
TileOut = Annotated[Path, typer.Option("--out", "-o", help="The tile's folder.")]
Crs = Annotated[str | None, typer.Option(help='CRS, where the files lack it: "EPSG:32633", or "local".')]
Link = Annotated[bool, typer.Option("--link", help="Link files into the tile instead of copying them.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a tile that is there already.")]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"scan2sim {version('scan2sim')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")] = False,
) -> None:
    pass


@app.command()
def run(
    tile: TilePath,
    out: OutDir,
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
    jobs: Annotated[int, typer.Option(min=0, help="Steps at a time; 0: as the cores allow.")] = 0,
) -> None:
    """Make a world of a tile; what an earlier run has finished is kept."""
    from flows.run import run_tile

    run_tile(tile, out, _settings(set_, config, hold_out), force=force, start=from_, jobs=jobs)


@app.command()
def plan(
    tile: TilePath,
    out: OutDir = Path("out"),
    set_: Sets = None,
    config: Config = None,
    hold_out: HoldOut = None,
    force: Force = False,
    from_: From = None,
) -> None:
    """Show what `run` would run, and why."""
    from flows.run import show_plan

    show_plan(tile, out, _settings(set_, config, hold_out), force=force, start=from_)


@app.command()
def inspect(path: Annotated[Path, typer.Argument(help="A cloud, a tile, a mesh, or a world.")]) -> None:
    """Show one screen of facts."""
    from flows.inspect import inspect_path

    inspect_path(path)


@app.command()
def sample(
    out: Annotated[Path, typer.Argument(help="The tile's folder.")],
    length: Annotated[float, typer.Option(help="Metres of road.")] = 100.0,
    points: Annotated[float, typer.Option(help="Points of the cloud.")] = 9e6,
    photos: Annotated[int, typer.Option(help="Photos in all.")] = 40,
    seed: Annotated[int, typer.Option(help="Another seed, another street.")] = 0,
) -> None:
    """Generate a synthetic street with its ground truth."""
    from data_samples.street import generate
    from flows.display import progress

    with progress("street") as report:
        path = generate(out, length=length, points=points, photos=photos, seed=seed, report=report)
    typer.echo(f"Tile: {path}")


@segments.command("tile")
def segment_a_tile(
    tile: TilePath,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for clouds, labels, masks and kept results.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Tell classes anew where the cloud has some.")] = False,
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Classify a tile's points from its photos; write LAZ, label pictures and masks."""
    from flows.segment import segment_tile

    segment_tile(
        tile, out, _settings([*(set_ or []), *(["segment.overwrite=true"] if overwrite else [])], config, None)
    )


@segments.command("train")
def segment_train(
    folder: Annotated[Path, typer.Argument(help="Of images/ and labels/ (docs/segmentation.md).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of the weights.")] = Path("street.safetensors"),
    minutes: Annotated[float, typer.Option(help="At most; 0: no limit.")] = 0,
    steps: Annotated[int, typer.Option(help="Of the optimiser.")] = 3000,
    seed: Annotated[int, typer.Option(help="Of weights, crops and looks.")] = 0,
) -> None:
    """Train the project's own network on labelled photos."""
    from flows.segment import train_network

    train_network(folder, out, minutes=minutes, steps=steps, seed=seed)


@segments.command("evaluate")
def segment_evaluate(
    path: Annotated[Path, typer.Argument(help="A tile whose cloud has classes, or a folder of labelled photos.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for a tile's results.")] = Path("segment-out"),
    set_: Sets = None,
    config: Config = None,
) -> None:
    """Print how classes that are told compare with those that are known."""
    from flows.segment import evaluate

    evaluate(path, out, _settings([*(set_ or []), "segment.overwrite=true"], config, None))


@imports.command("kitti-raw")
def import_kitti(
    drive: Annotated[Path, typer.Argument(help="A drive's folder (..._sync), or one that holds it.")],
    out: TileOut,
    poses: Annotated[Path | None, typer.Option(help="Sweep poses instead of OXTS: row-major 3x4 a line.")] = None,
    camera: Annotated[list[str] | None, typer.Option(help="Its folder; several times for several.")] = None,
    max_range: Annotated[float, typer.Option(help="Metres; returns from further away are left out.")] = 50.0,
    rigid: Annotated[bool, typer.Option("--rigid", help="Sweeps are motion-compensated already.")] = False,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """KITTI raw: merge sweeps by OXTS or a pose file, colour points from the photos."""
    from flows.display import progress
    from pipeline.io.kitti import import_kitti_raw

    with progress("import") as report:
        path = import_kitti_raw(
            drive, out, poses=poses, cameras=camera or ["image_02"], max_range=max_range, deskew=not rigid,
            name=name, link=link, overwrite=overwrite, report=report,
        )  # fmt: skip
    typer.echo(f"Tile: {path}")


@imports.command("colmap")
def import_colmap_model(
    model: Annotated[Path, typer.Argument(help="Folder of cameras, images and points3D (.txt or .bin).")],
    images: Annotated[Path, typer.Argument(help="Folder of the photos.")],
    out: TileOut,
    cloud: Annotated[Path | None, typer.Option(help="Dense cloud (LAS, LAZ, PLY); default: the sparse points.")] = None,
    crs: Crs = "local",
    upright: Annotated[bool, typer.Option("--upright", help="Turn it so that photos stand upright.")] = False,
    scale: Annotated[float, typer.Option(help="Metres per unit of the model.")] = 1.0,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """COLMAP model, text or binary."""
    from flows.display import progress
    from pipeline.io.colmap import import_colmap

    up: Literal["photos"] | None = "photos" if upright else None
    with progress("import") as report:
        path = import_colmap(
            model, images, out, cloud=cloud, crs=crs or "local", up=up, scale=scale,
            name=name, link=link, overwrite=overwrite, report=report,
        )  # fmt: skip
    typer.echo(f"Tile: {path}")


@imports.command("las")
def import_las_files(
    clouds: Annotated[list[Path], typer.Argument(help="LAS, LAZ, COPC or PLY files.")],
    out: TileOut,
    photos: Annotated[Path | None, typer.Option(help="CSV of photos and poses (docs/formats.md).")] = None,
    cameras: Annotated[Path | None, typer.Option(help="CSV of cameras, where the photos' lacks them.")] = None,
    images: Annotated[Path | None, typer.Option(help="Folder of the photos; default: the CSV's.")] = None,
    crs: Crs = None,
    units: Annotated[str | None, typer.Option(help="m, ft or us-ft, where the CRS doesn't say.")] = None,
    trajectory: Annotated[Path | None, typer.Option(help="CSV of the scanner's path: time,x,y,z.")] = None,
    name: Name = None,
    link: Link = False,
    overwrite: Overwrite = False,
) -> None:
    """Plain clouds, with a CSV of photos if there are any."""
    from flows.display import progress
    from pipeline.io.las_csv import import_las

    with progress("import") as report:
        path = import_las(
            clouds, out, photos=photos, cameras=cameras, images=images, crs=crs, units=units, trajectory=trajectory,
            name=name, link=link, overwrite=overwrite, report=report,
        )  # fmt: skip
    typer.echo(f"Tile: {path}")


def _settings(set_: list[str] | None, config: Path | None, hold_out: int | None):  # type: ignore[no-untyped-def]
    from flows.settings import Settings

    assignments = list(set_ or [])
    if hold_out is not None:
        assignments.append(f"views.hold_out={hold_out}")
    return Settings.read(config, assignments)


def main() -> None:
    """Run the command; errors become one message and an exit code (`pipeline.errors.EXIT_CODES`)."""
    try:
        app()
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            typer.echo("Interrupted; what was finished is kept, the same command goes on from there.", err=True)
        raise
    except Exception as error:
        from pipeline.errors import ScanError, exit_code, from_os_error

        if isinstance(error, OSError):
            error = from_os_error(error, error.filename or "a file")

        if isinstance(error, ScanError):
            typer.secho(f"error: {error.where}: {error.cause}", fg="red", err=True)
            typer.echo(f"  {error.remedy}.", err=True)
        else:
            from flows.display import log_unexpected

            typer.secho(f"error: unexpected {type(error).__name__}: {error}", fg="red", err=True)
            typer.echo(f"  The details are in {log_unexpected(error)}; please report them.", err=True)
        sys.exit(exit_code(error))


if __name__ == "__main__":
    main()
