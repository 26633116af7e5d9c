"""The smoothed angle on the pages: the example gives its angle, the tables are those of the program."""

import contextlib
import io
import re
from pathlib import Path

import pytest

from adis_gonio.faces.cli.live_commands import NOTES
from adis_gonio.live.live_angle import Smoothed

DOCS = Path(__file__).parents[2] / "docs"
TABLES = (DOCS / "files.md").read_text("utf-8").partition("## JSON of angle")[2].partition("\n## ")[0]


def test_the_example_gives_the_angle_that_it_says():
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "python.md").read_text("utf-8"), re.S)
    (block,) = (text for text in blocks if "AngleSmoother(" in text)
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        exec(compile(block, "python.md", "exec"), {})
    angle_deg, u_deg = map(float, shown.getvalue().split())
    assert 0 < u_deg < 0.5
    assert angle_deg == pytest.approx(46, abs=4 * u_deg)


def test_every_key_and_every_note_has_its_row():
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", TABLES, re.M)
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert named == {*Smoothed.__dataclass_fields__, *NOTES}
