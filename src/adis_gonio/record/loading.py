"""Load a session from a file (`load_session`), and correct the file's metadata (`Overrides`)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.model import records

_REPLACED = ("gravity_mps2", "fixture_sigma_deg", "accel_unit", "sensor", "laboratory", "customer")
_OPTIONS = re.compile(r"--(columns|unit|sensor|gravity|fixture|reverse)\b")


def explain_refusal(reason: str) -> str:
    """Return the reason why a file was refused, for a command without the options that correct a file.

    If the reason recommends such an option, a remark is added that names the commands with this option.
    """
    if not _OPTIONS.search(reason):
        return reason
    return f"{reason} (an option of fit, trace and report; for this command it has to be in the file)"


@dataclass(frozen=True)
class Overrides:
    """Corrections of the metadata of a session's file; None, False or empty means no correction.

    The samples are not changed: `accel_unit` corrects the unit in which they are read. Old and new values
    are recorded in `Session.facts["overrides"]` and as a sentence in `Session.notes`.

    Attributes
    ----------
    gravity_mps2 : float or None
        Local gravity in m/s²; any value above zero (`adis_gonio.model.records.checked_gravity_mps2` checks
        whether it occurs on Earth).
    fixture_sigma_deg : float or None
        Standard uncertainty of a declared angle in degrees; `inf` if attitudes are free.
    reverse : bool
        True if the stage turned the other way than declared: angles and directions of approach change their
        sign.
    angles : mapping of int to float
        New declared angles of positions in degrees, by their number; applied before `reverse`.
    accel_unit : str or None
        Unit of the accelerations; takes precedence over a unit in the file's header.
    sensor : str or None
        Variant of the sensor, or `generic`.
    laboratory, customer : str or None
        Laboratory that calibrates the sensor, and its customer; free text.
    stage_curve : StageCurve or None
        Errors of the stage's angle according to its certificate. They correct the declared angles; the
        remaining uncertainty of a declared angle counts as not stated, unless `fixture_sigma_deg` is given.
    columns : mapping of str to str
        Column of the format → column in the header of a CSV with other names.

    Raises
    ------
    UsageError
        A value is out of range or unknown.
    """

    gravity_mps2: float | None = None
    fixture_sigma_deg: float | None = None
    reverse: bool = False
    accel_unit: records.AccelUnit | None = None
    sensor: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    angles: Mapping[int, float] = field(default_factory=dict)
    laboratory: str | None = None
    customer: str | None = None
    stage_curve: records.StageCurve | None = None

    def __post_init__(self) -> None:
        if self.gravity_mps2 is not None and not 0 < self.gravity_mps2 < math.inf:
            records.checked_gravity_mps2(self.gravity_mps2)
        if self.fixture_sigma_deg is not None and not self.fixture_sigma_deg >= 0:
            raise UsageError(f"fixture is {self.fixture_sigma_deg:g}: give degrees, 0 or more, or free")
        for name, value, known in (
            ("unit", self.accel_unit, records.ACCEL_UNITS),
            ("sensor", self.sensor, records.SENSORS),
        ):
            if value is not None and value not in known:
                raise UsageError(f"{name} is '{value}': known are {', '.join(known)}")

    def apply(self, session: records.Session) -> records.Session:
        """Return a copy of the session with these corrections.

        Raises
        ------
        UsageError
            Angles are to be reversed but none is declared, or a position does not exist.
        """
        changes: dict[str, dict[str, Any]] = {}
        for name in _REPLACED:
            new, old = getattr(self, name), getattr(session, name)
            if new is not None and new != old:
                changes[name] = {"old": old, "new": new}
        settings = {name: change["new"] for name, change in changes.items()}
        if self.stage_curve is not None:
            self.stage_curve.check(dwell.angle_deg for dwell in session.dwells)
            changes["stage_curve"] = {"old": None, "new": self.stage_curve.name}
            settings |= {"stage_curve": self.stage_curve, "fixture_sigma_deg": self.fixture_sigma_deg}
        if self.angles:
            dwells = self._changed_angles(session)
            old = {str(d.position): d.angle_deg for d in session.dwells}
            new = {str(d.position): d.angle_deg for d in dwells if d.angle_deg != old[str(d.position)]}
            if new:
                changes["angles"] = {"old": {k: old[k] for k in new}, "new": new}
            settings["dwells"] = dwells
        if self.reverse:
            if all(dwell.angle_deg is None for dwell in session.dwells):
                raise UsageError(f"{session.source}: no angle is declared, there is nothing to reverse")
            changes["reverse"] = {"old": False, "new": True}
            settings["dwells"] = tuple(map(_reversed, settings.get("dwells", session.dwells)))
        if self.columns:
            changes["columns"] = {"old": {}, "new": dict(self.columns)}
        if not changes:
            return session
        document = {
            name: {k: "free" if v == math.inf else v for k, v in change.items()}
            for name, change in changes.items()
        }
        words = "; ".join(_words(name, **change) for name, change in changes.items())
        return replace(
            session,
            notes=(*session.notes, f"overridden: {words}"),
            facts={**session.facts, "overrides": document},
            **settings,
        )

    def _changed_angles(self, session: records.Session) -> tuple[records.Dwell, ...]:
        source = session.source or "session"
        if session.plane != "xy" or not session.dwells:
            raise UsageError(f"{source}: has no declared angles of a plane, --angles changes nothing")
        numbers = [dwell.position for dwell in session.dwells]
        for number, degrees in self.angles.items():
            if number not in numbers:
                raise UsageError(
                    f"{source}: --angles {number}={degrees:g}: there is no such position;"
                    f" numbers go from {min(numbers)} to {max(numbers)}"
                )
        return tuple(replace(d, angle_deg=self.angles.get(d.position, d.angle_deg)) for d in session.dwells)


def _reversed(dwell: records.Dwell) -> records.Dwell:
    # Adding zero turns -0.0 into 0.0.
    angle = None if dwell.angle_deg is None else -dwell.angle_deg + 0.0
    return replace(dwell, angle_deg=angle, approach=-dwell.approach)


def _words(name: str, old: Any, new: Any) -> str:
    match name:
        case "gravity_mps2":
            return f"gravity {new:g} m/s² instead of {old:g}"
        case "fixture_sigma_deg":
            return f"uncertainty of a declared angle {_degrees(new)} instead of {_degrees(old)}"
        case "accel_unit":
            return f"accelerations are in {new}, not in {old}"
        case "sensor" | "laboratory" | "customer":
            return f"{name} {new} instead of {old or 'not stated'}"
        case "stage_curve":
            return f"declared angles corrected by the certificate {new}"
        case "reverse":
            return "the stage turned the other way: declared angles and approaches with the opposite sign"
        case "angles":
            return "declared angles: " + ", ".join(_angle_words(k, old[k], new[k]) for k in new)
    return "columns " + ", ".join(f"{name} = '{called}'" for name, called in new.items())


def _angle_words(position: str, old: float | None, new: float) -> str:
    return f"position {position} {new:g}° instead of {'none' if old is None else f'{old:g}°'}"


def _degrees(sigma: float | None) -> str:
    if sigma is None:
        return "not stated"
    return "free" if math.isinf(sigma) else f"{sigma:g}°"


_SQLITE_MAGIC = b"SQLite format 3\x00"


def load_session(path: str | Path, overrides: Overrides | None = None) -> records.Session:
    """Load a session from an archive (written by `calibrate` or `simulate`) or from a samples CSV.

    The first bytes determine the kind of file, not its name.

    Parameters
    ----------
    path : str or Path
        File to read.
    overrides : Overrides, optional
        Corrections of the file's metadata; without them the metadata stay as they are.

    Raises
    ------
    DataError
        The file is missing, of another kind or truncated, or its content cannot be used. The message is one
        line that names the file and, if possible, the row.
    UsageError
        A correction does not apply to this file.
    """
    path, overrides = Path(path), overrides or Overrides()
    if path.is_dir():
        raise DataError(f"{path}: is a folder; give a file written by calibrate or simulate, or a CSV")
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE_MAGIC))
    except FileNotFoundError as error:
        raise DataError(f"{path}: there is no such file") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if head == _SQLITE_MAGIC:
        from adis_gonio.record.session_reader import read_session

        if overrides.columns:
            raise UsageError(f"{path}: columns are named for a CSV; this is a session of calibrate")
        return overrides.apply(read_session(path))
    from adis_gonio.record.samples_reader import read_samples_csv

    return read_samples_csv(path, overrides)
