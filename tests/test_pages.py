"""What pages name is there: options of commands, settings, fields of TOML files, files of the project, links."""

from __future__ import annotations

import ast
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

from scan2sim.flows.cli import COMMANDS, app, loaded
from scan2sim.flows.pipelines.drive import Drive
from scan2sim.flows.pipelines.steps import STEPS
from scan2sim.pipeline.core.classes import SURFACES
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io.survey import SurveyFile
from scan2sim.pipeline.io.tile import TileFile
from scan2sim.services.monitoring.events.rules import Rule
from scan2sim.services.orchestration.deployment import Deployment
from tests.conftest import ROOT

ROOMS = ("pipeline", "segmentation", "texturing", "slam", "flows", "services", "data_samples")
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/**/*.md")),
    ROOT / "data_samples/README.md",
]
MODULES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
PARAMS: dict[str, type[BaseModel]] = {step.name: step.params for step in STEPS}
OTHERS = re.compile(r"\b(prefect|docker|dask|ray|gz|pip|aws|curl|trtexec|export.py)\b")
"""Other programs, whose options a page may name once it has shown them in a command."""
SUFFIXES = {"py", "json", "geojson", "csv", "obj", "laz", "png", "npz", "toml", "sdf", "dae", "mtl", "glb", "jpg"}


def about(page: Path) -> str:
    """What a page says; of a module, its first docstring."""
    text = page.read_text(encoding="utf-8")
    return text if page.suffix == ".md" else ast.get_docstring(ast.parse(text)) or ""


def named(pages: list[Path]) -> list[Any]:
    some = [page for page in pages if page.suffix == ".md" or re.search(r"`|--|\.(py|md)", about(page))]
    return [pytest.param(page, id=page.relative_to(ROOT).as_posix()) for page in some]


def commands(group: Any, name: tuple[str, ...] = ("scan2sim",)) -> Iterator[tuple[tuple[str, ...], set[str]]]:
    """Every command by its words, and its options."""
    yield name, {option for param in group.params for option in (*param.opts, *param.secondary_opts)} | {"--help"}
    for word, below in getattr(group, "commands", {}).items():
        yield from commands(below, (*name, word))


OPTIONS = dict(commands(typer.main.get_command(app)))
for command in COMMANDS:
    OPTIONS |= dict(commands(loaded(command), ("scan2sim", command)))
ALL = set().union(*OPTIONS.values())


@cache
def source(module: str) -> str:
    """Of `python -m MODULE`."""
    path = ROOT / module.removeprefix("scan2sim.").replace(".", "/")
    files = path.glob("*.py") if path.is_dir() else [path.with_suffix(".py")]
    return "".join(file.read_text(encoding="utf-8") for file in files)


def lines(text: str) -> Iterator[str]:
    """Lines of code and spans of code that show commands, those that are continued joined."""
    for block in re.findall(r"```(?:sh)?\n(.*?)```", text, re.DOTALL):
        yield from re.sub(r"\\\n\s*", "", block).splitlines()
    yield from re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))


def taken(line: str) -> tuple[str, set[str]]:
    """The command of a line, and the options that it takes."""
    words = shlex.split(line, comments=True) if line.count("'") % 2 == line.count('"') % 2 == 0 else line.split()
    fits = [name for name in OPTIONS if tuple(words[: len(name)]) == name]
    name = max(fits, key=len)
    first = next((below for below in OPTIONS if below[:-1] == name), name)  # `slam VIDEO` is `slam video VIDEO`
    return " ".join(name), OPTIONS[name] | (OPTIONS[first] if name[1:] in (("slam",), ("segment",)) else set())


@pytest.mark.parametrize("page", named(PAGES + MODULES))
def test_options_are_those_of_the_commands(page: Path) -> None:
    text, option = about(page), re.compile(r"(?<![\w-])--[a-z][\w-]*")
    modules = "".join(source(module) for module in re.findall(r"python -m (\w+\.[\w.]+)", text))
    others = {found for line in lines(text) if OTHERS.search(line) for found in option.findall(line)}
    for line in lines(text):
        options = set(option.findall(line))
        if line.startswith("scan2sim ") and "..." not in line.split()[:2]:
            command, known = taken(line)
            assert options <= known, f"{command} has no {options - known}"
        else:
            unknown = {name for name in options - ALL - others if f'"{name}"' not in modules}
            assert not unknown, f"no command has {unknown}: {line}"


@pytest.mark.parametrize("page", named(PAGES + MODULES))
def test_settings_are_parameters_or_figures(page: Path) -> None:
    names = "|".join(PARAMS)
    setting = re.compile(rf"(?<![\w/.-])({names})\.(?:(?:{'|'.join(SURFACES)})\.)?([a-z_0-9]+)")
    for step, name in setting.findall(" ".join(lines(about(page)))):
        known = {*PARAMS[step].model_fields, *SURFACES, *SUFFIXES, "rest"}
        module = (ROOT / step / f"{name}.py").exists() or (ROOT / step / name).is_dir()
        assert name in known or module or name in figures(), f"there is no {step}.{name}"


@cache
def figures() -> set[str]:
    """Words that the code writes: names of figures among them."""
    return set(re.findall(r'"([a-z_0-9]+)"', "".join(path.read_text(encoding="utf-8") for path in MODULES)))


class RulesFile(Params):
    """A file of alarms' rules."""

    rules: list[Rule]


def refused(model: type[BaseModel], table: dict[str, Any]) -> list[Any]:
    """What a model refuses of a table, part of which may be missing."""
    try:
        model.model_validate(table)
    except ValidationError as error:
        return [one["loc"] for one in error.errors() if one["type"] != "missing"]
    return []


FILES = (Drive, TileFile, SurveyFile, RulesFile, Deployment)


@pytest.mark.parametrize("page", named([page for page in PAGES + MODULES if "```toml" in about(page)]))
def test_toml_has_the_fields_that_are_read(page: Path) -> None:
    for block in re.findall(r"```toml\n(.*?)```", about(page), re.DOTALL):
        table = tomllib.loads(block)
        models = [model for model in FILES if not refused(model, table)]
        settings = [step for step in table if step in PARAMS and not isinstance(table[step], str)]
        if len(settings) == len(table) and not models:
            for step in settings:
                values = {k: v for k, v in table[step].items() if k not in SURFACES}
                assert not refused(PARAMS[step], values), f"there is no {step} with {values}"
        else:
            assert models, f"no file has {[refused(model, table) for model in FILES]}"


def test_the_page_of_drives_names_all_their_fields_and_no_others() -> None:
    page = (ROOT / "docs" / "surveys.md").read_text(encoding="utf-8")
    block = next(b for b in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if "[sweeps]" in b)
    parts = {name: Drive.model_fields[name].annotation for name in ("slam", "sweeps", "tiles")}
    fields = {field for part in parts.values() for field in _model(part).model_fields}
    listed = set(re.findall(r"[a-z_0-9]+", " ".join(re.findall(r"\b[a-z_]+(?:, [a-z_0-9]+){2,}", block))))
    assert listed <= fields, f"no drive has {listed - fields}"
    assert not (missing := {field for field in fields if not re.search(rf"\b{field}\b", block)}), missing
    tomls = {key for key, value in re.findall(r'^(\w+) = "(.*?)"', block, re.MULTILINE) if value.endswith(".toml")}
    assert tomls <= {"camera", "corridor"}, f"{tomls} are no TOML files"


def _model(annotation: Any) -> type[BaseModel]:
    kinds = [annotation, *getattr(annotation, "__args__", ())]
    return next(kind for kind in kinds if isinstance(kind, type) and issubclass(kind, BaseModel))


@cache
def project() -> tuple[str, ...]:
    """Files of the project."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        return tuple(path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*"))
    return tuple(listed.stdout.split())


@pytest.mark.parametrize("page", named(PAGES + MODULES))
def test_files_of_the_project_are_there(page: Path) -> None:
    places = {name.split("/")[0] for name in project() if "/" in name}
    for name in re.findall(r"(?<![\w/.-])(?:[\w.-]+/)*[\w-]+\.(?:py|md|txt|yaml|toml|j2)\b", about(page)):
        ours = name.split("/")[0] in places if "/" in name else name.endswith(".py") and name != "random.py"
        if ours:
            assert any(f"/{file}".endswith(f"/{name}") for file in project()), f"there is no {name}"


@pytest.mark.parametrize("page", named(PAGES))
def test_links_lead_to_pages_and_headings(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", about(page)):
        path, _, heading = link.partition("#")
        if not link.startswith("http"):
            target = page.parent / path if path else page
            assert target.exists(), link
            assert not heading or heading in headings(target), link


def headings(page: Path) -> set[str]:
    """Anchors as GitHub makes them."""
    found = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}
