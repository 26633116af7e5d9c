"""`adis_gonio.fit` and `adis_gonio.trace`: as in their packages, of any part, and of a path too."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from adis_gonio.errors import UsageError
from adis_gonio.estimation.parts import ACCELEROMETER, GYRO, known_part
from adis_gonio.fitting import FitResult
from adis_gonio.fitting import fit as _fit
from adis_gonio.fitting.gyro import METHOD as GYRO_METHOD
from adis_gonio.fitting.gyro import GyroFit, fit_gyro
from adis_gonio.model import Session
from adis_gonio.session import load_session
from adis_gonio.tracing import TraceResult
from adis_gonio.tracing.trace import trace as _trace

if TYPE_CHECKING:
    from adis_gonio.calibration import Calibration


@overload
def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    part: Literal["accelerometer"] = "accelerometer",
) -> FitResult: ...


@overload
def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    *,
    part: Literal["gyro"],
    accelerometers: Calibration | None = None,
) -> GyroFit: ...


@overload
def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    *,
    part: str,
    accelerometers: Calibration | None = None,
) -> FitResult | GyroFit: ...


def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    part: str = ACCELEROMETER,
    accelerometers: Calibration | None = None,
) -> FitResult | GyroFit:
    """`adis_gonio.fitting.fit` of a session, or of a file that holds one.

    Parameters
    ----------
    part : {"accelerometer", "gyro"}
        Part of the sensor; gyros have one method, `gyro`.
    accelerometers : Calibration, optional
        With gyros: of the same part's accelerometers, for the directions of axes (`fit_gyro`).

    Raises
    ------
    UsageError
        Neither a session nor a path; no such method, or part; a calibration of another part.
    DataError, FitError, SingularError
        As `adis_gonio.fitting.fit`.
    """
    if known_part(part) != GYRO:
        if accelerometers is not None:
            raise UsageError("a calibration of the accelerometers goes with part='gyro'")
        return _fit(session_of(session, "fit"), method=method)
    if method not in (None, GYRO_METHOD):
        raise UsageError(f"gyros have no method '{method}'; theirs is {GYRO_METHOD}")
    return fit_gyro(session_of(session, "fit"), accelerometers)


def trace(
    session: Session | str | PathLike[str],
    max_effects: int = 6,
    time_limit: float | None = None,
    part: str = "accelerometer",
) -> TraceResult:
    """`adis_gonio.tracing.trace` of a session, or of a file that holds one.

    Raises
    ------
    UsageError
        Neither a session nor a path; a time limit that is not positive.
    DataError, FitError
        As `adis_gonio.tracing.trace`.
    """
    return _trace(session_of(session, "trace"), max_effects, time_limit, part)


def session_of(given: Any, what: str) -> Session:
    """The session itself, or that of a file; `UsageError` for anything else."""
    if isinstance(given, Session):
        return given
    if isinstance(given, str | PathLike):
        return load_session(Path(given))
    raise UsageError(f"{what} takes a Session or the path of a file, not {type(given).__name__}")
