"""`load_calibration`, `load_gyro_calibration`: from a JSON file, or from a session that is fitted.

Importing this module teaches `Calibration.load` and `GyroCalibration.load` to fit a session; the classes
themselves stand below the fits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.output import ends_in
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.document import (
    GYRO_SCHEMA,
    SCHEMA,
    calibration_from,
    calibration_in,
    gyro_calibration_from,
    json_document,
)
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.record.provenance import Provenance, provenance_of

_FOR_OTHERS = (".h", ".hpp", ".xml", ".html", ".parquet")
"""Endings of what `export` and `report` write and nothing here reads."""


def load_calibration(path: str | Path, method: str | None = None) -> Calibration:
    """Calibration of a JSON file, or of a session by `fit`; told apart by the first character.

    Parameters
    ----------
    method : str, optional
        Of the fit, where the file is a session.

    Raises
    ------
    DataError
        The file is neither, or is damaged.
    FitError
        The session does not determine a calibration.
    """
    made = calibration_in(path)
    if made is not None:
        return made
    from adis_gonio.fitting import fit
    from adis_gonio.record.loading import load_session
    from adis_gonio.record.overrides import as_it_is
    from adis_gonio.tracing.calibrations import gyros_alone, with_gyros

    if ends_in(path, *_FOR_OTHERS):
        raise DataError(_made_for_others(path))
    try:
        session = load_session(path)
    except DataError as error:
        raise DataError(as_it_is(str(error))) from None
    try:
        own = fit(session, method=method).calibration()
    except FitError as error:
        raise FitError(f"{error}{gyros_alone(session)}") from None
    return with_gyros(own, session)


def load_gyro_calibration(
    path: str | Path, part: Provenance | None = None, *, traced: bool = False
) -> GyroCalibration:
    """As `GyroCalibration.load`.

    Parameters
    ----------
    part : Provenance, optional
        Of the accelerometers beside which the gyros shall stand: another sensor's or serial number's are
        refused with `UsageError`.
    traced : bool
        Of a session: by the traced model of its gyros, with its effects.
    """
    document = json_document(Path(path))
    if document is None:
        from adis_gonio.record.loading import load_session
        from adis_gonio.tracing.calibrations import gyro_calibration_of

        if ends_in(path, *_FOR_OTHERS):
            raise DataError(_made_for_others(path))
        session = load_session(path)
        _refuse_another_part(part, _named(provenance_of(session)), path)
        return gyro_calibration_of(session, traced=traced)
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema == SCHEMA:
        whole = calibration_from(document, str(path))
        _refuse_another_part(part, _named(whole.provenance), path)
        if whole.gyro is None:
            raise FitError(f"{path}: is a calibration without gyros")
        return whole.gyro
    if schema is None and isinstance(document, dict) and isinstance(document.get("gyro"), dict):
        # What `export` makes of a session that calibrates its gyros alone, as one of the plan gyro-turns.
        _refuse_another_part(part, _exported(document.get("session")), path)
        return gyro_calibration_from(document["gyro"], str(path))
    if schema != GYRO_SCHEMA:
        raise DataError(f"{path}: is no gyro calibration; GyroCalibration.save makes one")
    return gyro_calibration_from(document, str(path))


def _made_for_others(path: str | Path) -> str:
    return f"{path}: is made for others to read; give a session, or the .json of export"


def _named(part: Provenance) -> tuple[str, str]:
    return part.sensor, part.serial


def _exported(session: Any) -> tuple[str, str]:
    """Sensor and serial number as `session_dict` states them."""
    about = session if isinstance(session, dict) else {}
    return str(about.get("sensor") or ""), str(about.get("serial") or "")


def _refuse_another_part(part: Provenance | None, other: tuple[str, str], path: str | Path) -> None:
    if part is None:
        return
    for here, there in zip((part.sensor, part.serial), other, strict=True):
        if here and there and here != there:
            raise UsageError(f"{path}: its gyros are of {there}, the accelerometers of {here}")


Calibration.of_session = load_calibration
GyroCalibration.of_session = load_gyro_calibration
