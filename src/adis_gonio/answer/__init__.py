"""The one answer of a session, which every face shows: the screen, the report, Python."""

from __future__ import annotations

from adis_gonio.answer.answer import Answer

__all__ = ["Answer"]
