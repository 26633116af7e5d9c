"""Foundations: version, errors, numbers with units and uncertainty, output files, JSON, time limits."""

from __future__ import annotations

import abc
import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

__version__ = "0.1.0"


def lazily(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a `__getattr__` for a package that imports its names when they are first used (PEP 562).

    It also sets `__all__` of the package.

    Parameters
    ----------
    package : str
        `__name__` of the package.
    homes : mapping of str to str
        For each module within the package, its public names separated by blanks.
    """
    modules = {name: module for module, names in homes.items() for name in names.split()}
    namespace = vars(sys.modules[package])
    namespace["__all__"] = [*sorted(modules), *namespace.get("__all__", ())]

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        namespace[name] = value = getattr(importlib.import_module(f"{package}.{modules[name]}"), name)
        return value

    return get


class Closing(abc.ABC):
    """Context manager with a method `close`, which is called at the end of the block.

    It is also called after an exception.
    """

    @abc.abstractmethod
    def close(self) -> None:
        """Release the resources; may be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @contextlib.contextmanager
    def closed_on_error(self) -> Iterator[None]:
        """Close the object if an exception ends the block; otherwise it stays open."""
        try:
            yield
        except BaseException:
            self.close()
            raise
