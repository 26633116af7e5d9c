"""A memory for many sensors: what was found of each session, over time and over units.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base.lazy_names import lazily

_HOMES = {
    "Due": "intervals_due",
    "FoundEffect": "record",
    "History": "history",
    "Index": "index",
    "Rules": "intervals_due",
    "SessionRecord": "record",
    "Summary": "summary",
    "due_of": "intervals_due",
    "history_of": "history",
    "record_of": "record",
    "summarised": "summary",
}

__all__ = [
    "Due",
    "FoundEffect",
    "History",
    "Index",
    "Rules",
    "SessionRecord",
    "Summary",
    "due_of",
    "history_of",
    "record_of",
    "summarised",
]

if TYPE_CHECKING:
    from adis_gonio.fleet.memory.history import History as History
    from adis_gonio.fleet.memory.history import history_of as history_of
    from adis_gonio.fleet.memory.index import Index as Index
    from adis_gonio.fleet.memory.intervals_due import Due as Due
    from adis_gonio.fleet.memory.intervals_due import Rules as Rules
    from adis_gonio.fleet.memory.intervals_due import due_of as due_of
    from adis_gonio.fleet.memory.record import FoundEffect as FoundEffect
    from adis_gonio.fleet.memory.record import SessionRecord as SessionRecord
    from adis_gonio.fleet.memory.record import record_of as record_of
    from adis_gonio.fleet.memory.summary import Summary as Summary
    from adis_gonio.fleet.memory.summary import summarised as summarised


__getattr__ = lazily(__name__, _HOMES)
