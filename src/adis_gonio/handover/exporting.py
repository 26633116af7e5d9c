"""Export a session or a calibration in one of the formats of `formats.py`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.jsonable import finite
from adis_gonio.base.output import write_utf8
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.coefficients import json_text
from adis_gonio.calibrate.document import calibration_in
from adis_gonio.handover.c_header import DEFAULT_NAME
from adis_gonio.handover.formats import BY_NAME
from adis_gonio.model.records import Session
from adis_gonio.record.loading import Overrides, load_session
from adis_gonio.record.provenance import changed_registers
from adis_gonio.record.samples_writer import session_dict
from adis_gonio.tracing.trace_calibrations import (
    gyro_calibration_of,
    gyros_alone,
    load_gyro_calibration,
    with_gyros,
)


@dataclass(frozen=True)
class ExportSource:
    """What is exported: a session, with how its coefficients are found; or a calibration's file.

    Attributes
    ----------
    path : Path
    method : str or None
        Of the fit; None: the best one.
    traced : bool
        True for the coefficients of the traced model.
    samples : bool
        True for every sample in JSON.
    name : str
        What every name in a C header begins with.
    overrides : Overrides or None
        What the session's file should have said.
    gyros : Path or None
        Session or calibration of the same part whose gyros stand in the place of the session's own.
    """

    path: Path
    method: str | None = None
    traced: bool = False
    samples: bool = False
    name: str = DEFAULT_NAME
    overrides: Overrides | None = None
    gyros: Path | None = None

    def check(self, kind: str) -> None:
        """Refuse options that have no meaning for a format: `UsageError`."""
        samples_only = BY_NAME[kind].holds == "samples"
        if samples_only and (self.method is not None or self.traced):
            raise UsageError(f"--method and --trace go with coefficients: {kind} holds the samples only")
        if samples_only and self.gyros is not None:
            raise UsageError(f"--gyros goes with coefficients: {kind} holds the samples only")
        if self.samples and kind != "json":
            raise UsageError("--samples goes with --format json")
        if self.method is not None and self.traced:
            raise UsageError("--method and --trace exclude each other: a trace has its own model")
        if self.name != DEFAULT_NAME and not BY_NAME[kind].named:
            raise UsageError("--name goes with --format c-header")

    def write(self, kind: str, path: Path) -> list[str]:
        """Write a format to a file that is not there yet, or is empty; return the remarks on its content.

        Of a session whose registers changed while it was recorded, only the data are written: a calibration
        holds for no register state, as in `adis-gonio write`.

        Raises
        ------
        UsageError, DataError, FitError, NotInstalledError, OSError
            As its parts.
        """
        self.check(kind)
        chosen = BY_NAME[kind]
        if chosen.holds == "coefficients":
            options = {"name": self.name} if chosen.named else {}
            write_utf8(path, chosen.function()(self._calibration(), **options))
            return []
        session = self._session(kind)
        if chosen.holds == "document":
            write_utf8(path, self._json(session))
        else:
            chosen.function()(session, path)
        return changed_registers(session)

    def _session(self, kind: str) -> Session:
        if calibration_in(self.path) is not None:
            raise DataError(f"{self.path}: is a calibration without samples: {kind} needs a session")
        return load_session(self.path, self.overrides)

    def _calibration(self) -> Calibration:
        made = calibration_in(self.path)
        if made is None:
            session = load_session(self.path, self.overrides)
            changed = changed_registers(session)
            if changed:
                raise FitError(
                    f"{self.path}: {'; '.join(changed)}: a calibration holds for no register state;"
                    " record the session again; csv, parquet and json hold its data"
                )
            try:
                own = self._result(session).calibration()
            except FitError as error:
                raise FitError(f"{error}{gyros_alone(session)}") from None
            return self._with_gyros(own, session)
        if self.method is not None or self.traced:
            raise UsageError(
                f"{self.path}: is a calibration already: --method and --trace go with a session"
            )
        return self._with_gyros(made)

    def _with_gyros(self, made: Calibration, session: Session | None = None) -> Calibration:
        if self.gyros is not None:
            return replace(
                made, gyro=load_gyro_calibration(self.gyros, made.provenance, traced=self.traced)
            )
        return made if session is None else with_gyros(made, session, traced=self.traced)

    def _result(self, session: Session) -> Any:
        if self.traced:
            from adis_gonio.tracing.trace import trace

            return trace(session)
        from adis_gonio.fitting import fit

        return fit(session, method=self.method)

    def _json(self, session: Session) -> str:
        """The calibration, where the session determines one; the fit or trace; what is known of it."""
        about = session_dict(session)
        if not self.samples:
            del about["dwells"]
        result = self._result(session)
        document: dict[str, Any] = {"coefficients": result.as_dict(), "session": about}
        if changed_registers(session):
            return json_text(finite(document))
        try:
            made = result.calibration()
        except FitError:  # what is known of the parameters is in the coefficients then
            with suppress(DataError, FitError):
                document["gyro"] = gyro_calibration_of(session, traced=self.traced).as_dict()
        else:
            document = {**self._with_gyros(made, session).as_dict(), **document}
        return json_text(finite(document))
