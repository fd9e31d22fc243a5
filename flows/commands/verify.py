"""`scan2sim verify`: compares all results of a run or a survey with their checksums, and lists damaged files."""

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
from scan2sim.flows.reports.publish import PUBLISHED_OUTPUTS
from scan2sim.pipeline.core.cache import TEMPORARY_PREFIX, Manifest, damaged, digest, read_manifest
from scan2sim.pipeline.core.errors import DamagedError, InputError
from scan2sim.pipeline.io.worlds.merge import STAMP_FILE, USER_EDITABLE_SUFFIXES

app = App()


@app.command()
def verify(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Output folder of `scan2sim run` or `survey`.")],
) -> None:
    """Check all results against their checksums; the next run rebuilds the damaged ones."""
    verify_results(out)


def verify_results(out: Path) -> None:
    """Check the digests of all cached results and published worlds below an output folder, and print damaged files.

    Files that users may edit (`pipeline.io.worlds.merge.USER_EDITABLE_SUFFIXES`) may differ; changed ones are listed.
    The common world of a survey isn't checked: the next `survey` compares it with those of the tiles.

    The next `run` or `survey` rebuilds only what is damaged: it can't read a damaged manifest, and it rereads damaged
    files because their modification time is set to now.

    Raises:
        InputError: there are no results.
        DamagedError: some results are damaged.
        BusyError: another run is using the folder.
    """
    manifests = sorted((out / STORE).rglob("manifest.json"))
    folders = [path.parent for path in manifests if TEMPORARY_PREFIX not in str(path.relative_to(out))]
    if not folders:
        raise InputError(out, "contains no results of a run", "Name the output folder (--out) of `run` or `survey`")
    bad: list[tuple[Path, str]] = []
    changed: list[Path] = []
    files = 0
    with locked(out), progress("verify") as report:
        for i, folder in enumerate(folders):
            report(i / len(folders), folder.parent.name)
            manifest = read_manifest(folder / "manifest.json")
            if manifest is None:
                bad.append((folder / "manifest.json", "is damaged"))
                continue
            files += len(manifest.digests)
            bad += [(folder / name, "is damaged") for name in damaged(folder, manifest)]
            for file in _published(out, folder, manifest):
                if file.suffix in USER_EDITABLE_SUFFIXES and file.is_file():
                    changed.append(file)
                else:
                    bad.append((file, "is damaged or missing"))
        for path, _ in bad:
            with suppress(OSError):
                os.utime(path, follow_symlinks=False)
    for path in changed:
        warn(f"{path} was edited and is kept; delete it to have it rebuilt")
    for path, cause in bad:
        console.print(f"[red]{path.relative_to(out)}[/] {cause}", highlight=False, soft_wrap=True)
    if bad:
        remedy = "Run again: only the damaged results are rebuilt"
        raise DamagedError(out, f"{len(bad)} of {files} files of {len(folders)} results are damaged", remedy)
    console.print(f"{files} files of {len(folders)} results, and the worlds published from them, are intact")


def _published(out: Path, folder: Path, manifest: Manifest) -> Iterator[Path]:
    """Files published from a result that are missing or differ from it."""
    *tile, name, _ = folder.relative_to(out / STORE).parts
    output, place = PUBLISHED_OUTPUTS.get(name, ("", ""))
    shown = (out / TILES / tile[0] if tile else out) / place
    if output not in manifest.files or not (shown / STAMP_FILE).is_file():
        return
    if (shown / STAMP_FILE).read_text(errors="replace", encoding="utf-8") != folder.name:
        return  # published from another result
    for name, known in manifest.digests.items():
        below = Path(name).is_relative_to(manifest.files[output])
        if below and digest(file := shown / Path(name).relative_to(manifest.files[output])) != known:
            yield file
