"""The screen in each state, as text, against stored lines; and what must hold in all of them.

After an intended change, `WRITE_SNAPSHOTS=1 pytest tests/faces/tui/test_screen_states.py` writes the lines
again: look at the difference before you commit it. `PICTURES=folder` also draws each state as SVG.
"""

import os
from pathlib import Path

import pytest

pytest.importorskip("textual", reason="the extra 'bench' is not installed")

from faces.tui.screens import shown
from faces.tui.states import STATES

SIZES = [(80, 24), (120, 40)]
SNAPSHOTS = Path(__file__).parent / "snapshots"


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", STATES)
def test_each_state_looks_as_it_was_judged(name, size):
    script, keys = STATES[name]
    pictures = os.environ.get("PICTURES")
    label = f"{name}_{size[0]}x{size[1]}"
    picture = Path(pictures) / f"{label}.svg" if pictures else None
    text, _, _ = shown(script, size=size, keys=keys, picture=picture)
    stored = SNAPSHOTS / f"{label}.txt"
    if os.environ.get("WRITE_SNAPSHOTS"):
        stored.write_text(text, "utf-8")
    lines = text.splitlines()
    assert len(lines) == size[1]
    assert max(map(len, lines)) <= size[0]
    assert text == stored.read_text("utf-8"), "see the module's text"
