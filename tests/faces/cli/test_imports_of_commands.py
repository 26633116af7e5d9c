"""A command imports the libraries that it needs, and no library that takes longer than its work."""

import importlib
import io
import json
import py_compile
import subprocess
import sys
from pathlib import Path

import pytest

from adis_gonio.faces import cli
from programs import LONGEST_S

PROGRAM = """
import json, sys
from adis_gonio.faces.cli import main

status = main(sys.argv[1:])
print(json.dumps(sorted(sys.modules)), file=sys.stderr)
sys.exit(status)
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("imports") / "turns.session"
    line = ["calibrate", "sim:?seed=1", "--plan", "tumble", "--positions", "9", "--auto", "--dwell", "1"]
    assert cli.main([*line, "-o", str(path)]) == 0
    return path


def imported_by(*arguments: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        capture_output=True,
        text=True,
        check=True,
        timeout=LONGEST_S,
    )
    return set(json.loads(done.stderr.splitlines()[-1]))


def test_fit_imports_neither_statistics_nor_optimizers_nor_the_trace(session: Path) -> None:
    modules = imported_by("fit", str(session))
    assert "scipy.special" in modules  # the fit did run
    heavy = {
        "scipy.stats",
        "scipy.linalg",
        "scipy.optimize",
        "scipy.signal",
        "scipy.spatial",
        "matplotlib",
        "jinja2",
    }
    assert not heavy & modules
    assert "adis_gonio.tracing.trace" not in modules


def test_report_imports_no_statistics_and_no_signal_processing(session: Path, tmp_path: Path) -> None:
    modules = imported_by("report", str(session), "-o", str(tmp_path / "page.html"))
    assert "adis_gonio.tracing.trace" in modules
    assert not {"scipy.stats", "scipy.signal"} & modules


def test_a_truncated_compiled_module_is_no_stop_by_the_operator(tmp_path, monkeypatch, capsys):
    source = tmp_path / "module_that_was_cut.py"
    source.write_text("NUMBERS = (1, 2, 3)\n", encoding="utf-8")
    compiled = Path(str(py_compile.compile(str(source))))
    compiled.write_bytes(compiled.read_bytes()[:-20])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(cli.app, "get_command", lambda *_: importlib.import_module(source.stem))
    assert cli.main(["plan"]) == 1
    assert capsys.readouterr().err.strip() == f"adis-gonio: {compiled}: damaged; delete this file"
    monkeypatch.setattr(cli.app, "get_command", lambda *_: input())
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert cli.main(["plan"]) == 130, "the end of input is a stop"
    # Without the file the module is compiled again.
    compiled.unlink()
    assert importlib.import_module(source.stem).NUMBERS == (1, 2, 3)
