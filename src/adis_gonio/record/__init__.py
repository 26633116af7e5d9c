"""Sessions on disk: the archive, samples files, plans, and corrections of a file's metadata.

A name is imported when it is first used, so that importing the package itself takes no time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "loading": "Overrides load_session",
    "plans": "plan",
    "source": "Settings",
}


if TYPE_CHECKING:
    from adis_gonio.record.loading import Overrides as Overrides, load_session as load_session
    from adis_gonio.record.plans import plan as plan
    from adis_gonio.record.source import Settings as Settings

__getattr__ = lazily(__name__, _HOMES)
