"""What `export` writes: a format by name or by a file's ending, and the file's content."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.jsonable import finite
from adis_gonio.base.output import write_utf8
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.document import json_text
from adis_gonio.calibrate.files import calibration_in
from adis_gonio.handover.c_header import DEFAULT_NAME
from adis_gonio.model.records import Session
from adis_gonio.record.export import session_dict
from adis_gonio.record.loading import load_session
from adis_gonio.record.overrides import Overrides
from adis_gonio.record.provenance import changed_registers
from adis_gonio.tracing.calibrations import gyro_calibration_of, gyros_alone, with_gyros
from adis_gonio.tracing.loading import load_gyro_calibration

ENDINGS = {
    ".h": "c-header",
    ".hpp": "c-header",
    ".json": "json",
    ".csv": "csv",
    ".csv.gz": "csv",
    ".parquet": "parquet",
    ".xml": "dcc",
    ".txt": "registers",
}
FORMATS = tuple(dict.fromkeys(ENDINGS.values()))
OF_SAMPLES = ("csv", "parquet")
"""Formats that hold samples and no coefficients."""


def format_of(name: str) -> str:
    """Format by a file's ending; `UsageError` names the endings that are known."""
    lower = name.lower()
    for ending in sorted(ENDINGS, key=len, reverse=True):
        if lower.endswith(ending):
            return ENDINGS[ending]
    raise UsageError(f"{name}: no format has this ending; use {', '.join(ENDINGS)}, or --format")


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
        if kind in OF_SAMPLES and (self.method is not None or self.traced):
            raise UsageError(f"--method and --trace go with coefficients: {kind} holds the samples only")
        if kind in OF_SAMPLES and self.gyros is not None:
            raise UsageError(f"--gyros goes with coefficients: {kind} holds the samples only")
        if self.samples and kind != "json":
            raise UsageError("--samples goes with --format json")
        if self.method is not None and self.traced:
            raise UsageError("--method and --trace exclude each other: a trace has its own model")
        if self.name != DEFAULT_NAME and kind != "c-header":
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
        if kind not in (*OF_SAMPLES, "json"):
            write_utf8(path, _TEXTS[kind](self._calibration(), self.name))
            return []
        session = self._session(kind)
        if kind == "json":
            write_utf8(path, self._json(session))
        else:
            _SAMPLES[kind](session, path)
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


def _header(calibration: Calibration, name: str) -> str:
    from adis_gonio.handover.c_header import c_header

    return c_header(calibration, name)


def _registers(calibration: Calibration, name: str) -> str:
    from adis_gonio.handover.offsets import registers_text

    return registers_text(calibration)


def _certificate(calibration: Calibration, name: str) -> str:
    from adis_gonio.handover.certificate import certificate_text

    return certificate_text(calibration)


def _csv(session: Session, path: Path) -> None:
    from adis_gonio.record.export import write_csv

    write_csv(session, path)


def _parquet(session: Session, path: Path) -> None:
    from adis_gonio.handover.parquet import write_parquet

    write_parquet(session, path)


_TEXTS: dict[str, Callable[[Calibration, str], str]] = {
    "c-header": _header,
    "registers": _registers,
    "dcc": _certificate,
}
_SAMPLES: dict[str, Callable[[Session, Path], None]] = {"csv": _csv, "parquet": _parquet}
