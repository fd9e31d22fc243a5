"""Ablation of the splats on the real streets: trained without one part, or with another value, and scored.

`python -m bench.street.splat_ablation [--parts ...] [--streets odo04 raw0009 raw0013] [--worlds bench-out/street]
[--out bench-out/street_splats] [--change NAME=VALUE ...]`

A part is a line of `CHANGES`: values of constants of the modules of `scan2sim.texturing.splats`, or of the step's
settings; modules may have their full names. `--change` adds one from the command line. Constants that compiled kernels
or other constants hold copies of are rejected: changing them would have no effect. The step's inputs are those of the
street's run in `--worlds`, made there by `python -m bench.street`. Rows are stored in
`rows.json` below `--out`; rows that are stored already aren't measured again. Ends with `RESULT {json}`: by part and
street.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from bench.paths import ROOT
from bench.street import splats, training
from bench.street.run import STREETS, splats_of
from scan2sim.texturing.splats import step

PACKAGE = "scan2sim.texturing.splats"
CHANGES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "cover": {"step.cover": 0.0},
    "ssim": {"loss.SSIM_SHARE": 0.0},
    "stereo": {"step.NEIGHBOURS": 0},
    "normals": {"start.FLATNESS": 1.0},
    "dark_fill": {"start.DARK_SIGMA_DEG": 0.01},
    "coarse_to_fine": {"step.epochs": (0, 0, 20)},
    "finer": {"start.STRIDE_PX": 3.5},
    "coarser": {"start.STRIDE_PX": 6.0},
    "cpu": {"step.backend": "cpu"},
    "gpu": {"step.backend": "gpu"},  # needs an NVIDIA GPU and gsplat
}
"""By part: the names of constants (module.NAME) or settings (step.name), and their values."""
METRICS = (
    "psnr_db", "nogain_psnr_db", "exposed_psnr_db", "ssim", "msssim", "surface_psnr_db", "elsewhere_psnr_db",
    "right_gap_db", "depth_median_cm", "depth_near_share", "splats", "mb", "cpu_minutes", "memory_gb",
)  # fmt: skip


@contextlib.contextmanager
def changed(change: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Constants with other values; gives the settings of the step."""
    settings = {}
    with contextlib.ExitStack() as stack:
        for name, value in change.items():
            module, attribute = name.removeprefix(f"{PACKAGE}.").split(".")
            if module == "step" and attribute in step.SplatsParams.model_fields:
                settings[attribute] = value
                continue
            if copies := copied(module, attribute):
                raise SystemExit(f"{name} can't be changed here, as there are copies of it: {'; '.join(copies)}")
            owner = importlib.import_module(f"{PACKAGE}.{module}")
            stack.enter_context(mock.patch.object(owner, attribute, value))
        yield settings


def copied(module: str, constant: str) -> list[str]:
    """Places that hold a copy of a constant: compiled kernels, and what is computed when a module is loaded.

    Args:
        module: name of the constant's module within `PACKAGE`.
        constant: its name.
    """
    found = []
    for path in sorted(Path(importlib.import_module(PACKAGE).__path__[0]).glob("*.py")):
        for statement in ast.parse(path.read_text(encoding="utf-8")).body:
            if any(_reads(node, path.stem == module, module, constant) for node in _evaluated_once(statement)):
                found.append(f"{path.name}, line {statement.lineno}")
    return found


def _evaluated_once(statement: ast.stmt) -> Iterator[ast.AST]:
    """Nodes of a statement that are evaluated when its module is loaded, or compiled by numba."""
    parts: list[ast.AST] = [statement]
    if isinstance(statement, ast.ClassDef):
        parts = [*statement.decorator_list, *statement.bases, *statement.keywords]
        for inner in statement.body:
            yield from _evaluated_once(inner)
    elif isinstance(statement, ast.FunctionDef):
        compiled = any("njit" in ast.unparse(decorator) for decorator in statement.decorator_list)
        if not compiled:
            parts = [statement.args, *statement.decorator_list]
    for part in parts:
        yield from ast.walk(part)


def _reads(node: ast.AST, own: bool, module: str, constant: str) -> bool:
    """Whether a node reads a constant; `own`: it is in the constant's module."""
    if isinstance(node, ast.ImportFrom):
        return node.module == f"{PACKAGE}.{module}" and constant in [name.name for name in node.names]
    if isinstance(node, ast.Attribute):
        return node.attr == constant and ast.unparse(node.value) in (module, f"{PACKAGE}.{module}")
    return own and isinstance(node, ast.Name) and node.id == constant and isinstance(node.ctx, ast.Load)


def row(name: str, worlds: Path, folder: Path, change: Mapping[str, Any]) -> dict[str, Any]:
    """Train the splats of a street with a change, and score them."""
    tile, run = worlds / name / "tile", worlds / name / "run"
    inputs, params = training.of_run(run)
    with changed(change) as settings:
        layer, used = training.train(inputs, {**params, **settings}, folder)
    found = splats_of(STREETS[name], tile, run, folder / "pictures", layer, used)
    splats.table(found)
    return {key: found[key] for key in METRICS} | {
        str(n): {"psnr_db": one["psnr_db"], "ssim": one["ssim"]} for n, one in found["photos"].items()
    }


def main() -> None:
    """Measure the rows that are missing, and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="*", choices=[*CHANGES], default=["nothing"])
    parser.add_argument("--streets", nargs="*", choices=[*STREETS], default=[*STREETS])
    parser.add_argument("--worlds", type=Path, default=ROOT / "bench-out" / "street")
    parser.add_argument("--out", type=Path, default=ROOT / "bench-out" / "street_splats")
    parser.add_argument("--change", action="append", default=[], metavar="NAME=VALUE", help="one row more, of these")
    arguments = parser.parse_args()
    rows_file: Path = arguments.out / "rows.json"
    rows = json.loads(rows_file.read_text(encoding="utf-8")) if rows_file.is_file() else {}
    parts = {part: CHANGES[part] for part in arguments.parts}
    if arguments.change:
        given = dict(text.split("=", 1) for text in arguments.change)
        parts = {" ".join(arguments.change): {name: json.loads(value) for name, value in given.items()}}
    for part, change in parts.items():
        for name in arguments.streets:
            if name in rows.setdefault(part, {}):
                continue
            print(f"\n{part}, {name}")
            rows[part][name] = row(name, arguments.worlds, arguments.out / part.replace(" ", "_") / name, change)
            rows_file.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    for part, streets in rows.items():
        for name, found in streets.items():
            print(
                f"{part:24} {name:8}"
                + "".join(f"  {key} {found[key]:.3g}" for key in METRICS if found.get(key) is not None)
            )
    print("RESULT " + json.dumps(rows))


if __name__ == "__main__":
    main()
