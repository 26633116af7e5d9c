"""Tests use the package as its users do: by its public names."""

import ast

from levels import TESTS


def private_imports(source: str) -> list[str]:
    """Names with an underscore in front that are imported from the package."""
    return [
        f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("adis_gonio")
        for alias in node.names
        if alias.name.startswith("_") and not alias.name.startswith("__")
    ]


def test_no_test_imports_a_private_name():
    found = {path.name: private_imports(path.read_text("utf-8")) for path in TESTS.rglob("*.py")}
    assert {name: names for name, names in found.items() if names} == {}


def test_a_private_import_is_seen():
    assert private_imports("def f():\n    from adis_gonio.a import b, _c\n") == ["adis_gonio.a._c"]
