"""Sessions: plans, the live session without a screen, the archive, files in and out.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

_HOMES = {
    "Archive": "archive",
    "Overrides": "overrides",
    "Plan": "plans",
    "Position": "plans",
    "SessionRunner": "runner",
    "Settings": "settings",
    "events": "",
    "export_csv": "export",
    "export_json": "export",
    "load_session": "loading",
    "plan": "plans",
    "read_session": "archive",
}

__all__ = [
    "Archive",
    "Overrides",
    "Plan",
    "Position",
    "SessionRunner",
    "Settings",
    "events",
    "export_csv",
    "export_json",
    "load_session",
    "plan",
    "read_session",
]

if TYPE_CHECKING:
    from adis_gonio.session import events as events
    from adis_gonio.session.archive import Archive as Archive
    from adis_gonio.session.archive import read_session as read_session
    from adis_gonio.session.export import export_csv as export_csv
    from adis_gonio.session.export import export_json as export_json
    from adis_gonio.session.loading import load_session as load_session
    from adis_gonio.session.overrides import Overrides as Overrides
    from adis_gonio.session.plans import Plan as Plan
    from adis_gonio.session.plans import Position as Position
    from adis_gonio.session.plans import plan as plan
    from adis_gonio.session.runner import SessionRunner as SessionRunner
    from adis_gonio.session.settings import Settings as Settings


def __getattr__(name: str) -> Any:
    """Import a public name from its home when it is first asked for (PEP 562)."""
    if name in _HOMES:
        import importlib

        home = _HOMES[name]
        module = importlib.import_module(f"{__name__}.{home or name}")
        value = getattr(module, name) if home else module
        globals()[name] = value
        return value
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
