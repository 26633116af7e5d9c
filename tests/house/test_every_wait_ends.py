"""No test waits for ever: a program that ignores a signal, or a thread that hangs, is a failure in time."""

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted([*(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("test_*.py")])
RUNS = {"run", "call", "check_call", "check_output"}
WAITS = {"wait", "join"}
"""Methods of processes, threads and events that wait for ever where they are called with nothing."""


def endless(tree: ast.AST) -> list[int]:
    """Lines of a module that may wait for ever."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.With) and any(is_popen(item.context_expr) for item in node.items):
            found.append(node.lineno)  # leaving the block waits
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        owner, name = node.func.value, node.func.attr
        keywords = {keyword.arg for keyword in node.keywords}
        timed = bool(keywords & {"timeout", None})
        of_subprocess = isinstance(owner, ast.Name) and owner.id == "subprocess"
        wants = (of_subprocess and name in RUNS) or name == "communicate"
        bare = name in WAITS and not node.args and not node.keywords
        if (wants and not timed) or bare:
            found.append(node.lineno)
    return found


def is_popen(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func) in ("subprocess.Popen", "Popen")


@pytest.mark.parametrize(
    "text",
    [
        "subprocess.run(['a'])",
        "subprocess.check_output(['a'], text=True)",
        "process.communicate('quit')",
        "process.wait()",
        "thread.join()",
        "with subprocess.Popen(['a']) as program: pass",
    ],
)
def test_what_may_wait_for_ever_is_seen(text):
    assert endless(ast.parse(text)) == [1]


@pytest.mark.parametrize(
    "text", ["subprocess.run(['a'], timeout=3)", "process.wait(3)", "', '.join(names)", "thread.join(30)"]
)
def test_what_ends_is_let_pass(text):
    assert endless(ast.parse(text)) == []


def test_every_test_has_a_time_out():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pytest"]["ini_options"]
    assert options["timeout"] > 0
    assert "--strict-config" in options["addopts"], "or an unknown `timeout` would say nothing"
    off = [f for f in FILES if "mark.timeout(0)" in f.read_text("utf-8") and f != Path(__file__)]
    assert not off


def test_every_wait_for_a_program_or_a_thread_has_a_time_out():
    found = [
        f"{file.relative_to(ROOT)}:{line}"
        for file in FILES
        for line in endless(ast.parse(file.read_text("utf-8")))
    ]
    assert not found
