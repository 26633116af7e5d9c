"""`python -m blind_residual.tune NAME…`: the peers' settings, from a training set.

Of each runner the limit of the gain is chosen that is best on the training sessions: right sets of one
catalogued effect less five times what was claimed where nothing is hidden.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from . import answers, scoring
from .generator import draw
from .harness import blind
from .runners import common, runner

SECRET = "tune"
SESSIONS = 25
"""Of each family."""
GRID = (8.0, 10.0, 12.0, 14.0, 17.0, 20.0)
FAMILIES = ("nothing", "catalogue")


def worth(name: str, settings: dict[str, float], folders: list[tuple[Path, scoring.Truth]]) -> float:
    """Right sets less five times false claims."""
    common.OVERRIDE[name] = settings
    right, false, shown, quiet = 0.0, 0, 0, 0
    for folder, truth in folders:
        record = scoring.score(truth, answers.checked(runner(name)(folder)))
        if truth.family == "nothing":
            quiet, false = quiet + 1, false + record["false"]
        else:
            shown, right = shown + 1, right + record["right_set"]
    return right / max(shown, 1) - 5 * false / max(quiet, 1)


def main(names: list[str]) -> None:
    """Tune runners and write tuned.json."""
    path = Path(common.__file__).parent / "tuned.json"
    settings = json.loads(path.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as temporary:
        folders = []
        for number in range(SESSIONS):
            for family in FAMILIES:
                csv, truth = draw(f"{SECRET} {family}", number, family)
                folder = Path(temporary) / f"{family}{number}"
                folder.mkdir()
                (folder / "session.csv").write_text(blind(csv), encoding="utf-8")
                folders.append((folder, truth))
        for name in names:
            tried = {gain: worth(name, settings[name] | {"gain": gain}, folders) for gain in GRID}
            settings[name]["gain"] = max(tried, key=lambda gain: (tried[gain], -gain))
            print(name, {k: round(v, 3) for k, v in tried.items()}, "→", settings[name])
            path.write_text(json.dumps(settings, indent=2, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
