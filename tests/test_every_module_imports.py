"""Every module can be imported first: none leans on the order in which others were.

One program imports them all and watches each import statement. If no statement meets a module whose own
import has not ended, there is no circle. If also every import is `from … import …`, which runs a module
before it is used, the order in which modules are imported changes nothing.
"""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
PROGRAM = """
import builtins, importlib, json, pkgutil, sys

package = sys.argv[1]
run, unfinished, names = builtins.__import__, [], []

def under_way(name):
    return getattr(getattr(sys.modules.get(name), "__spec__", None), "_initializing", False)

def watch(name, globals=None, locals=None, fromlist=(), level=0):
    wanted = [name, *(f"{name}.{part}" for part in fromlist or ())]
    met = [one for one in wanted if one.startswith(package) and under_way(one)]
    made = run(name, globals, locals, fromlist, level)
    # A package that is being imported may give its own modules: Python imports them on the way.
    if met and (met != [name] or not all(f"{name}.{part}" in sys.modules for part in fromlist or [""])):
        unfinished.append([globals["__name__"], met])
    return made

builtins.__import__ = watch
for module in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
    if "__main__" not in module.name:
        importlib.import_module(module.name)
        names.append(module.name)
print(json.dumps([names, unfinished]))
"""


def imported(package: str, folder: Path) -> tuple[list[str], list[list[object]]]:
    """Names of all modules of a package, and what each imported while it was being imported itself."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, package],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    names, unfinished = json.loads(done.stdout)
    return names, unfinished


def test_no_module_imports_one_whose_own_import_has_not_ended() -> None:
    names, unfinished = imported("adis_gonio", SOURCE)
    assert len(names) > 100
    assert unfinished == []


def test_every_import_runs_the_module_before_it_is_used() -> None:
    plain = [
        f"{path.relative_to(SOURCE)}:{node.lineno}"
        for path in sorted(SOURCE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.name.startswith("adis_gonio")
    ]
    assert plain == []


@pytest.mark.parametrize(
    ("first", "second", "circle"),
    [
        ("from made_up.b import B", "B = 1", False),
        ("from made_up import b", "B = 1", False),
        ("from made_up.b import B", "from made_up import a\nB = 1", True),
        ("from made_up.b import B", "import made_up.a\nB = 1", True),
        ("from made_up import b", "from made_up import VALUE", True),
    ],
)
def test_a_circle_is_seen(tmp_path: Path, first: str, second: str, circle: bool) -> None:
    package = tmp_path / "made_up"
    package.mkdir()
    head = "VALUE = 1\nfrom made_up.a import *\n" if "VALUE" in second else ""
    for name, text in (("__init__", head), ("a", first), ("b", second)):
        (package / f"{name}.py").write_text(text + "\n")
    names, unfinished = imported("made_up", tmp_path)
    assert names == ["made_up.a", "made_up.b"]
    assert bool(unfinished) == circle
