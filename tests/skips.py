"""Skipped tests: a table by reason and, on CI, a check that only expected tests are skipped.

`tests/conftest.py` imports these hooks. Patterns of expected reasons are in `expected_skips.toml`.
"""

from __future__ import annotations

import os
import tomllib
from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

EXPECTED_SKIPS = Path(__file__).with_name("expected_skips.toml")
UNEXPECTED_SKIPS_STATUS = 8
"""Exit status of a run in which only unexpected skips are wrong."""


def skip_reasons(reporter: pytest.TerminalReporter) -> Counter[str]:
    """Number of skipped tests and modules by reason."""
    found: Counter[str] = Counter()
    for report in reporter.stats.get("skipped", ()):
        text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        found[text.removeprefix("Skipped: ")] += 1
    return found


def unexpected_reasons(found: Counter[str]) -> list[str]:
    """Reasons that match no pattern of expected_skips.toml."""
    patterns = tomllib.loads(EXPECTED_SKIPS.read_text(encoding="utf-8"))["expected"]
    return [reason for reason in found if not any(fnmatchcase(reason, pattern) for pattern in patterns)]


def on_ci() -> bool:
    """Whether the tests run on CI, where unexpected skips make the run fail."""
    return os.environ.get("CI", "").lower() in ("1", "true")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """On CI, fail the run if a test was skipped for an unexpected reason."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if (
        reporter is not None
        and not hasattr(session.config, "workerinput")
        and on_ci()
        and unexpected_reasons(skip_reasons(reporter))
    ):
        session.exitstatus = UNEXPECTED_SKIPS_STATUS if session.exitstatus in (0, 1) else session.exitstatus


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the number of skipped tests by reason."""
    found = skip_reasons(terminalreporter)
    if not found:
        return
    terminalreporter.section(f"{found.total()} tests or modules skipped")
    for reason, count in found.most_common():
        terminalreporter.write_line(f"{count:5d}  {reason}")
    if on_ci():
        for reason in unexpected_reasons(found):
            message = f"unexpected on CI: {reason} (make it run, or add its reason to tests/{EXPECTED_SKIPS.name})"
            terminalreporter.write_line(message, red=True)
