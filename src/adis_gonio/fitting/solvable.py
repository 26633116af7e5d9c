"""The one error for numbers that no fit can use."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np

from adis_gonio.base.errors import FitError
from adis_gonio.model.records import Session

F = TypeVar("F", bound=Callable[..., Any])


def unsolvable(name: str, error: Exception) -> FitError:
    """Return the `FitError` about a file or command whose numbers give a matrix without an inverse."""
    return FitError(
        f"{name}: no fit is possible with these numbers ({error}): check the times, the units and the"
        " stated uncertainties"
    )


def solvable(compute: F) -> F:
    """Let a function of a session raise `FitError` instead of numpy's `LinAlgError`.

    Values that are finite one by one can still give a matrix without an inverse, such as times that differ
    by many orders of magnitude.
    """

    @wraps(compute)
    def computed(session: Session, *args: Any, **options: Any) -> Any:
        try:
            return compute(session, *args, **options)
        except np.linalg.LinAlgError as error:
            raise unsolvable(session.source or "session", error) from error

    return cast(F, computed)
