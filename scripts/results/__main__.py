"""Measure the sections of docs/results/ again: JSON and SVG, from simulated sessions, and the page.

    python scripts/results                       # all sections, a fresh seed; takes hours
    python scripts/results paper angle           # only these
    python scripts/results --fast -o /tmp/out    # a small part of each, as CI does

Each document has the command and the seed that make it again.
"""

from __future__ import annotations

import argparse
import importlib
import json
import secrets
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from results import SECTIONS
from results.page import render
from results.section import Effort, Section

FOLDER = Path(__file__).parents[2] / "docs" / "results"


def write(name: str, section: Section, effort: Effort, folder: Path) -> None:
    """Write one section's files."""
    command = f"python scripts/results {name} --seed {effort.seed}" + " --fast" * effort.fast
    document = {"command": command, **section.document}
    text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
    (folder / f"{name}.json").write_text(text, encoding="utf-8")
    for figure, svg in section.figures.items():
        (folder / f"{name}-{figure}.svg").write_text(svg, encoding="utf-8")


def main() -> int:
    """Make the sections asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--fast", action="store_true", help="a small part of each section")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1, help="processes at most")
    parser.add_argument("-o", "--output", type=Path, default=FOLDER)
    options = parser.parse_args()
    unknown = sorted(set(options.sections) - set(SECTIONS))
    if unknown:
        parser.error(f"no section {', '.join(unknown)}; there are {', '.join(SECTIONS)}")
    options.output.mkdir(parents=True, exist_ok=True)
    effort = Effort(options.fast, options.seed, options.jobs)
    for name in options.sections or SECTIONS:
        write(name, importlib.import_module(f"results.{name}").run(effort), effort, options.output)
        print(f"{name}: written to {options.output}")
    (options.output / "index.md").write_text(render(options.output), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
