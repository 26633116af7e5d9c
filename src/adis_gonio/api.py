"""`fit` and `trace` as a program calls them: of a session, or of the file that holds it."""

from __future__ import annotations

from os import PathLike

from adis_gonio import fitting, tracing
from adis_gonio.errors import UsageError
from adis_gonio.fitting import FitResult
from adis_gonio.model.records import Session
from adis_gonio.session.loading import load_session
from adis_gonio.tracing import TraceResult


def fit(session: Session | str | PathLike[str], method: str | None = None) -> FitResult:
    """Parameters of a session; see `adis_gonio.fitting.fit`.

    Parameters
    ----------
    session : Session or path
        A session, or a file of `calibrate`, `simulate`, or samples as CSV.
    method : str, optional
        One of `adis_gonio.fitting.METHODS`; by default the best that the positions allow.
    """
    return fitting.fit(_session(session), method)


def trace(
    session: Session | str | PathLike[str], max_effects: int = 6, time_limit: float | None = None
) -> TraceResult:
    """Missing effects of a session; see `adis_gonio.tracing.trace`."""
    return tracing.trace(_session(session), max_effects, time_limit)


def _session(given: Session | str | PathLike[str]) -> Session:
    if isinstance(given, Session):
        return given
    if isinstance(given, str | PathLike):
        return load_session(given)  # type: ignore[arg-type]
    raise UsageError(f"a session or the path of its file is needed, not a {type(given).__name__}")
