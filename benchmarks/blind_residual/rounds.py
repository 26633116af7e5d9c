"""The page of the sealed rounds, ROUNDS.md, from rounds/*.json.

python -m blind_residual.rounds            # writes the page
python -m blind_residual.rounds --check    # exit 1 if the page is out of date
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE / "ROUNDS.md"
SHOWN = ("oracle", "adis_gonio", "susie", "stepwise")
HEAD = """\
# Sealed rounds of the blind residual challenge

<!-- written by benchmarks/blind_residual/rounds.py from rounds/*.json: change it there -->

300 sessions per round. The SHA-256 of each secret was published before its sessions were made. All tables,
also of the other entrants, are in `rounds/N.json`; [the challenge](README.md) explains the columns.
`adis_gonio` is `trace` of its time. Intervals are Wilson's, 95 %. † sees the check dwells and states its
own error on them.
"""
COLUMNS = (
    "right set (gain ≥ 16)",
    "something false (nothing hidden)",
    "wrong name",
    "wrong at > 95 %",
    "covariate, no name",
    "left out ÷ oracle's",
)
LIMITS = """\
## Read the rounds

- Most right names are found: at a gain of 16 or more 78 to 93 % of those that the oracle finds.
- Nothing is invented if nothing is hidden: 1 of the sessions of the last two rounds.
- Wrong names are the weak point: 10 % of the sessions, 2 % for the oracle, who knows the form of every
  stranger. A stranger and a name explain equal readings at a moderate gain. Half the prior share of an
  effect halves the wrong names and costs a tenth of the right ones.
- At more than 95 % probability, 2 of 300 sessions of the sixth round have a wrong name; the oracle has 3.
- If there is only scatter, a cause is claimed in 13 of 28 sessions of the sixth round (oracle 3).
"""


def _table(document: dict[str, Any], title: str) -> dict[str, Any]:
    (found,) = [one for one in document["tables"] if one["title"].startswith(title)]
    table: dict[str, Any] = found["tables"][0]
    return table


def _rows(document: dict[str, Any]) -> list[str]:
    table = _table(document, "All kinds")
    places = [table["head"].index(column) for column in COLUMNS]
    rows = {row[0]: [row[k] for k in places] for row in table["rows"]}
    return [
        f"| {document['round']} | {name} | {' | '.join(rows[name])} |" for name in SHOWN if name in rows
    ]


def _by_gain(document: dict[str, Any]) -> list[str]:
    table = _table(document, "Right names by gain")
    rows = {row[0]: row[1:] for row in table["rows"]}
    return [
        f"| {document['round']} | {name} | {' | '.join(cell.split(', ')[1] for cell in rows[name])} |"
        for name in SHOWN[:3]
        if name in rows
    ]


def render() -> str:
    """The page."""
    documents = [json.loads(path.read_text("utf-8")) for path in sorted((HERE / "rounds").glob("*.json"))]
    latest = documents[-1]
    gains = _table(latest, "Right names by gain")["head"][1:]
    parts = [HEAD, f"| round | entrant | {' | '.join(COLUMNS)} |", "|---" * (2 + len(COLUMNS)) + "|"]
    parts += [row for document in documents for row in _rows(document)]
    parts += ["", "## Right names by gain", ""]
    parts += [
        "A set that contains the true name, in sessions of the catalogue; every true name counts.",
        "",
    ]
    parts += [f"| round | entrant | {' | '.join(gains)} |", "|---" * (2 + len(gains)) + "|"]
    parts += [row for document in documents[-2:] for row in _by_gain(document)]
    parts += ["", LIMITS, "## Secrets", "", "| round | secret | note |", "|---|---|---|"]
    parts += [f"| {one['round']} | `{one['secret']}` | {one['note']} |" for one in documents]
    return "\n".join([*parts, ""])


def main() -> int:
    """Write or check the page."""
    if "--check" in sys.argv[1:]:
        return int(PAGE.read_text("utf-8") != render())
    PAGE.write_text(render(), encoding="utf-8")
    print(f"wrote {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
