"""Sessions on disk: the archive, samples files, plans, and corrections of a file's metadata.

A name is imported when it is first used, so that importing the package itself takes no time.
"""

from adis_gonio.base import lazily

_HOMES = {
    "loading": "Overrides load_session",
    "plans": "plan",
    "source": "Settings",
}

__getattr__ = lazily(__name__, _HOMES)
