"""Parser of the toolboxes' container files (deploy/toolboxes), for checks without a container engine."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "toolboxes"
OWN_IMAGES = {"scan2sim-toolbox": FOLDER / "base.Dockerfile"}
"""Base images built by this project, and their files."""


@dataclass(frozen=True)
class Stage:
    """A build stage: base image, name and instructions with their arguments."""

    base: str
    name: str
    instructions: tuple[tuple[str, str], ...]

    def arguments_of(self, word: str) -> list[str]:
        """Arguments of all instructions of a kind."""
        return [rest for one, rest in self.instructions if one == word]


def stages(path: Path) -> list[Stage]:
    """Stages of a container file, the final one last."""
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
    """Stages that contribute to a file's image, the final one last: base images and stages to copy from."""
    all_of_file = {stage.name: stage for stage in stages(path)}
    final = stages(path)[-1]
    copied = [all_of_file[name] for rest in final.arguments_of("COPY") for name in re.findall(r"--from=(\w+)", rest)]
    below = image(OWN_IMAGES[final.base]) if final.base in OWN_IMAGES else []
    return [*below, *(stage for stage in copied if stage.base not in OWN_IMAGES), final]


def requirements(path: Path) -> list[Path]:
    """Requirements files installed into an image."""
    names = [
        name
        for stage in image(path)
        for rest in stage.arguments_of("RUN")
        for name in re.findall(r"-r /\w+/(\S+)", rest)
    ]
    return [FOLDER / name for name in names]


def entry_point(path: Path) -> list[str]:
    """Command that an image runs."""
    found: list[str] = json.loads(image(path)[-1].arguments_of("ENTRYPOINT")[0])
    return found
