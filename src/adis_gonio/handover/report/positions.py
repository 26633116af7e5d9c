"""The section of positions that are not where they were declared; none where all are."""

from __future__ import annotations

from collections.abc import Sequence

from adis_gonio.base.numbers import DASH, format_percent, format_uncertain, use_minus
from adis_gonio.fitting.slips import PositionFinding
from adis_gonio.fitting.slips.finding import Angle
from adis_gonio.page.document import Section, Table

_HEAD = ("position", "declared", "by gravity", "by the gyro", "found", "how sure")


def positions(findings: Sequence[PositionFinding]) -> list[Section]:
    """Table of the three angles of each accused position, and what to do."""
    if not findings:
        return []
    rows = [
        [
            str(found.position),
            DASH if found.declared_deg is None else use_minus(f"{found.declared_deg:g}°"),
            _angle(found.gravity_deg),
            _angle(found.gyro_deg),
            ", ".join(dict.fromkeys(named.name.replace("_", " ") for named in found.names)),
            format_percent(found.probability),
        ]
        for found in findings
    ]
    said = list(dict.fromkeys(found.sentence for found in findings))
    table = Table(_HEAD, rows, numeric=(1, 2, 3, 5), caption="Angles with their standard uncertainties.")
    return [Section("Positions that are not right", words=said, tables=[table])]


def _angle(angle: Angle | None) -> str:
    return DASH if angle is None else format_uncertain(*angle, "deg")
