"""The plugin: nothing is imported that nobody asked for, and mistakes in a mark fail in one line."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from adis_gonio.sim import testing

ROOT = Path(__file__).resolve().parents[3]


def run(folder: Path, text: str, *arguments: str) -> subprocess.CompletedProcess:
    """pytest in a folder of its own, with this plugin and no other."""
    (folder / "test_it.py").write_text(text)
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers\n")
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "adis_gonio.sim.testing.plugin", *arguments],
        cwd=folder,
        env={
            **os.environ,
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
            "PYTHONPATH": str(Path(testing.__file__).parents[3]),
        },
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def test_pytest_without_a_use_imports_neither_numpy_nor_the_driver(tmp_path):
    done = run(
        tmp_path,
        "import sys\n"
        "def test_it():\n"
        "    heavy = [m for m in sys.modules if m.split('.')[0] in ('numpy', 'scipy', 'rich', 'click')]\n"
        "    own = sorted(m for m in sys.modules if m.startswith('adis_gonio'))\n"
        "    assert heavy == []\n"
        "    names = 'base sim sim.testing sim.testing.plugin'.split()\n"
        "    assert own == ['adis_gonio', *(f'adis_gonio.{name}' for name in names)]\n",
    )
    assert done.returncode == 0, done.stdout


def test_the_package_without_pytest_has_its_doubles_all_the_same():
    code = (
        "import sys; sys.modules['pytest'] = None\n"
        "from adis_gonio.sim.testing import FaultyBus, Faults, open_board, open_simulated\n"
        "open_simulated().close()"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


def test_the_wheel_names_the_plugin():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["entry-points"]["pytest11"] == {"adis-gonio": "adis_gonio.sim.testing.plugin"}
    assert not any("pytest" in need for need in project["dependencies"])


def test_every_public_name_is_there():
    for name in testing.__all__:
        assert getattr(testing, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'BusContrast'"):
        testing.BusContrast  # noqa: B018


@pytest.mark.parametrize(
    ("mark", "says"),
    [
        ("url='serial:'", "a test double is simulated; give a URL such as sim:?seed=1"),
        ("url='sim:?delta=1'", "delta"),
        ("ulr='sim:'", "has no 'ulr'; did you mean 'url'?"),
        ("wings=2", "has no 'wings'; known: url, check,"),
        ("'sim:?seed=3'", "takes names, such as url='sim:?seed=3'"),
    ],
)
def test_a_mistake_in_a_mark_fails_in_one_line(tmp_path, mark, says):
    text = f"import pytest\n@pytest.mark.adis_gonio({mark})\ndef test_it(simulated_sensor): pass\n"
    done = run(tmp_path, text)
    assert done.returncode == 1
    assert says in done.stdout
    assert "Traceback" not in done.stdout
    assert "plugin.py" not in done.stdout


def test_the_mark_and_the_fixtures_explain_themselves(tmp_path):
    shown = run(tmp_path, "", "--markers").stdout
    assert "@pytest.mark.adis_gonio(url, check, faults, boot_s)" in shown
    fixtures = run(tmp_path, "", "--fixtures").stdout
    assert "simulated_sensor" in fixtures
    assert "driver of a simulated chip" in fixtures
