"""Cache for results of functions of an immutable object, which is stored in this object."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import Any, TypeVar

T = TypeVar("T")


class ComputedOnce:
    """Base class of frozen dataclasses that cache the results of functions applied to them."""

    @cached_property
    def _results(self) -> dict[tuple[Hashable, ...], Any]:
        return {}

    def once(self, function: Callable[..., T], *arguments: Hashable) -> T:
        """Return `function(self, *arguments)`; later calls with equal arguments reuse the first result."""
        key = (function, *arguments)
        if key not in self._results:
            self._results[key] = function(self, *arguments)
        found: T = self._results[key]
        return found
