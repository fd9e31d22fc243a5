"""Docstrings: arguments that they describe exist, and so do the names that they mention."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGES = ("pipeline", "segmentation", "texturing", "slam", "flows", "services", "data_samples", "bench")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
FOREIGN = {
    "preserveboundary", "timebase", "point_time_offset", "time_offset_ns", "up_axis", "LoadNVM",
    "SetNormalizedMeasurementDistortion", "mj_multiRay", "qualityLevel", "save_pretrained", "timeout_keep_alive",
    "limit_concurrency", "stop_pub_timeout", "Stamp", "descriptor_set_out", "include_imports",
    "camN", "camera_matrix", "distortion_coefficients", "CameraMat", "DistCoeff", "CameraExtrinsicMat",
}  # fmt: skip
"""Names in other programs, protocols and file formats."""
BUILT = {
    "_part1", "height_K", "assumed_K", "uncovered_terrain", "uncovered_building", "uncovered_vegetation", "NAME_0000",
    "name_0000", "T_target_source", "wall_p95_cm", "road_width_p95_m", "height_p95_m", "carla_lane_p95_m",
}  # fmt: skip
"""Names that the code puts together, and mathematical ones."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Module:
    """What the tests need of a module: its syntax tree would fill the memory, and slow down collecting garbage.

    Attributes:
        docstrings: of the module, of classes, functions and constants, with their lines.
        documented: functions and classes with a docstring.
        words: names and words outside of the docstrings.
    """

    docstrings: list[tuple[int, str]]
    documented: list[Documented]
    words: set[str]


@dataclass(frozen=True)
class Documented:
    """Function or class with a docstring."""

    line: int
    name: str
    docstring: str
    arguments: set[str]


@cache
def module(file: Path) -> Module:
    """What the tests need of a module."""
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    strings = docstrings(nodes)
    definitions = [node for node in nodes if isinstance(node, Function | ast.ClassDef)]
    return Module(
        [(node.lineno, str(node.value)) for node in strings],
        [
            Documented(node.lineno, node.name, text, arguments(node))
            for node in definitions if (text := ast.get_docstring(node))
        ],
        {file.stem, file.parent.name, *words(nodes, {id(node) for node in strings})},
    )  # fmt: skip


def docstrings(nodes: list[ast.AST]) -> list[ast.Constant]:
    """Strings that are statements: docstrings of modules, classes and functions, descriptions of constants."""
    statements = (node for node in nodes if isinstance(node, ast.Expr))
    return [
        node.value for node in statements if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]


def described(docstring: str) -> list[str]:
    """Names of the section "Args:" of a docstring."""
    _, _, section = docstring.partition("\nArgs:\n")
    section = re.split(r"\n(?=\S)", section)[0]
    entries = re.findall(r"^    ([\w*][\w*, ]*?(?:,\n        [\w, ]+?)?):(?:\s|$)", section, re.MULTILINE)
    return [name.strip(" *\n") for entry in entries for name in entry.split(",")]


def arguments(node: Function | ast.ClassDef) -> set[str]:
    """Names of the arguments of a function, or of a class: those of `__init__`, or its fields."""
    if isinstance(node, ast.ClassDef):
        fields = {
            one.target.id for one in node.body if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
        }
        return fields.union(
            *(arguments(one) for one in node.body if isinstance(one, Function) and one.name == "__init__")
        )
    args = node.args
    return {one.arg for one in (*args.posonlyargs, *args.args, *args.kwonlyargs, args.vararg, args.kwarg) if one}


def words(nodes: list[ast.AST], skipped: set[int]) -> Iterator[str]:
    """Names and words of nodes, without those whose id is skipped."""
    for node in nodes:
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=str(name)):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.alias(name=name):
                yield from name.split(".")
            case ast.Constant(value=str(text)) if id(node) not in skipped:
                yield from re.findall(r"\w+", text)


@pytest.mark.parametrize("package", PACKAGES)
def test_described_arguments_exist(package: str) -> None:
    wrong = []
    for file in MODULES:
        if file.relative_to(ROOT).parts[0] != package:
            continue
        for one in module(file).documented:
            unknown = set(described(one.docstring)) - one.arguments
            wrong += [f"{file.relative_to(ROOT)}:{one.line} {one.name}: {unknown}"] if unknown else []
    assert not wrong, "docstrings describe arguments that don't exist:\n" + "\n".join(wrong)


def test_names_in_backticks_exist() -> None:
    known = FOREIGN | BUILT
    known.update(*(module(file).words for file in MODULES))
    known.update(*(re.findall(r"\w+", page.read_text(encoding="utf-8")) for page in ROOT.glob("services/pages/*.js")))
    unknown = [
        f"{file.relative_to(ROOT)}:{line} `{name}`"
        for file in MODULES for line, text in module(file).docstrings
        for name in re.findall(r"(?<!`)`([A-Za-z_]\w*)`(?!`)", text) if name not in known
    ]  # fmt: skip
    assert not unknown, "docstrings mention names that don't occur in the code:\n" + "\n".join(unknown)


def test_unknown_arguments_are_found() -> None:
    source = 'def f(a, b):\n    """Do.\n\n    Args:\n        a, c: two.\n        d: one:\n            more.\n    """\n'
    node = ast.parse(source).body[0]
    assert isinstance(node, ast.FunctionDef)
    assert set(described(ast.get_docstring(node) or "")) - arguments(node) == {"c", "d"}
