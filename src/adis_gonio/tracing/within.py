"""Second pass: what the samples inside the dwells show."""

from __future__ import annotations

from dataclasses import dataclass, field

from adis_gonio.model.records import Session
from adis_gonio.tracing.result import Detectable, Finding


@dataclass(frozen=True)
class Inside:
    """What the samples show."""

    found: tuple[Finding, ...] = ()
    lines: tuple[str, ...] = ()
    detectable: dict[str, Detectable] = field(default_factory=dict)


def look_within(session: Session) -> Inside | None:
    """None where no dwell has samples enough."""
    del session
    return None
