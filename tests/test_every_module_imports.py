"""Every module can be imported first: none leans on the order in which others were."""

import pkgutil
import subprocess
import sys

import adis_gonio


def test_every_package_can_be_imported_first() -> None:
    names = [
        m.name
        for m in pkgutil.walk_packages(adis_gonio.__path__, "adis_gonio.")
        if "__main__" not in m.name
    ]
    assert len(names) > 100
    program = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    for known in [k for k in sys.modules if k.startswith('adis_gonio')]:\n"
        "        del sys.modules[known]\n"
        "    importlib.import_module(name)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *names], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
