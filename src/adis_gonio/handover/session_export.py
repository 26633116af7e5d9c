"""Export a session or a calibration in one of the formats of `formats.py`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.conformity import Tolerance
from adis_gonio.base.errors import DataError, FitError, NotInstalledError, UsageError, install_extra
from adis_gonio.base.jsonable import json_text
from adis_gonio.base.output import write_utf8
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.calibration_document import calibration_in
from adis_gonio.handover.c_header import DEFAULT_NAME
from adis_gonio.handover.formats import BY_NAME
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Session
from adis_gonio.record.loading import Overrides, load_session
from adis_gonio.record.provenance import changed_registers
from adis_gonio.record.samples_writer import session_dict
from adis_gonio.record.session_reader import describe_later_writes
from adis_gonio.tracing.trace_calibrations import (
    gyro_calibration_of,
    gyros_alone,
    load_gyro_calibration,
    with_gyros,
)

ROWS = 100_000
"""Number of rows of a row group of a Parquet file."""


def require_pyarrow() -> Any:
    """Import pyarrow and return the module.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError:
        raise NotInstalledError(f"Parquet needs pyarrow: {install_extra('parquet')}") from None
    return pyarrow


def write_table(
    path: str | Path, columns: Mapping[str, tuple[Any, Any, dict[str, str]]], about: Mapping[str, Any]
) -> None:
    """Write a Parquet file.

    `columns` has the values, the type of pyarrow and the metadata of each column by its name; None and NaN
    become null. `about` is the metadata `adis_gonio` of the file, as JSON.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    OSError
        The file cannot be written.
    """
    pa = require_pyarrow()
    fields = [pa.field(name, kind, metadata=more) for name, (_, kind, more) in columns.items()]
    schema = pa.schema(fields, metadata={"adis_gonio": json.dumps(about, ensure_ascii=False)})
    arrays = [pa.array(values, kind, from_pandas=True) for values, kind, _ in columns.values()]
    table = pa.table(arrays, schema=schema)
    pa.parquet.write_table(table, path, compression="zstd", row_group_size=ROWS)


def write_parquet(session: Session, path: str | Path) -> None:
    """Write all samples of a session to a Parquet file; missing values are null.

    The columns are the columns of the samples CSV.

    The metadata key `adis_gonio` has the session without its samples as JSON; each column has its unit.

    Raises
    ------
    NotInstalledError
        pyarrow is not installed.
    DataError
        The session has no dwell, or dwells with different columns.
    OSError
        The file cannot be written.
    """
    pa = require_pyarrow()
    kinds = {"position": pa.int64(), "approach": pa.int8(), "use": pa.string()}
    columns = {}
    for name, parts in session.columns().items():
        unit = _unit(session, name)
        about = {"unit": unit} if unit else {}
        columns[name] = (np.concatenate(parts), kinds.get(name, pa.float64()), about)
    write_table(path, columns, session_dict(session))


def _unit(session: Session, name: str) -> str:
    own = {"time_s": "s", "angle_deg": "deg", "turned_deg": "deg", "temp_c": "degC", "supply_v": "V"}
    by_kind = {"a": session.accel_unit, "g": session.gyro_unit}
    return own.get(name, by_kind.get(name[0], "") if name[1:] in AXES else "")


@dataclass(frozen=True)
class ExportSource:
    """The source of an export: the file of a session or of a calibration, with options.

    Attributes
    ----------
    path : Path
        File of the session or calibration.
    method : str or None
        Method of the fit; None for the recommended one.
    traced : bool
        True to export the coefficients of the traced model, False to export the coefficients of the fit.
    name : str
        Prefix of every name in a C header.
    overrides : Overrides or None
        Corrections of the session's metadata; None without corrections.
    tolerance : Tolerance or None
        Tolerance of the angle for the statement of conformity in a certificate; None for no statement.
    gyros : Path or None
        File of a session or calibration of the sensor's gyros, used instead of the gyros of this session;
        None for the latter.
    """

    path: Path
    method: str | None = None
    traced: bool = False
    name: str = DEFAULT_NAME
    overrides: Overrides | None = None
    gyros: Path | None = None
    tolerance: Tolerance | None = None

    def write(self, kind: str, path: Path) -> list[str]:
        """Write the source in a format to a new or empty file; return remarks on the content.

        `kind` is the name of the format. If the sensor's registers changed during the session, only the
        data are written, since a calibration would hold for no state of the registers.

        Raises
        ------
        UsageError, DataError, FitError, NotInstalledError, OSError
            The method does not exist, or a file, a fit, an extra or the disk fails.
        """
        chosen = BY_NAME[kind]
        if chosen.holds == "coefficients":
            calibration, remarks = self._calibration()
            options = {name: getattr(self, name) for name in chosen.options}
            write_utf8(path, chosen.function()(calibration, **options))
            return remarks
        if calibration_in(self.path) is not None:
            raise DataError(f"{self.path}: is a calibration without samples: {kind} needs a session")
        session = load_session(self.path, self.overrides)
        if chosen.holds == "document":
            write_utf8(path, self._json(session))
            return [*changed_registers(session), *describe_later_writes(session.facts)]
        chosen.function()(session, path)
        return changed_registers(session)

    def _calibration(self) -> tuple[Calibration, list[str]]:
        """Return the calibration in the file or the calibration of its session, and remarks."""
        given = calibration_in(self.path)
        if given is not None:
            if self.method is not None or self.traced:
                raise UsageError(
                    f"{self.path}: is a calibration already: --method and --trace go with a session"
                )
            return self._with_gyros(given), []
        session = load_session(self.path, self.overrides)
        if changed := changed_registers(session):
            raise FitError(
                f"{self.path}: {'; '.join(changed)}: no calibration is valid for both "
                "states of the registers; record the session again, or export its data (csv, parquet, json)"
            )
        try:
            own = self._result(session).calibration()
        except FitError as error:
            raise FitError(f"{error}{gyros_alone(session)}") from None
        return self._with_gyros(own, session), list(describe_later_writes(session.facts))

    def _with_gyros(self, calibration: Calibration, session: Session | None = None) -> Calibration:
        if self.gyros is not None:
            gyro = load_gyro_calibration(self.gyros, calibration.provenance, traced=self.traced)
            return replace(calibration, gyro=gyro)
        return calibration if session is None else with_gyros(calibration, session, traced=self.traced)

    def _result(self, session: Session) -> Any:
        if self.traced:
            from adis_gonio.tracing.trace import trace

            return trace(session)
        from adis_gonio.fitting.methods import fit

        return fit(session, method=self.method)

    def _json(self, session: Session) -> str:
        """Return the JSON document of a session: its calibration, if determined, and its fit or trace."""
        result = self._result(session)
        document: dict[str, Any] = {"coefficients": result.as_dict(), "session": session_dict(session)}
        if changed_registers(session):
            return json_text(document)
        try:
            calibration = result.calibration()
        except FitError:  # the coefficients then hold the known parameters
            with suppress(DataError, FitError):
                document["gyro"] = gyro_calibration_of(session, traced=self.traced).as_dict()
        else:
            document = {**self._with_gyros(calibration, session).as_dict(), **document}
        return json_text(document)
