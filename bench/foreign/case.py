"""A foreign input: how it is made, the command that reads it, and what is right."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bench.paths import ROOT

LIMIT_S = 300
"""Time limit of a command."""

KINDS = {
    1: "foreign records on the event bus",
    2: "georeference, units and axes: header, coordinates and options",
    3: "meaning of columns and fields",
    4: "what a file says: flags, labels, EXIF, faces, splats",
    5: "attributes of some scans only",
    6: "plausibility of what was imported",
    7: "worlds in the programs that load them",
    8: "walls on the borders of voxels",
    9: "which axis is up",
    10: "files that aren't what their name says",
    11: "separators, encodings, headings and paths of tables, images and trajectories",
    12: "requests of the Open Inference Protocol",
    13: "evaluation of trajectories",
}
"""Kinds of inputs by number."""

Expected = Literal["read", "named", "rejected"]
Verdict = Literal["right", "silent", "crashed", "rejected_valid"]


def nothing_wrong(_: Path) -> str:
    """A result that isn't checked."""
    return ""


@dataclass(frozen=True)
class Case:
    """An input.

    Attributes:
        name: unique.
        kind: number of its kind in `KINDS`.
        make: writes the files into a folder, and returns the arguments of the command.
        expected: "read": right; "named": read, with a warning that `says` matches; "rejected": with an error that it
            matches; a warning that it matches is right, too.
        says: regular expression.
        check: says what is wrong with the result in the folder; "" if it is right.
        module: Python module that is the command: `scan2sim`, or a client of its services.
    """

    name: str
    kind: int
    make: Callable[[Path], Sequence[object]]
    expected: Expected = "read"
    says: str = ""
    check: Callable[[Path], str] = nothing_wrong
    module: str = "scan2sim.flows.cli"


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        verdict: whether the case went right, or how it went wrong.
        why: what went wrong.
        messages: errors and warnings that were printed, without figures and paths, as `general`.
    """

    verdict: Verdict
    why: str
    messages: tuple[str, ...]


def run(case: Case, folder: Path) -> Outcome:
    """Make the input below an empty folder, run the command, and judge the outcome."""
    command = [sys.executable, "-m", case.module, *map(str, case.make(folder))]
    environment = os.environ | {"COLUMNS": "500", "PYTHONPATH": str(ROOT)}
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=LIMIT_S, env=environment)
    except subprocess.TimeoutExpired:
        return Outcome("crashed", f"not ended after {LIMIT_S} s", ())
    output = done.stdout + done.stderr
    messages = tuple(dict.fromkeys(general(text, folder) for text in messages_in(output)))
    if done.returncode < 0 or "Traceback (most recent call last)" in output:
        return Outcome("crashed", f"exit status {done.returncode}: {output[-300:]}", messages)
    text = " ".join(output.replace(str(folder), "…").split())
    said = bool(case.says) and re.search(case.says, text) is not None
    if done.returncode:
        rejected = case.expected == "rejected"
        why = "" if rejected and said else f"exit status {done.returncode}: {text[-300:]}"
        return Outcome("right" if rejected else "rejected_valid", why, messages)
    wrong = case.check(folder)
    if not wrong and (said or case.expected == "read"):
        return Outcome("right", "", messages)
    return Outcome("silent", wrong or f"nothing says {case.says!r}", messages)


def messages_in(output: str) -> list[str]:
    """Errors, with their remedies, and warnings in the output of a command."""
    found: list[str] = []
    for line in output.splitlines():
        if re.match(r"(error|warning): ", line):
            found.append(line)
        elif found and line.startswith("  "):
            found[-1] += " " + line.strip()
    return found


def general(text: str, folder: Path) -> str:
    """A message without what differs between runs: the folder, and all numbers."""
    return re.sub(r"\d[\d,]*(\.\d+)?", "#", text.replace(str(folder), "…"))
