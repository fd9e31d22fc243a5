"""Tests outside `realtime` don't depend on the speed of the machine: no assertion on wall time, no sleep before one."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from tests.conftest import ROOT

CLOCKS = ("monotonic", "perf_counter", "time", "monotonic_ns", "perf_counter_ns", "time_ns")
SLEEP_MAX_S = 0.1
"""Shortest sleep that counts as waiting for something."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def is_realtime(node: ast.Module | Function) -> bool:
    """Whether a module (`pytestmark`) or a test (decorators) has the marker `realtime`."""
    if isinstance(node, ast.Module):
        marks = [one.value for one in node.body if isinstance(one, ast.Assign) and "pytestmark" in ast.unparse(one)]
    else:
        marks = node.decorator_list
    return any("mark.realtime" in ast.unparse(mark) for mark in marks)


def is_clock(node: ast.AST) -> bool:
    """Whether this is a call of a clock: `time.monotonic()`, `perf_counter()`."""
    if not isinstance(node, ast.Call) or node.args:
        return False
    if isinstance(node.func, ast.Attribute):
        return node.func.attr in CLOCKS and ast.unparse(node.func.value) == "time"
    return isinstance(node.func, ast.Name) and node.func.id in CLOCKS


def is_duration(node: ast.expr) -> bool:
    """Whether an expression contains the time that has passed since a moment, `monotonic() - began`."""
    differences = [one for one in ast.walk(node) if isinstance(one, ast.BinOp) and isinstance(one.op, ast.Sub)]
    return any(is_clock(one.left) and not isinstance(one.right, ast.Constant) for one in differences)


def asserts_wall_time(node: ast.Assert) -> bool:
    """Whether an assertion limits the time that has passed, `monotonic() - began < 5`."""
    for compared in (one for one in ast.walk(node.test) if isinstance(one, ast.Compare)):
        sides = [compared.left, *compared.comparators]
        for left, operator, right in zip(sides, compared.ops, sides[1:], strict=False):
            if isinstance(operator, ast.Lt | ast.LtE) and is_duration(left):
                return True
            if isinstance(operator, ast.Gt | ast.GtE) and is_duration(right):
                return True
    return False


def is_long_sleep(node: ast.AST) -> bool:
    """Whether this is a call `time.sleep(x)` or `asyncio.sleep(x)` of a constant of at least `SLEEP_MAX_S`."""
    if not isinstance(node, ast.Call) or not ast.unparse(node.func).endswith(("time.sleep", "asyncio.sleep")):
        return False
    duration = node.args[0]
    return (
        isinstance(duration, ast.Constant)
        and isinstance(duration.value, (int, float))
        and duration.value >= SLEEP_MAX_S
    )


def own_nodes(function: Function) -> Iterator[ast.AST]:
    """Nodes of a function without those of functions in it."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        yield node
        if not isinstance(node, Function | ast.Lambda):
            pending.extend(ast.iter_child_nodes(node))


def violations(source: str) -> list[str]:
    """Tests that assert wall time, or sleep before an assertion."""
    module = ast.parse(source)
    if is_realtime(module):
        return []
    found = []
    for test in (one for one in ast.walk(module) if isinstance(one, Function) and one.name.startswith("test_")):
        if is_realtime(test):
            continue
        nodes = list(own_nodes(test))
        asserts = [one for one in nodes if isinstance(one, ast.Assert)]
        found += [f"{test.name}:{one.lineno}: asserts wall time" for one in asserts if asserts_wall_time(one)]
        last = max((one.lineno for one in asserts), default=0)
        sleeps = [one for one in nodes if is_long_sleep(one) and isinstance(one, ast.Call) and one.lineno < last]
        found += [f"{test.name}:{one.lineno}: sleeps before an assertion" for one in sleeps]
    return found


def test_no_test_outside_realtime_depends_on_wall_time() -> None:
    found = [
        f"{file.relative_to(ROOT)}:{violation}"
        for file in sorted((ROOT / "tests").rglob("test_*.py"))
        for violation in violations(file.read_text(encoding="utf-8"))
    ]
    assert not found, "wait for a condition, take the time as an input, or mark as realtime:\n" + "\n".join(found)


def test_wall_time_is_recognized() -> None:
    body = "def test_x():\n    began = time.monotonic()\n    assert time.monotonic() - began < 5\n"
    assert violations(body) == ["test_x:3: asserts wall time"]
    assert violations("def test_x():\n    time.sleep(0.5)\n    assert done\n") == [
        "test_x:2: sleeps before an assertion"
    ]
    assert violations("@pytest.mark.realtime\n" + body) == []
    assert violations("pytestmark = pytest.mark.realtime\n" + body) == []
    assert violations("def test_x():\n    time.sleep(0.01)\n    assert done\n    time.sleep(9)\n") == []
    assert violations("def test_x():\n    assert clock() - began < 5\n") == []
    assert violations("def test_x():\n    assert age <= time.monotonic() - sent\n") == []
