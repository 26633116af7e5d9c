"""A session on disk: the archive, samples files, plans, corrections of metadata.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "Archive": "archive",
    "Overrides": "loading",
    "Plan": "plans",
    "Position": "plans",
    "Settings": "settings",
    "export_csv": "samples_writer",
    "export_json": "samples_writer",
    "load_session": "loading",
    "plan": "plans",
    "read_session": "session_reader",
}

__all__ = [*sorted(_HOMES)]  # noqa: PLE0604 (all are strings)

if TYPE_CHECKING:
    from adis_gonio.record.archive import Archive as Archive
    from adis_gonio.record.loading import Overrides as Overrides
    from adis_gonio.record.loading import load_session as load_session
    from adis_gonio.record.plans import Plan as Plan
    from adis_gonio.record.plans import Position as Position
    from adis_gonio.record.plans import plan as plan
    from adis_gonio.record.samples_writer import export_csv as export_csv
    from adis_gonio.record.samples_writer import export_json as export_json
    from adis_gonio.record.session_reader import read_session as read_session
    from adis_gonio.record.settings import Settings as Settings

__getattr__ = lazily(__name__, _HOMES)
