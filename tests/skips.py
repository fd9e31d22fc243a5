"""Skipped tests: a table of them by reason and, on CI, a check that only the expected ones are skipped.

`tests/conftest.py` takes the hooks from here. Expected skips are patterns in `expected_skips.toml`.
"""

from __future__ import annotations

import os
import tomllib
from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

EXPECTED = Path(__file__).with_name("expected_skips.toml")


def reasons(reporter: pytest.TerminalReporter) -> Counter[str]:
    """Number of skipped tests, and of skipped modules, by reason."""
    found: Counter[str] = Counter()
    for report in reporter.stats.get("skipped", ()):
        text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        found[text.removeprefix("Skipped: ")] += 1
    return found


def unexpected(found: Counter[str]) -> list[str]:
    """Reasons that match no pattern of the committed file."""
    patterns = tomllib.loads(EXPECTED.read_text(encoding="utf-8"))["expected"]
    return [reason for reason in found if not any(fnmatchcase(reason, pattern) for pattern in patterns)]


def on_ci() -> bool:
    """Whether skips that aren't expected make the run fail."""
    return os.environ.get("CI", "").lower() in ("1", "true")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """On CI, fail the run if a test was skipped for a reason that isn't expected."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if (
        reporter is not None
        and not hasattr(session.config, "workerinput")
        and on_ci()
        and unexpected(reasons(reporter))
    ):
        session.exitstatus = max(session.exitstatus, pytest.ExitCode.TESTS_FAILED)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print how many tests were skipped, by reason."""
    found = reasons(terminalreporter)
    if not found:
        return
    terminalreporter.section(f"{found.total()} tests or modules skipped")
    for reason, count in found.most_common():
        terminalreporter.write_line(f"{count:5d}  {reason}")
    if on_ci():
        for reason in unexpected(found):
            terminalreporter.write_line(
                f"not expected on CI, and listed nowhere in {EXPECTED.name}: {reason}", red=True
            )
