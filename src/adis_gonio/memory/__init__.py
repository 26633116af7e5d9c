"""A memory for many sensors: what was found of each session, over time and over units.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

_HOMES = {"FoundEffect": "record", "SessionRecord": "record", "record_of": "record"}

__all__ = ["FoundEffect", "SessionRecord", "record_of"]

if TYPE_CHECKING:
    from adis_gonio.memory.record import FoundEffect as FoundEffect
    from adis_gonio.memory.record import SessionRecord as SessionRecord
    from adis_gonio.memory.record import record_of as record_of


def __getattr__(name: str) -> Any:
    """Import a public name from its home when it is first asked for (PEP 562)."""
    if name in _HOMES:
        import importlib

        value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
