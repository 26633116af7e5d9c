"""The guided session and other work at the bench: bring-up, write-back, IIO as a source.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "runner": "SessionRunner",
}


if TYPE_CHECKING:
    from adis_gonio.bench.runner import SessionRunner as SessionRunner

__getattr__ = lazily(__name__, _HOMES)
