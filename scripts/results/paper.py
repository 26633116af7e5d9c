"""The seed paper reproduced: its table, its figure, and where its method overtakes MMPM."""

from __future__ import annotations

import re
from collections.abc import Iterator

from adis_gonio.handover.paper import reproduce
from adis_gonio.handover.paper.page import figures_3, map_figures, sections
from adis_gonio.page.document import Section as Part
from adis_gonio.page.document import Table
from results.section import Effort, Section


def run(effort: Effort) -> Section:
    """Make the section."""
    done = reproduce(
        effort.seed,
        effort.sessions(20, 2),
        effort.jobs,
        **({"draws": 200} if effort.fast else {}),
    )
    drawn = {name.replace("_", "-"): one for name, one in {**figures_3(done), **map_figures(done)}.items()}
    names = {svg: name for name, (svg, _) in drawn.items()}
    # Each part of the sessions is in the document of the command: here it would be a megabyte.
    document = {key: value for key, value in done.as_dict().items() if key not in ("parts", "command")}
    document["of_the_command"] = f"{done.command} --json"
    lines = [line for part in sections(done) for line in _markdown(part, names, 2)]
    return Section(
        "The seed paper reproduced",
        "\n".join(lines),
        document,
        {name: svg for name, (svg, _) in drawn.items()},
    )


def _markdown(part: Part, names: dict[str, str], level: int) -> Iterator[str]:
    """A section of the page as lines of Markdown."""
    yield from (f"{'#' * level} {_text(part.title)}", "")
    for word in part.words:
        yield from (_text(word), "")
    if part.points:
        yield from ("```sh", *part.points, "```", "")
    for figure in part.figures:
        yield from (f"![{_text(figure.caption)}](paper-{names[figure.svg]}.svg)", "")
        yield from (f"*{_text(figure.caption)}*", "")
    for table in part.tables:
        yield from _table(table)
    for note in part.notes:
        command = re.fullmatch(r"Command: (adis-gonio [^(]*?)( \(.*\))?", note)
        yield from (f"Command: `{command[1]}`{command[2] or ''}" if command else _text(note), "")
    for inner in part.parts:
        yield from _markdown(inner, names, level + 1)


def _table(table: Table) -> Iterator[str]:
    sides = ["---:" if k in table.numeric else "---" for k in range(len(table.head))]
    for cells in (table.head, sides, *table.rows):
        yield "| " + " | ".join(_text(cell) if cell not in sides else cell for cell in cells) + " |"
    yield ""
    if table.caption:
        yield from (f"*{_text(table.caption)}*", "")


def _text(text: str) -> str:
    """Text in which nothing is markup."""
    return re.sub(r"([*_`|<>$])", r"\\\1", " ".join(text.split()))
