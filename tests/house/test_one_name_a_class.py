"""A reader who has met a class knows what its name means in every other room of the package."""

from __future__ import annotations

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "src" / "adis_gonio"

HARMLESS = {
    "Answer": (
        {"fitting.answer", "bench.bringup.bringup_step"},
        "both are public names of their package: what a session says, what a board says of a question",
    ),
}
"""Names that two public classes may share: the modules that do, and why nobody stumbles."""


def public_classes(text: str) -> list[str]:
    """Names of the public classes at the top of a module, under a condition too."""
    found, level = [], list(ast.parse(text).body)
    while level:
        node = level.pop(0)
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            found.append(node.name)
        elif isinstance(node, ast.If | ast.Try):
            level += [*node.body, *node.orelse, *getattr(node, "finalbody", [])]
    return found


@cache
def homes() -> dict[str, set[str]]:
    """Modules that define a public class, by its name."""
    found: dict[str, set[str]] = defaultdict(set)
    for path in sorted(SOURCE.rglob("*.py")):
        module = ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        for name in public_classes(path.read_text("utf-8")):
            found[name].add(module)
    return found


def test_no_two_public_classes_share_a_name():
    shared = {name: modules for name, modules in homes().items() if len(modules) > 1}
    assert {name: modules for name, modules in shared.items() if name not in HARMLESS} == {}


@pytest.mark.parametrize("name", HARMLESS)
def test_a_name_that_may_be_shared_is_shared_by_these_modules_only(name):
    modules, reason = HARMLESS[name]
    assert homes()[name] == modules
    assert reason


def test_classes_are_seen_where_they_stand():
    text = (
        "class A: ...\nclass _B: ...\nif x:\n    class C:\n        class D: ...\nelse:\n    class E: ...\n"
    )
    assert public_classes(text) == ["A", "C", "E"]
    assert len(homes()) > 300
    assert homes()["Session"] == {"model.records"}
