"""The history of a sensor over its sessions, and the date of its next calibration.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "Due": "intervals_due",
    "History": "history",
    "Rules": "intervals_due",
    "due_of": "intervals_due",
    "history_of": "history",
}

__all__ = ["Due", "History", "Rules", "due_of", "history_of"]

if TYPE_CHECKING:
    from adis_gonio.fleet.memory.history import History as History
    from adis_gonio.fleet.memory.history import history_of as history_of
    from adis_gonio.fleet.memory.intervals_due import Due as Due
    from adis_gonio.fleet.memory.intervals_due import Rules as Rules
    from adis_gonio.fleet.memory.intervals_due import due_of as due_of


__getattr__ = lazily(__name__, _HOMES)
