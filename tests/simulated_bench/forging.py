"""A stranger at the disk of the bench: changes the session file between two commands.

The changes are those of `record.strange_files`; checksums fit, so that only the checks of values and of the
schema can refuse them.
"""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

from record.strange_files import KINDS, SoundFiles

FORGERIES = {f"forged {name}": make for name, (family, _, make) in KINDS.items() if family == "session"}
"""Functions that change a session file, by the command of their step."""


def forge(path: Path, kind: str, draw: int) -> str:
    """Change a session file in place, by a key of `FORGERIES`; return a description of the change."""
    with tempfile.TemporaryDirectory(dir=path.parent.parent) as folder:
        target = Path(folder) / path.name
        what = FORGERIES[kind](SoundFiles([path], [], [], []), target, random.Random(draw))
        for made in Path(folder).glob(f"{path.name}*"):
            made.replace(path.parent / made.name)
    return f"{kind.removeprefix('forged session ')}: {what[:200]!r}"
