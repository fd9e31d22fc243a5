"""Architecture: directions of imports, start of the command without heavy packages, documented settings and files."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGES = {
    "pipeline": set(),
    "segmentation": {"pipeline"},
    "texturing": {"pipeline"},
    "slam": {"pipeline"},
    "services": {"pipeline", "segmentation", "slam"},
    "data_samples": {"pipeline", "segmentation"},
    "flows": {"pipeline", "segmentation", "texturing", "slam", "services", "data_samples"},
}
HEAVY = ("open3d", "torch", "prefect", "numba", "cv2", "scipy", "trimesh", "pyproj", "pycolmap", "pymeshlab", "numpy")


@cache
def modules(file: Path) -> set[str]:
    """Full names of the modules, or of objects in modules, that a file imports anywhere."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def imported(file: Path) -> set[str]:
    """Top-level packages that a file imports anywhere; those of the project without `scan2sim`."""
    return {name.removeprefix("scan2sim.").split(".")[0] for name in modules(file)}


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_permitted_packages(package: str) -> None:
    for file in (ROOT / package).rglob("*.py"):
        foreign = (imported(file) & set(PACKAGES)) - {package} - PACKAGES[package]
        assert not foreign, f"{file.relative_to(ROOT)} imports {foreign}"


def test_tests_do_not_import_benchmarks() -> None:
    for file in (ROOT / "tests").rglob("*.py"):
        assert "bench" not in imported(file), f"{file.relative_to(ROOT)} imports bench: share code in tests/fakes"


def test_benchmarks_import_only_fakes_from_tests() -> None:
    for file in (ROOT / "bench").rglob("*.py"):
        foreign = [name for name in modules(file) if f"{name}.".startswith("tests.")]
        assert all(name.startswith("tests.fakes.") for name in foreign), f"{file.relative_to(ROOT)} imports {foreign}"


def project_files() -> dict[str, Path]:
    """Files of the project's modules by dotted name (`flows.engine.memory`)."""
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    return {".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): f for f in files}


@cache
def import_graph() -> dict[str, set[str]]:
    """Modules of the project that each module imports, anywhere in its file."""
    known = project_files()

    def wanted(file: Path) -> set[str]:
        names = (name.removeprefix("scan2sim.") for name in modules(file))
        return {next((n for n in (name, name.rpartition(".")[0]) if n in known), "") for name in names} - {""}

    return {name: wanted(file) - {name} for name, file in known.items()}


def test_imports_of_modules_have_no_cycles() -> None:
    TopologicalSorter(import_graph()).prepare()  # raises a CycleError that names them


def package_import_graph(package: str, depth: int) -> dict[str, set[str]]:
    """Imports between the packages and modules of one top-level package, `depth` levels below the root."""
    graph: dict[str, set[str]] = {}
    for name, others in import_graph().items():
        if name.startswith(f"{package}."):
            own = ".".join(name.split(".")[:depth])
            found = {".".join(other.split(".")[:depth]) for other in others if other.startswith(f"{package}.")}
            graph[own] = graph.get(own, set()) | found - {own}
    return graph


@pytest.mark.parametrize(("package", "depth"), [*((package, 2) for package in PACKAGES), ("services", 3)])
def test_imports_of_packages_have_no_cycles(package: str, depth: int) -> None:
    TopologicalSorter(package_import_graph(package, depth)).prepare()  # raises a CycleError that names them


def step_modules() -> set[str]:
    """Modules of steps: those in a package `steps`, and others that assign a `Step(...)` at module level."""

    def defines_step(file: Path) -> bool:
        for statement in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(statement, (ast.Assign, ast.AnnAssign)) and statement.value is not None:
                calls = [node.func for node in ast.walk(statement.value) if isinstance(node, ast.Call)]
                if any(isinstance(call, ast.Name) and call.id == "Step" for call in calls):
                    return True
        return False

    return {name for name, file in project_files().items() if "steps" in name.split(".") or defines_step(file)}


def test_steps_are_imported_only_by_steps_of_their_package_and_by_flows() -> None:
    steps = step_modules()
    assert {"pipeline.steps.voxel", "texturing.unwrap", "slam.steps.track"} <= steps
    for name, others in import_graph().items():
        if not name.startswith("flows."):
            own = {step for step in steps if name in steps and step.split(".")[0] == name.split(".")[0]}
            assert not others & steps - own, f"{name} imports {others & steps - own}"


def test_subpackages_of_flows_import_only_earlier_ones() -> None:
    # each may import those before it
    order = ["pipelines", "engine", "reports", "commands", "deployed", "cli", "importers", "api"]
    for name, others in import_graph().items():
        if name.startswith("flows."):
            later = order[order.index(name.split(".")[1]) + 1 :]
            foreign = [other for other in others if other.startswith("flows.") and other.split(".")[1] in later]
            assert not foreign, f"{name} imports {foreign}"


def test_only_deployed_flows_import_prefect() -> None:
    for name, file in project_files().items():
        assert "prefect" not in imported(file) or name.startswith("flows.deployed."), file.relative_to(ROOT)


def test_install_hints_work_without_a_checkout() -> None:
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*.py"):
            assert not re.search(r"pip install[^\n]*(-e |constraints)", file.read_text(encoding="utf-8")), (
                file.relative_to(ROOT)
            )


def loaded_by(code: str, names: tuple[str, ...] = HEAVY) -> set[str]:
    """Which of the modules a fresh interpreter has loaded after running `code`; and the words that it prints."""
    script = f"import sys\n{code}\nprint(*[m for m in {names!r} if m in sys.modules])"
    return set(
        subprocess.run(
            [sys.executable, "-c", script], cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout.split()
    )


def test_command_starts_without_heavy_packages() -> None:
    assert loaded_by("import scan2sim.flows.cli") == set()


def test_version_and_help_import_no_heavy_package() -> None:
    code = (
        "import sys; sys.argv[1:] = ['{}']\nfrom scan2sim.flows.cli import main\ntry: main()\nexcept SystemExit: pass"
    )
    more = ("pydantic", "jinja2", "fsspec", "asyncio", "http", "importlib.metadata", "multiprocessing")
    assert not loaded_by(code.format("--version"), (*HEAVY, *more, "rich", "email")) & {*HEAVY, *more, "rich", "email"}
    assert not loaded_by(code.format("--help"), (*HEAVY, *more)) & {*HEAVY, *more}


def test_command_summaries_equal_the_commands_own_help() -> None:
    from scan2sim.flows.cli import COMMANDS, loaded

    assert {name: loaded(name).help for name in COMMANDS} == {name: about for name, (_, about) in COMMANDS.items()}


def test_pipeline_definition_imports_no_heavy_package() -> None:
    assert loaded_by("import scan2sim.flows.pipelines.tile") <= {"numpy"}


@pytest.mark.parametrize("command", ["run", "plan", "view", "export", "inspect", "verify"])
def test_command_for_worlds_starts_without_the_packages_of_steps(command: str) -> None:
    assert loaded_by(f"import scan2sim.flows.commands.{command}") <= {"numpy"}


def test_every_setting_is_documented() -> None:
    from scan2sim.flows.pipelines.steps import STEPS

    text = (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8")
    for step in STEPS:
        for param in step.params.settings():
            assert f"`{step.name}.{param}`" in text, f"not in docs/reference/settings.md: {step.name}.{param}"


def test_every_exit_code_is_documented() -> None:
    from scan2sim.pipeline.core.errors import EXIT_CODES

    text = (ROOT / "docs" / "reference" / "formats.md").read_text(encoding="utf-8")
    for code, _, meaning in EXIT_CODES.values():
        assert f"| {code} |" in text and meaning in text


def test_walkthroughs_in_the_docs_name_existing_files_once() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("## Three walks")[1].split("\n## ")[0]
    walks = [re.findall(r"`([\w/]+\.py)`", walk) for walk in text.split("\n\n")[2:] if walk.strip()]
    assert len(walks) == 3
    for stops in walks:
        assert len(stops) > 8 and len(set(stops)) == len(stops), stops
        assert all((ROOT / stop).is_file() for stop in stops)
