"""`adis_gonio.fit` and `adis_gonio.trace`: functions for accelerometers or gyros of a session or a file."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.estimation.readings import ACCELEROMETER, GYRO, known_part
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.gyros.gyro_fit import METHOD as GYRO_METHOD, GyroFit, fit_gyro
from adis_gonio.fitting.methods import fit as _fit
from adis_gonio.model import Session
from adis_gonio.record.loading import load_session

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration
    from adis_gonio.tracing.trace_result import TraceResult


@overload
def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    part: Literal["accelerometer"] = "accelerometer",
    *,
    gyros: GyroCalibration | str | PathLike[str] | None = None,
) -> FitResult: ...


@overload
def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    *,
    part: Literal["gyro"],
    accelerometers: Calibration | None = None,
) -> GyroFit: ...


def fit(
    session: Session | str | PathLike[str],
    method: str | None = None,
    part: str = ACCELEROMETER,
    *,
    accelerometers: Calibration | None = None,
    gyros: GyroCalibration | str | PathLike[str] | None = None,
) -> FitResult | GyroFit:
    """Fit a session, or the session in a file; see `adis_gonio.fitting.fit`.

    Parameters
    ----------
    session : Session or path
        Session, or its file.
    method : str, optional
        Method of the fit; None takes the recommended method.
    part : {"accelerometer", "gyro"}
        Part of the sensor; gyros have one method, `gyro`.
    accelerometers : Calibration, optional
        Only for `part="gyro"`: calibration of the accelerometers of this sensor, for directions of
        gravity that the session does not determine.
    gyros : GyroCalibration or path, optional
        Calibration of the sensor's gyros from another session, or its file (see `load_gyro_calibration`).
        It is used for a session of poses in space that recorded the turns between the poses.

    Raises
    ------
    UsageError
        `session` is neither a session nor a path; an unknown method or part; a calibration of another
        sensor, or gyros that the session cannot use.
    DataError, FitError, SingularError
        The file cannot be read, or no fit is possible; see `adis_gonio.fitting.fit`.
    """
    if known_part(part) != GYRO:
        if accelerometers is not None:
            raise UsageError("a calibration of the accelerometers needs part='gyro'")
        given = _load(session, "fit")
        if isinstance(gyros, str | PathLike):
            from adis_gonio.record.provenance import provenance_of
            from adis_gonio.tracing.trace_calibrations import load_gyro_calibration

            if given.source and Path(gyros).resolve() == Path(given.source).resolve():
                raise UsageError(
                    f"{gyros}: its gyros would be calibrated by the turns that they explain; give another"
                    " session"
                )
            gyros = load_gyro_calibration(Path(gyros), provenance_of(given))
        return _fit(given, method=method, gyros=gyros)
    if gyros is not None:
        raise UsageError("a calibration of gyros is for a fit of the accelerometers, not for part='gyro'")
    if method not in (None, GYRO_METHOD):
        raise UsageError(f"gyros have no method '{method}'; theirs is {GYRO_METHOD}")
    return fit_gyro(_load(session, "fit"), accelerometers)


def trace(
    session: Session | str | PathLike[str],
    max_effects: int = 6,
    time_limit: float | None = None,
    part: str = "accelerometer",
    include: str | Sequence[str] = (),
    exclude: str | Sequence[str] = (),
    only: bool = False,
) -> TraceResult:
    """Trace a session, or the session in a file; see `adis_gonio.tracing.trace`.

    Parameters
    ----------
    session : Session or path
        Session, or its file.
    max_effects : int
        Largest number of effects to add.
    time_limit : float, optional
        Time in s after which the search ends; None is unlimited.
    part : {"accelerometer", "gyro"}
        Part of the sensor that is traced.
    include, exclude : str or sequence of str
        `include` has terms that every tried model contains, such as `quadratic:x` or
        `mine_x = (T - 25)**2 * gx`. `exclude` has names of effects that no tried model contains.
    only : bool
        True: the model has the terms of `include` and no other.

    Raises
    ------
    UsageError
        `session` is neither a session nor a path, the time limit is not positive, or a term is unknown or
        cannot be shown by the session.
    DataError, FitError
        The file cannot be read, or no trace is possible; see `adis_gonio.tracing.trace`.
    """
    from adis_gonio.tracing.trace import trace as trace_session

    return trace_session(_load(session, "trace"), max_effects, time_limit, part, include, exclude, only)


def _load(given: Any, what: str) -> Session:
    """Return a session, read from its file if a path is given; `UsageError` for anything else.

    `what` is the name of the calling function, for the message.
    """
    if isinstance(given, Session):
        return given
    if isinstance(given, str | PathLike):
        return load_session(Path(given))
    raise UsageError(f"{what} takes a Session or the path of a file, not {type(given).__name__}")
