"""Work at the bench: the guided session, bring-up of a board, write-back of offsets, IIO sensors.

A name is imported when it is first used, so that importing the package itself takes no time.
"""

from adis_gonio.base import lazily

_HOMES = {"runner": "SessionRunner"}

__getattr__ = lazily(__name__, _HOMES)
