"""The toolboxes' container files (deploy/toolboxes), as far as this project writes such: read where no engine runs."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

from bench.paths import ROOT

FOLDER = ROOT / "deploy" / "toolboxes"
OWN = {"scan2sim-toolbox": FOLDER / "base.Dockerfile"}
"""Images that others are built on, and their files."""


@dataclass(frozen=True)
class Stage:
    """A part of a container file: what it starts from, its name, and its instructions with what they say."""

    base: str
    name: str
    instructions: tuple[tuple[str, str], ...]

    def said(self, word: str) -> list[str]:
        """What follows an instruction's word, of each."""
        return [rest for one, rest in self.instructions if one == word]


def stages(path: Path) -> list[Stage]:
    """Of a container file, the final one last."""
    lines = [
        line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and not line.startswith("#")
    ]
    found: list[Stage] = []
    for line in re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines():
        word, _, rest = line.partition(" ")
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            found.append(Stage(base, name, ()))
        else:
            last = found.pop()
            found.append(Stage(last.base, last.name, (*last.instructions, (word, rest))))
    return found


def image(path: Path) -> list[Stage]:
    """The stages that a file's image is made of, the final one last: what it starts from, and copies packages of."""
    all_of_file = {stage.name: stage for stage in stages(path)}
    final = stages(path)[-1]
    copied = [all_of_file[name] for rest in final.said("COPY") for name in re.findall(r"--from=(\w+)", rest)]
    below = image(OWN[final.base]) if final.base in OWN else []
    return [*below, *(stage for stage in copied if stage.base not in OWN), final]


def requirements(path: Path) -> list[Path]:
    """Files of requirements that an image is installed by."""
    names = [name for stage in image(path) for rest in stage.said("RUN") for name in re.findall(r"-r /\w+/(\S+)", rest)]
    return [FOLDER / name for name in names]


def entry_point(path: Path) -> list[str]:
    """The command that an image runs."""
    found: list[str] = json.loads(image(path)[-1].said("ENTRYPOINT")[0])
    return found
