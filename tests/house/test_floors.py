"""The packages stand on floors: each imports only packages below it."""

import tomllib
from pathlib import Path

from importlinter.application.use_cases import read_user_options
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "adis_gonio"


def floors() -> list[str]:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    (contract,) = config["contracts"]
    return contract["layers"]


def test_every_package_has_a_floor_of_its_own():
    packages = {path.parent.name for path in SOURCE.glob("*/__init__.py")}
    assert packages == set(floors())
    assert len(packages) <= 15


def test_no_import_runs_upwards(monkeypatch):
    monkeypatch.chdir(ROOT)
    options = read_user_options(str(ROOT / "pyproject.toml"))
    assert len(options.contracts_options) == 1
    assert not options.contracts_options[0].get("ignore_imports")
    assert lint_imports(str(ROOT / "pyproject.toml"), no_cache=True) == 0
