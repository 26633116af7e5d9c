"""The tests that docs/simulator.md shows under *Test doubles* pass as printed."""

import os
import re
import subprocess
import sys
from pathlib import Path

from adis_gonio.sim.testing.plugin import OPTIONS

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "simulator.md").read_text("utf-8").partition("## Test doubles")[2]
BLOCK = re.compile(r"^```python\n# (test_\w+\.py)\n(.*?)^```$", re.M | re.S)


def test_the_blocks_pass(tmp_path):
    blocks = BLOCK.findall(PAGE)
    assert len(blocks) == PAGE.count("```python") == 5
    for name, text in blocks:
        (tmp_path / name).write_text(text, "utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers\nfilterwarnings = error\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "adis_gonio.sim.testing.plugin", "."],
        cwd=tmp_path,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        timeout=1200,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.findall(r"(\d+) passed", done.stdout)[0]) > 45


def test_the_page_names_what_the_mark_takes():
    assert f"adis_gonio({', '.join(name + '=' for name in OPTIONS)})" in PAGE
