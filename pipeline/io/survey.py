"""The survey: `survey.toml` lists the tiles that a corridor was cut into.

```toml
name = "my_town"
crs = "EPSG:32633"          # of all tiles
units = "m"                 # "ft", "us-ft"; only for local coordinates
length = 100.0              # metres of path per tile
buffer = 5.0                # metres by which tiles' clouds extend beyond their borders
tiles = ["my_town_0000", "my_town_0001"]     # folders beside this file, in order along the path
```
The area that belongs to a tile is in its `tile.toml` under `[cell]`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from scan2sim.pipeline.core.errors import InputError
from scan2sim.pipeline.core.parameters import NAME, WorldName
from scan2sim.pipeline.io import toml
from scan2sim.pipeline.io.tile import tile_name


class SurveyFile(BaseModel):
    """Schema of `survey.toml`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: WorldName
    crs: str
    units: Literal["m", "ft", "us-ft"] | None = None
    length: float = Field(gt=0)
    buffer: float = Field(ge=0)
    tiles: tuple[str, ...] = Field(min_length=1)


@dataclass(frozen=True)
class Survey:
    """Content of a `survey.toml`, validated.

    Attributes:
        path: the `survey.toml`.
        name: name of the survey.
        tiles: the `tile.toml` of every tile by its name, in order along the path.
        length: metres of path per tile.
        buffer: metres by which tiles' clouds extend beyond their borders.
    """

    path: Path
    name: str
    tiles: Mapping[str, Path]
    length: float
    buffer: float


def read_survey(path: Path) -> Survey:
    """Read and validate a survey: a `survey.toml`, or a folder that contains one.

    An unreadable tile is not an error here, so that the other tiles can still be processed; `read_tile` reports it.

    Raises:
        InputError: the survey is invalid (names the field), a tile is missing or listed twice, or CRS differ.
    """
    path = path / "survey.toml" if path.is_dir() else path
    spec = _parse(path)
    tiles: dict[str, Path] = {}
    crs: dict[str, str] = {}
    folded: dict[str, str] = {}
    for folder in spec.tiles:
        tile = path.parent / folder / "tile.toml"
        if not tile.is_file():
            raise InputError(tile, f"file not found (named in {path.name})", "Restore it, or remove it from `tiles`")
        name, crs[folder] = _peek(tile)
        same = folded.setdefault(name.casefold(), name)  # file systems of macOS and Windows don't distinguish them
        if same in tiles:
            raise InputError(
                path,
                f"names two tiles {name} ({tiles[same].parent.name} and {tile.parent.name})",
                "Remove one of them from `tiles`, or give it another `name`",
            )
        tiles[name] = tile
    _check_crs(path, {folder: text for folder, text in crs.items() if text})
    return Survey(path, spec.name, tiles, spec.length, spec.buffer)


def write_survey(
    folder: Path, *, name: str, crs: str, length: float, buffer: float, tiles: Sequence[str], units: str | None = None
) -> Path:
    """Write `folder/survey.toml` and return its path; arguments are those of the file."""
    import tomli_w

    body: dict[str, Any] = {"name": name, "crs": crs}
    if units:
        body["units"] = units
    body |= {"length": length, "buffer": buffer, "tiles": list(tiles)}
    SurveyFile.model_validate(body)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "survey.toml"
    path.write_text(tomli_w.dumps(body), encoding="utf-8")
    return path


def _parse(path: Path) -> SurveyFile:
    absent = ("no survey found", "Give a survey.toml or its folder; `scan2sim tile` cuts a tile into a survey")
    return toml.read(path, SurveyFile, absent=absent, fields="docs/reference/formats.md lists the fields of a survey")


def _peek(tile: Path) -> tuple[str, str]:
    """A tile's name and CRS, without opening its clouds; if unreadable, its folder's name and an empty CRS."""
    try:
        body = tomllib.loads(tile.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError, OSError):
        body = {}
    name, crs = body.get("name"), body.get("crs")
    known = isinstance(name, str) and re.fullmatch(NAME, name)
    return str(name) if known else tile_name(tile.parent.name), crs if isinstance(crs, str) else ""


def _check_crs(path: Path, known: Mapping[str, str]) -> None:
    """Raise an error if tiles (by their folders) have different CRS."""
    for folder, crs in known.items():
        first, other = next(iter(known.items()))
        if crs != other:
            raise InputError(
                path,
                f"has tiles from two CRS: {folder} is in {crs[:60]}, {first} in {other[:60]}",
                "Cut all tiles from one corridor, in one CRS",
            )
