"""docs/reference/third-party.md names what is installed: made again whenever the constraints change."""

from __future__ import annotations

import re

from packaging.utils import canonicalize_name

from bench.packaging.third_party import closure, page, project
from tests.conftest import ROOT


def test_the_page_names_every_pinned_package_of_the_core() -> None:
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE))
    pins = {canonicalize_name(name): version for name, version in pins.items()}
    core = [name for name in closure(project()["core"]) if name in pins]
    page = (
        (ROOT / "docs" / "reference" / "third-party.md")
        .read_text(encoding="utf-8")
        .split("## Core")[1]
        .split("\n## ")[0]
    )
    assert len(core) > 20
    for name in core:
        assert f"| {name} | {pins[name]} |" in page, (
            f"{name}: python -m bench.packaging.third_party > docs/reference/third-party.md"
        )


def test_every_library_that_wheels_bring_has_a_licence_there() -> None:
    assert page()[1] == []


def test_nothing_under_the_gpl_comes_with_the_core() -> None:
    text = page()[0].split("## Core")[1].split("\n## ")[0]
    for line in text.splitlines():
        rest = re.sub(
            r"L?GPL-[\d.]+-or-later WITH GCC-exception-3.1|LGPL-[\d.]+-or-later|FTL OR GPL-2.0-or-later", "", line
        )
        assert "GPL" not in rest and "GNU General" not in rest, line
