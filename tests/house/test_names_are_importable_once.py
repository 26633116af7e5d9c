"""No module has two meanings on the path that the tests have.

A folder of tests without `__init__.py` gives way to any module of its name elsewhere on the path, so
that `from population.units import …` fails or not by the order in which files are collected.
"""

import tomllib
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["pytest"]["ini_options"][
    "pythonpath"
]


def names(folder):
    inside = [path for path in folder.iterdir() if path.suffix == ".py" or any(path.glob("*.py"))]
    return sorted({path.stem for path in inside} - {"__init__", "__main__", "conftest"})


@pytest.mark.parametrize("folder", SOURCES)
def test_a_name_stands_in_one_folder_of_the_path(folder):
    count = Counter(name for source in SOURCES for name in names(ROOT / source))
    assert [name for name in names(ROOT / folder) if count[name] > 1] == []


@pytest.mark.parametrize("folder", SOURCES)
def test_a_name_hides_no_installed_package(folder):
    for name in names(ROOT / folder):
        found = find_spec(name)
        assert found is not None
        places = [found.origin, *(found.submodule_search_locations or [])]
        assert any(place and Path(place).is_relative_to(ROOT / folder) for place in places), (name, places)
