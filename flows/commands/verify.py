"""`scan2sim verify`: reads every byte of what a run or a survey has made, and says what isn't as it was made."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from scan2sim.flows.commands.app import App
from scan2sim.flows.commands.display import console, progress, warn
from scan2sim.flows.engine.lock import locked
from scan2sim.flows.engine.planning import STORE
from scan2sim.flows.reports.finish import TILES
from scan2sim.flows.reports.publish import PLACES
from scan2sim.pipeline.core.cache import TEMPORARY, Manifest, damaged, digest, read_manifest
from scan2sim.pipeline.core.errors import DamagedError, InputError
from scan2sim.pipeline.io.worlds.merge import EDITED, STAMP

app = App()


@app.command()
def verify(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The folder that run or survey was given as --out.")],
) -> None:
    """Read all that was made, and say what is damaged; the next run makes that anew."""
    verify_results(out)


def verify_results(out: Path) -> None:
    """Digest all kept results and published worlds below a run's or survey's folder, and print what is damaged.

    What users edit (`pipeline.io.worlds.merge.EDITED`) may be as they left it: it is printed where it was changed.
    A survey's common world isn't read: the next `survey` compares it with the tiles'.

    What is damaged the next `run` or `survey` makes anew, and nothing else: a damaged file is marked as changed now, a
    damaged manifest is one that can't be read.

    Raises:
        InputError: there are no results.
        DamagedError: some are damaged.
        BusyError: a run is at work there.
    """
    found = sorted((out / STORE).rglob("manifest.json"))
    folders = [path.parent for path in found if TEMPORARY not in str(path.relative_to(out))]
    if not folders:
        raise InputError(out, "holds no results of a run", "Name the folder that was given to run or survey by --out")
    bad: list[tuple[Path, str]] = []
    changed: list[Path] = []
    files = 0
    with locked(out), progress("verify") as report:
        for i, folder in enumerate(folders):
            report(i / len(folders), folder.parent.name)
            manifest = read_manifest(folder / "manifest.json")
            if manifest is None:
                bad.append((folder / "manifest.json", "isn't as it was written"))
                continue
            files += len(manifest.digests)
            bad += [(folder / name, "isn't as it was made") for name in damaged(folder, manifest)]
            for file in _published(out, folder, manifest):
                if file.suffix in EDITED and file.is_file():
                    changed.append(file)
                else:
                    bad.append((file, "isn't as it was published"))
        for path, _ in bad:
            with suppress(OSError):
                os.utime(path, follow_symlinks=False)
    for path in changed:
        warn(f"{path} was changed since it was made, and stays so: remove it to have it made anew")
    for path, cause in bad:
        console.print(f"[red]{path.relative_to(out)}[/] {cause}", highlight=False, soft_wrap=True)
    if bad:
        remedy = "Run again: what is damaged is made anew, and nothing else"
        raise DamagedError(out, f"{len(bad)} of {files} files of {len(folders)} results are damaged", remedy)
    console.print(f"{files} files of {len(folders)} results, and the tiles' worlds made of them, are as they were made")


def _published(out: Path, folder: Path, manifest: Manifest) -> Iterator[Path]:
    """Files that were published of a result, if any were, and are missing or others."""
    *tile, name, _ = folder.relative_to(out / STORE).parts
    output, place = PLACES.get(name, ("", ""))
    shown = (out / TILES / tile[0] if tile else out) / place
    if output not in manifest.files or not (shown / STAMP).is_file():
        return
    if (shown / STAMP).read_text(errors="replace", encoding="utf-8") != folder.name:
        return  # of another result
    for name, known in manifest.digests.items():
        below = Path(name).is_relative_to(manifest.files[output])
        if below and digest(file := shown / Path(name).relative_to(manifest.files[output])) != known:
            yield file
