"""Pinned packages: docs/reference/third-party.md lists them, and they install on every supported Python."""

from __future__ import annotations

import importlib.metadata
import re
import sys

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from deploy.third_party import closure, page, project
from tests.conftest import ROOT


def test_the_page_lists_all_pinned_core_packages() -> None:
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE))
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    core = [name for name in closure(project()["core"]) if name in pins]
    text = (ROOT / "docs" / "reference" / "third-party.md").read_text(encoding="utf-8")
    section = text.split("## Core")[1].split("\n## ")[0]
    assert len(core) > 20
    for name in core:
        assert f"| {name} | {pins[name]} |" in section, (
            f"{name} is outdated: python -m deploy.third_party > docs/reference/third-party.md"
        )


def test_all_libraries_bundled_in_wheels_have_a_licence_entry() -> None:
    assert page()[1] == []


def test_the_core_contains_no_gpl_packages() -> None:
    text = page()[0].split("## Core")[1].split("\n## ")[0]
    for line in text.splitlines():
        rest = re.sub(
            r"L?GPL-[\d.]+-or-later WITH GCC-exception-3.1|LGPL-[\d.]+-or-later|FTL OR GPL-2.0-or-later", "", line
        )
        assert "GPL" not in rest and "GNU General" not in rest, line


def test_pinned_packages_install_on_the_first_patch_release_of_this_python() -> None:
    """Distributions keep early patch releases: Debian 12 has Python 3.11.2."""
    first = f"{sys.version_info[0]}.{sys.version_info[1]}.0"
    required = {
        f"{package.metadata['Name']} {package.version}": python
        for package in importlib.metadata.distributions()
        if (python := package.metadata.get("Requires-Python"))  # type: ignore[attr-defined]
    }
    assert {name: python for name, python in required.items() if not SpecifierSet(python).contains(first)} == {}
