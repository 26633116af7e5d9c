"""For tests of other packages: the public names of `adis_gonio.sim.testing`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from adis_gonio.sim import testing as _doubles

__all__ = _doubles.__all__

if TYPE_CHECKING:
    from adis_gonio.sim.testing import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """Import a name from its home when it is first asked for (PEP 562)."""
    return getattr(_doubles, name)
