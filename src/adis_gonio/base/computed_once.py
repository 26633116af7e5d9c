"""Results of functions of an immutable object, computed once and kept with the object."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import cached_property
from typing import Any, TypeVar

T = TypeVar("T")


class ComputedOnce:
    """Base class of frozen dataclasses that keep expensive results of functions in other modules."""

    @cached_property
    def _results(self) -> dict[tuple[Hashable, ...], Any]:
        return {}

    def once(self, function: Callable[..., T], *arguments: Hashable) -> T:
        """Return `function(self, *arguments)`, computed at the first call with these arguments."""
        key = (function, *arguments)
        if key not in self._results:
            self._results[key] = function(self, *arguments)
        found: T = self._results[key]
        return found
