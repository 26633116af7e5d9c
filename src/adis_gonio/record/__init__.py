"""Sessions on disk: the archive, samples files, plans, and corrections of a file's metadata.

A name is imported when it is first used, so that importing the package itself takes no time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "archive": "Archive",
    "loading": "Overrides load_session",
    "plans": "Plan Position plan",
    "samples_writer": "write_samples_csv",
    "session_reader": "read_session",
    "source": "Settings",
}


if TYPE_CHECKING:
    from adis_gonio.record.archive import Archive as Archive
    from adis_gonio.record.loading import Overrides as Overrides, load_session as load_session
    from adis_gonio.record.plans import Plan as Plan, Position as Position, plan as plan
    from adis_gonio.record.samples_writer import write_samples_csv as write_samples_csv
    from adis_gonio.record.session_reader import read_session as read_session
    from adis_gonio.record.source import Settings as Settings

__getattr__ = lazily(__name__, _HOMES)
