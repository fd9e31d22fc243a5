"""Documentation is consistent with the code: options, settings, fields of TOML files, project files and links exist."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from pydantic import BaseModel, ValidationError

import scan2sim
from scan2sim.flows.cli import COMMANDS, app, loaded
from scan2sim.flows.pipelines.drive import Drive
from scan2sim.flows.pipelines.steps import STEPS
from scan2sim.pipeline.core import plugins
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.importers.bag import reader
from scan2sim.pipeline.io import camera_calibrations, clouds, gps, mesh_files, sweep_files
from scan2sim.pipeline.io.images import image
from scan2sim.pipeline.io.survey import SurveyFile
from scan2sim.pipeline.io.tile import TileFile
from scan2sim.services.monitoring.events.notify import NotifyParams
from scan2sim.services.monitoring.events.rules import Rule
from scan2sim.services.orchestration.deployment import Deployment
from scan2sim.services.teleoperation.access.oidc import OidcParams
from tests.conftest import ROOT

PACKAGES = ("pipeline", "segmentation", "texturing", "slam", "flows", "services", "data_samples")
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/**/*.md")),
    ROOT / "data_samples/README.md",
]
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
PARAMS: dict[str, type[Params]] = {step.name: step.params for step in STEPS}
OTHER_PROGRAMS = re.compile(
    r"\b(prefect|docker|dask|ray|gz|gz_args|pip|aws|curl|kubectl|SBATCH|srun|trtexec|esmini|ros2|export.py)\b"
)
"""Other programs, whose options a page may mention if it also shows them in a command."""
IMAGES, ARRAYS, MESHES = {"png", "jpg"}, {"npz", "npy", "laz", "csv"}, {"obj", "mtl", "dae", "glb", "sdf"}
SUFFIXES = {"py", "js", "json", "md", "geojson", "toml", *IMAGES, *ARRAYS, *MESHES}


@cache
def text_of(page: Path) -> str:
    """Text of a page, or the docstring of a module."""
    text = page.read_text(encoding="utf-8")
    return text if page.suffix == ".md" else ast.get_docstring(ast.parse(text)) or ""


def page_params(pages: list[Path]) -> list[Any]:
    """Test parameters: pages, and modules whose docstring may mention options, code or files."""
    relevant = [page for page in pages if page.suffix == ".md" or re.search(r"`|--|\.(py|md)", text_of(page))]
    return [pytest.param(page, id=page.relative_to(ROOT).as_posix()) for page in relevant]


def commands(group: Any, name: tuple[str, ...] = ("scan2sim",)) -> Iterator[tuple[tuple[str, ...], set[str]]]:
    """Words and options of all commands of a group."""
    yield name, {option for param in group.params for option in (*param.opts, *param.secondary_opts)} | {"--help"}
    for word, below in getattr(group, "commands", {}).items():
        yield from commands(below, (*name, word))


OPTIONS = dict(commands(typer.main.get_command(app)))
for command in COMMANDS:
    OPTIONS |= dict(commands(loaded(command), ("scan2sim", command)))
ALL_OPTIONS = set().union(*OPTIONS.values())


@cache
def source(module: str) -> str:
    """Source of a module or package that is run by `python -m MODULE`."""
    path = ROOT / module.removeprefix("scan2sim.").replace(".", "/")
    files = path.glob("*.py") if path.is_dir() else [path.with_suffix(".py")]
    return "".join(file.read_text(encoding="utf-8") for file in files)


def code_lines(text: str) -> Iterator[str]:
    """Lines of shell code blocks, with continuation lines joined, and inline code."""
    for language, block in re.findall(r"```(\w*)[^\n]*\n(.*?)```", text, re.DOTALL):
        if language not in ("", "sh"):
            continue
        yield from re.sub(r"\\\n\s*", "", block).splitlines()
    yield from re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def accepted_options(line: str) -> tuple[str, set[str]]:
    """The command of a line, and the options that it accepts."""
    words = shlex.split(line, comments=True) if line.count("'") % 2 == line.count('"') % 2 == 0 else line.split()
    name = max((name for name in OPTIONS if tuple(words[: len(name)]) == name), key=len)
    first = next((below for below in OPTIONS if below[:-1] == name), name)  # `slam VIDEO` is `slam video VIDEO`
    return " ".join(name), OPTIONS[name] | (OPTIONS[first] if name[1:] in (("slam",), ("segment",)) else set())


@pytest.mark.parametrize("page", page_params(PAGES + MODULES))
def test_documented_options_exist(page: Path) -> None:
    text, option = text_of(page), re.compile(r"(?<![\w-])--[a-z][\w-]*")
    modules = "".join(source(module) for module in re.findall(r"python -m (\w+\.[\w.]+)", text))
    others = {found for line in code_lines(text) if OTHER_PROGRAMS.search(line) for found in option.findall(line)}
    for line in code_lines(text):
        options = set(option.findall(line))
        if line.startswith("scan2sim ") and "..." not in line.split()[:2]:
            command, known = accepted_options(line)
            assert options <= known, f"{command} has no options {options - known}"
        else:
            unknown = {name for name in options - ALL_OPTIONS - others if f'"{name}"' not in modules}
            assert not unknown, f"no command has options {unknown}: {line}"


@pytest.mark.parametrize("page", page_params(PAGES + MODULES))
def test_documented_settings_and_metrics_exist(page: Path) -> None:
    names = "|".join(PARAMS)
    setting = re.compile(rf"(?<![\w/.-])({names})\.(?:(?:{'|'.join(SURFACES)})\.)?([a-z_0-9]+)")
    for step, name in setting.findall(" ".join(code_lines(text_of(page)))):
        known = {*PARAMS[step].settings(), *SURFACES, *SUFFIXES, "rest"}
        module = (ROOT / step / f"{name}.py").exists() or (ROOT / step / name).is_dir()
        assert name in known or module or name in string_literals(), f"unknown setting or metric: {step}.{name}"


@cache
def string_literals() -> set[str]:
    """Lower-case string literals of the code, which include the names of metrics."""
    return set(re.findall(r'"([a-z_0-9]+)"', "".join(path.read_text(encoding="utf-8") for path in MODULES)))


class RulesFile(Params):
    """File of alarm rules."""

    rules: list[Rule]
    notify: NotifyParams = NotifyParams()


def rejected(model: type[BaseModel], table: dict[str, Any]) -> list[Any]:
    """Fields of an incomplete table that a model rejects."""
    try:
        model.model_validate(table)
    except ValidationError as error:
        return [one["loc"] for one in error.errors() if one["type"] != "missing"]
    return []


FILE_MODELS = (Drive, TileFile, SurveyFile, RulesFile, Deployment, OidcParams)


@pytest.mark.parametrize("page", page_params([page for page in PAGES + MODULES if "```toml" in text_of(page)]))
def test_toml_examples_have_valid_fields(page: Path) -> None:
    for block in re.findall(r"```toml\n(.*?)```", text_of(page), re.DOTALL):
        table = tomllib.loads(block)
        models = [model for model in FILE_MODELS if not rejected(model, table)]
        settings = [step for step in table if step in PARAMS and not isinstance(table[step], str)]
        if len(settings) == len(table) and not models:
            for step in settings:
                values = {k: v for k, v in table[step].items() if k not in SURFACES}
                assert not rejected(PARAMS[step], values), f"invalid settings of {step}: {values}"
        else:
            assert models, f"fields of no file: {[rejected(model, table) for model in FILE_MODELS]}"


def test_the_survey_page_lists_exactly_the_fields_of_drive_toml() -> None:
    page = (ROOT / "docs" / "surveys.md").read_text(encoding="utf-8")
    block = next(b for b in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "[sweeps]" in b)
    parts = {name: Drive.model_fields[name].annotation for name in ("slam", "sweeps", "tiles")}
    fields = {field for part in parts.values() for field in _model(part).model_fields}
    listed = set(re.findall(r"[a-z_0-9]+", " ".join(re.findall(r"\b[a-z_]+(?:, [a-z_0-9]+){2,}", block))))
    assert listed <= fields, f"unknown fields of drive.toml: {listed - fields}"
    assert not (missing := {field for field in fields if not re.search(rf"\b{field}\b", block)}), missing
    tomls = {key for key, value in re.findall(r'^(\w+) = "(.*?)"', block, re.MULTILINE) if value.endswith(".toml")}
    assert tomls <= {"camera", "corridor"}, f"not TOML files: {tomls}"


def _model(annotation: Any) -> type[BaseModel]:
    kinds = [annotation, *getattr(annotation, "__args__", ())]
    return next(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel))


@cache
def project_files() -> tuple[str, ...]:
    """Paths of all files of the project."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        return tuple(path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*"))
    return tuple(listed.stdout.split())


OTHERS_FILES = ("random.py", "navigation_launch.py", "localization_launch.py")
"""Files of Python and of Nav2 that pages name."""


@pytest.mark.parametrize("page", page_params(PAGES + MODULES))
def test_documented_project_files_exist(page: Path) -> None:
    folders = {name.split("/")[0] for name in project_files() if "/" in name}
    for name in re.findall(r"(?<![\w/.-])(?:[\w.-]+/)*[\w-]+\.(?:py|md|txt|yaml|toml|j2)\b", text_of(page)):
        ours = name.split("/")[0] in folders if "/" in name else name.endswith(".py") and name not in OTHERS_FILES
        if ours:
            assert any(f"/{file}".endswith(f"/{name}") for file in project_files()), f"file not found: {name}"


@pytest.mark.parametrize("page", page_params(PAGES))
def test_links_have_existing_targets(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        path, _, heading = link.partition("#")
        if not link.startswith("http"):
            target = page.parent / path if path else page
            assert target.exists(), link
            assert not heading or heading in headings(target), link


def headings(page: Path) -> set[str]:
    """Anchors of headings, as created by GitHub."""
    found = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}


def rows_of(page: str) -> dict[str, list[str]]:
    """Rows of the first table of a page, by their first cell."""
    first = (ROOT / page).read_text(encoding="utf-8").split("| --- |", 1)[1].split("\n\n", 1)[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in first.splitlines()[1:]]
    return {name: rest for name, *rest in cells}


@pytest.mark.parametrize(
    ("row", "read"),
    [
        ("a point cloud of a street, a yard, a building", set(clouds.formats())),
        ("photos with known poses", set(image.SUFFIXES)),
        ("a ROS 1 or ROS 2 bag", set(reader.SUFFIXES)),
        ("lidar sweeps, one file each", set(sweep_files.SWEEP_SUFFIXES)),
        ("a GPS track", set(plugins.by_suffix(gps.__name__))),
        ("a textured mesh", set(mesh_files.SUFFIXES)),
        ("the calibration of your camera", {*camera_calibrations.SUFFIXES, ".toml"}),
    ],
)
def test_the_page_of_inputs_lists_what_the_readers_read(row: str, read: set[str]) -> None:
    assert set(re.findall(r"`([\w.]*\.\w+)`", rows_of("docs/inputs.md")[row][0])) == read


def test_the_page_of_inputs_lists_every_import() -> None:
    text = (ROOT / "docs/inputs.md").read_text(encoding="utf-8")
    imports = {word for word, command in loaded("import").commands.items() if not command.hidden}
    assert set(re.findall(r"scan2sim import ([\w-]+)", text)) == imports


def test_the_page_of_python_describes_every_function() -> None:
    text = (ROOT / "docs/reference/python.md").read_text(encoding="utf-8")
    (members,) = re.findall(r"members: \[(.*)\]", text)
    names = {name for name in scan2sim.__all__ if not name.endswith("Error") and name != "__version__"}
    assert set(members.split(", ")) == names
    imports = {name for name in names if name.startswith("import_")}
    assert set(re.findall(r"`(import_\w+)`", text)) == imports


@pytest.mark.parametrize("page", page_params([page for page in PAGES if "```python" in text_of(page)]))
def test_python_on_the_pages_imports_existing_names(page: Path) -> None:
    for block in re.findall(r"```python\n(.*?)```", text_of(page), re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("scan2sim"):
                module = importlib.import_module(str(node.module))
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert not missing, f"{node.module} has no {missing}"
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "scan2sim":
                assert node.attr in scan2sim.__all__, f"scan2sim has no public name {node.attr}"
