"""Every test has one level, and the tests of a quick run use every package."""

import ast
from pathlib import PurePosixPath

from house.test_floors import floors
from levels import LEVELS, ORDER, SLOW, TESTS, is_quick, level_of


def files_of_tests() -> list[PurePosixPath]:
    return sorted(PurePosixPath(path.relative_to(TESTS).as_posix()) for path in TESTS.rglob("test_*.py"))


def packages_imported(file: PurePosixPath) -> set[str]:
    """Packages of the house that a test file imports by name."""
    names: list[str] = []
    for node in ast.walk(ast.parse((TESTS / file).read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and not node.level:
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    parts = [name.split(".") for name in names]
    return {part[1] for part in parts if part[0] == "adis_gonio" and len(part) > 1}


def test_every_test_that_was_collected_has_one_level(request):
    assert request.session.items
    for item in request.session.items:
        if item.path.is_relative_to(TESTS):
            assert len([mark for mark in item.iter_markers() if mark.name in ORDER]) == 1, item.nodeid


def test_every_file_has_a_level_and_every_row_of_the_table_has_files():
    assert set(ORDER) == set(LEVELS)
    rows = [row for entries in LEVELS.values() for row in entries]
    assert len(rows) == len(set(rows))
    files = files_of_tests()
    assert {level_of(file) for file in files} == set(LEVELS)
    assert [row for row in [*rows, *SLOW] if not (TESTS / row).exists()] == []
    assert [row for row in SLOW if level_of(PurePosixPath(row)) != "unit"] == []


def test_the_quick_tests_use_every_package():
    used = {package for file in files_of_tests() if is_quick(file) for package in packages_imported(file)}
    assert set(floors()) <= used
