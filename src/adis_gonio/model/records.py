"""Measured data as plain records: samples, dwells, turns, sessions; local gravity. No files or devices.

A *dwell* is the scans taken while the sensor is at rest in one *position*; a *session* is all dwells with
their circumstances. A *turn* is the samples between two dwells. A samples CSV with positions has no turns.
An archive has some samples before and after each dwell, and a continuous recording has all samples. Files
become sessions in `adis_gonio.record`; fits read them in `adis_gonio.fitting`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, UsageError, one_line
from adis_gonio.base.jsonable import ComputedOnce, json_object
from adis_gonio.base.numbers import counted

if TYPE_CHECKING:
    import pandas as pd

ON_EARTH_MPS2 = (9.7, 9.9)
"""Limits of a stated gravity in m/s²: 9.764 (Huascarán) to 9.834 (Arctic Ocean), with a margin."""
_SLIPS = {0.01: "cm/s² (Gal)", 1e-5: "mGal", 9.80665: "g", 9.80665e-3: "mg", 0.3048: "ft/s²"}


def checked_gravity_mps2(value: float, *, anywhere: bool = False) -> float:
    """Return a stated local gravity in m/s², or raise `UsageError` if it does not exist on Earth.

    Parameters
    ----------
    anywhere : bool
        Accept gravity elsewhere than on Earth too, unless the number is gravity of the Earth in another
        unit.

    Raises
    ------
    UsageError
        The value lies outside `ON_EARTH_MPS2`; the message names the unit in which it would be right.
    """
    low, high = ON_EARTH_MPS2
    slips = [f"; {value:g} {unit} are {value * k:.6g} m/s²" for k, unit in _SLIPS.items()]
    fits = [text for k, text in zip(_SLIPS, slips, strict=True) if low <= value * k <= high]
    if low <= value <= high or (anywhere and not fits and 0 < value < math.inf):
        return value
    raise UsageError(
        f"gravity is {value:g}: give m/s², {low:g} to {high:g} on Earth{fits[0] if fits else ''}; "
        f"for another place say so by writing the unit, {value:g}mps2"
    )


REVERSED_DEG = 10.0
"""Angle in degrees by which a hand may turn back without a reversal of the direction of turning."""
NEARLY_DEG = 5.0
"""Angle in degrees that may be missing from a full turn."""


class Sweeps:
    """Counter of full turns of an angle observed step by step, in one direction or back and forth.

    Attributes
    ----------
    angle_deg : float
        Present angle relative to the start, with its sign.
    span_deg : float
        Largest minus smallest angle so far.
    """

    def __init__(self) -> None:
        self.angle_deg = 0.0
        self._least = self._greatest = 0.0
        self._gone = 0.0
        self._from = self._farthest = 0.0

    def see(self, angle_deg: float) -> None:
        """Update the counts with the next angle in degrees, unwrapped (without jumps of 360°)."""
        self.angle_deg = angle_deg
        self._least, self._greatest = min(self._least, angle_deg), max(self._greatest, angle_deg)
        on = self._farthest - self._from
        if (angle_deg - self._farthest) * (on or angle_deg - self._farthest) >= 0:
            self._farthest = angle_deg
        elif abs(angle_deg - self._farthest) > REVERSED_DEG:
            self._gone += abs(on)
            self._from, self._farthest = self._farthest, angle_deg

    @property
    def span_deg(self) -> float:
        """Largest minus smallest angle so far, in degrees."""
        return self._greatest - self._least

    @property
    def travelled_deg(self) -> float:
        """Total angle travelled in both directions, in degrees; reversals of 10° or less do not count."""
        return self._gone + abs(self._farthest - self._from)

    @property
    def full(self) -> int:
        """Number of full turns so far, in either direction."""
        if self.span_deg < 360.0 - NEARLY_DEG:
            return 0
        return int((self.travelled_deg + NEARLY_DEG) // 360.0)


SERIES = {
    "time_s": ("time_s",),
    "accel": ("ax", "ay", "az"),
    "gyro": ("gx", "gy", "gz"),
    "temperature_c": ("temp_c",),
    "supply_v": ("supply_v",),
}
"""Columns of the samples CSV by the field of a `Dwell` or `Turn` that has their samples."""


class SampleSeries:
    """Base class of records of samples: times, readings, temperatures and supply as arrays of equal length.

    A record has a field for each name in `SERIES`, and the field `temperatures_c` of the gyros' dies.
    """

    def series(self, rows: slice | NDArray[np.bool_] = slice(None)) -> dict[str, Any]:
        """Return the selected rows of each series of samples by field name; None for a missing series."""
        every = {name: getattr(self, name) for name in (*SERIES, "temperatures_c")}
        return {name: None if values is None else values[rows] for name, values in every.items()}


@dataclass(frozen=True)
class Turn(SampleSeries):
    """Samples between two successive dwells.

    Attributes
    ----------
    before, position : int
        Numbers (`Dwell.position`) of the dwells before and after the turn.
    time_s : (n,) float
        Time of each sample, increasing, on the clock of the dwells; n may be 0.
    accel, gyro : (n, 3) float
        Samples in `Session.accel_unit` and `Session.gyro_unit`; `gyro` is None if gyros were not recorded.
    temperature_c, supply_v : (n,) float or None
        Temperature in °C and supply in V; None if not recorded.
    temperatures_c : (n, 3) float or None
        Temperatures in °C of the three gyros' dies; None if not all three were recorded.
    turned_deg : float or None
        Declared angle in degrees by which the part turned about the vertical from the dwell before to the
        dwell after, as from mark to mark; positive counter-clockwise seen from above. None if it is not
        declared.
    """

    before: int
    position: int
    time_s: Floats
    accel: Floats
    gyro: Floats | None = None
    temperature_c: Floats | None = None
    supply_v: Floats | None = None
    turned_deg: float | None = None
    temperatures_c: Floats | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        return f"Turn({self.before} to {self.position}: {counted(len(self), 'sample')})"


Plane = Literal["xy", "none"]
Use = Literal["fit", "check"]
AccelUnit = Literal["lsb", "mg", "g", "mps2", "counts"]
GyroUnit = Literal["dps", "radps", "counts"]

SENSORS = ("adis16354", "adis16350", "adis16355", "generic")
PLANES: tuple[Plane, ...] = get_args(Plane)
ACCEL_UNITS: tuple[AccelUnit, ...] = get_args(AccelUnit)
GYRO_UNITS: tuple[GyroUnit, ...] = get_args(GyroUnit)

STANDARD_GRAVITY_MPS2 = 9.80665
MG_PER_G = 1000.0
MG_PER_MPS2 = 1000.0 / STANDARD_GRAVITY_MPS2

METADATA = ("operator", "serial", "stage", "laboratory", "customer")
"""Names of the session's fields with texts of the operator, besides the title."""


WIDEST_STEP_DEG = 45.0
"""Largest step in degrees between certified angles of a stage across which its errors are interpolated."""


@dataclass(frozen=True, eq=False)
class StageCurve:
    """Errors of a stage as a function of its angle, by the certificate of the stage.

    Attributes
    ----------
    name : str
        Name of the certificate.
    angle_deg : (m,) float
        Angles indicated by the stage, ascending in 0 to 360.
    error_deg : (m,) float
        Indicated minus true angle.
    covariance_deg2 : (m, m) float
        Covariance of the errors.
    """

    name: str
    angle_deg: Floats
    error_deg: Floats
    covariance_deg2: Floats

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> StageCurve:
        """Return the curve that the JSON object of its fields describes."""
        numbers = {name: np.array(value) for name, value in document.items() if name != "name"}
        return cls(document["name"], **numbers)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the curve."""
        return json_object(**vars(self))

    @property
    def digest(self) -> str:
        """Hash of the curve; sessions on one stage have equal hashes."""
        return hashlib.sha256(json.dumps(self.as_dict()).encode()).hexdigest()

    def check(self, angles_deg: Iterable[float | None]) -> None:
        """Check that the certificate covers the declared angles in degrees; None is a dwell without one.

        Raises
        ------
        UsageError
            No angle is declared, or one lies between two angles of the certificate that are more than
            `WIDEST_STEP_DEG` apart.
        """
        declared = [angle % 360 for angle in angles_deg if angle is not None]
        if not declared:
            raise UsageError(
                f"{self.name}: no angle is declared that the stage's certificate could correct"
            )
        steps = np.diff(self.angle_deg, prepend=self.angle_deg[-1] - 360)
        for angle in declared:
            after = int(np.searchsorted(self.angle_deg, angle)) % len(steps)
            if steps[after] > WIDEST_STEP_DEG and angle not in self.angle_deg:
                raise UsageError(f"{self.name}: the certificate has no errors of the stage near {angle:g}°")

    def at(self, angle_deg: Floats) -> tuple[Floats, Floats]:
        """Return the errors (n,) in degrees at declared angles (n,), and a root (n, k) of their covariance.

        The root is the change of the errors by one standard uncertainty of each of k independent causes.
        Errors between the angles of the certificate are interpolated on straight lines.
        """
        rows = [
            np.interp(angle_deg, self.angle_deg, unit, period=360) for unit in np.eye(len(self.angle_deg))
        ]
        weights = np.array(rows).T  # (n, m)
        size, axis = np.linalg.eigh(self.covariance_deg2)
        kept = size > 1e-12 * size.max()
        return weights @ self.error_deg, weights @ (axis[:, kept] * np.sqrt(size[kept]))


UNSTATED: dict[str, Any] = {"angle_deg": math.nan, "turned_deg": math.nan, "approach": 0, "use": "fit"}
"""Facts of a dwell that have a column in the samples CSV, with the value that means "not stated"."""


@dataclass(frozen=True)
class Dwell(SampleSeries):
    """Samples recorded in one position, with the conditions of the dwell.

    Attributes
    ----------
    position : int
        Number of the dwell in the session.
    time_s : (n,) float
        Time of each sample in s, increasing.
    accel : (n, 2) or (n, 3) float
        Accelerometer samples in `Session.accel_unit`.
    angle_deg : float or None
        Declared angle θ of the stage, positive for a rotation that reduces ψ = α − θ; None if unknown.
    approach : int
        Direction from which the position was reached, +1 from below or -1 from above; 0 if unknown.
    use : {"fit", "check"}
        `check` dwells take no part in a fit or in a choice of effects.
    gyro : (n, 3) float or None
        Gyro samples in `Session.gyro_unit`; None if not recorded.
    temperature_c, supply_v : (n,) float or None
        Temperature in °C (of several thermometers their mean) and supply in V; None if not recorded.
    temperatures_c : (n, 3) float or None
        Temperatures in °C of the three gyros' dies; None if not all three were recorded.
    turned_deg : float or None
        Declared angle of the turn from the dwell before to this dwell (`Turn.turned_deg`); None if none.
    """

    position: int
    time_s: Floats
    accel: Floats
    angle_deg: float | None = None
    approach: int = 0
    use: Use = "fit"
    gyro: Floats | None = None
    temperature_c: Floats | None = None
    supply_v: Floats | None = None
    temperatures_c: Floats | None = None
    turned_deg: float | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        angle = "no angle" if self.angle_deg is None else f"{self.angle_deg:g}°"
        return f"Dwell({self.position}: {angle}, {counted(len(self), 'sample')})"

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the columns (n,) of the samples CSV by name; an unstated fact has no column."""
        n = len(self)
        facts = {name: getattr(self, name) for name in ("position", *UNSTATED)}
        made: dict[str, NDArray[Any]] = {"time_s": self.time_s}
        made |= {k: np.full(n, v) for k, v in facts.items() if v not in (None, UNSTATED.get(k))}
        for name, members in SERIES.items():
            values = getattr(self, name)
            if values is not None:
                made |= dict(zip(members, np.atleast_2d(values.T), strict=False))
        return made


@dataclass(frozen=True)
class Session(ComputedOnce):
    """All dwells of a calibration, with their circumstances.

    Attributes
    ----------
    dwells : tuple of Dwell
        In the order of recording.
    sensor : str
        `adis16354`, `adis16350`, `adis16355` or `generic`.
    accel_unit : str
        Unit of `Dwell.accel`; `counts` means an unknown scale and zero that the fit has to find.
    gyro_unit : str
        Unit of `Dwell.gyro`: `dps`, `radps`, or `counts` for an unknown scale.
    gravity_mps2 : float
        Local gravity in m/s².
    fixture_sigma_deg : float or None
        Standard uncertainty of a declared angle in degrees; `inf` if attitudes are free; None if not
        stated.
    plane : {"xy", "none"}
        Plane of rotation, or none for attitudes anywhere in space.
    stage_curve : StageCurve or None
        Errors of the stage by its certificate, which correct the declared angles; `fixture_sigma_deg` is
        then the standard uncertainty of a declared angle without the uncertainty of these errors. None
        without a certificate.
    reading_u_mg : float or None
        Standard uncertainty of the reading of a dwell with a single sample; None if not stated.
    bias_instability_mg : float or None
        Measured level of this part's 1/f noise: the square root of its Allan variance. None: the figure of
        the data sheet, or no 1/f noise for a sensor without a data sheet.
    title, operator, serial, stage, laboratory, customer : str
        Name of the session, the operator, the sensor's serial number, the stage, and for a certificate the
        laboratory and the customer, as written down; each is kept as one printable line.
    source : str
        Name of the file from which the session was read; empty without a file.
    notes : tuple of str
        Remarks of the reader of the file, one line each (segmentation, an unfinished session).
    cut_by_stillness : bool
        True if the dwells were cut out of a continuous recording, so that rest is not declared.
    recording : Dwell or None
        All samples of a file that has samples between its dwells, as one dwell; None for other files.
    free_turn : bool
        True if the recording is one turn without declared angles; there may then be no dwells.
    facts : mapping
        Other facts of the file by name (configuration, registers, versions, truth of a simulation).
    turns_from : callable or None
        Function that reads the turns between the dwells from the file; None if the file has none.
    """

    dwells: tuple[Dwell, ...]
    sensor: str = "adis16354"
    accel_unit: AccelUnit = "lsb"
    gyro_unit: GyroUnit = "dps"
    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    fixture_sigma_deg: float | None = None
    plane: Plane = "xy"
    stage_curve: StageCurve | None = None
    reading_u_mg: float | None = None
    bias_instability_mg: float | None = None
    title: str = ""
    operator: str = ""
    serial: str = ""
    stage: str = ""
    laboratory: str = ""
    customer: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    cut_by_stillness: bool = False
    recording: Dwell | None = field(default=None, repr=False)
    free_turn: bool = False
    facts: dict[str, Any] = field(default_factory=dict)
    turns_from: Callable[[], tuple[Turn, ...]] | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("title", *METADATA):
            object.__setattr__(self, name, one_line(getattr(self, name)))
        object.__setattr__(self, "notes", tuple(one_line(note) for note in self.notes))

    def __repr__(self) -> str:
        name = self.title or self.source or "untitled"
        samples = sum(len(dwell) for dwell in self.sampled)
        what = "a free turn" if self.free_turn else counted(len(self.dwells), "dwell")
        return f"Session({name}: {what}, {counted(samples, 'sample')}, {self.sensor})"

    @property
    def filter_m(self) -> int | None:
        """Exponent M of the chip's filter, two passes of 2^M taps; None if it is not known."""
        return (self.facts.get("configuration") or {}).get("filter_m")

    def to_pandas(self) -> pd.DataFrame:
        """Return all samples as a pandas data frame with the columns of the samples CSV (extra: pandas)."""
        from adis_gonio.base.tables import frame

        return frame({name: np.concatenate(parts) for name, parts in self.columns().items()})

    def columns(self) -> dict[str, list[NDArray[Any]]]:
        """Return the columns of the samples CSV that any dwell has, by name, as one array per dwell.

        For a dwell that does not state a fact, the column of this fact has NaN, 0 or `fit`. A free turn
        has no position.

        Raises
        ------
        DataError
            There is no dwell, or only some dwells have a series of samples, such as the gyros.
        """
        source = self.source or "session"
        if not self.sampled:
            raise DataError(f"{source}: the session has no dwell to write")
        each = [dwell.columns() for dwell in self.sampled]
        made: dict[str, list[NDArray[Any]]] = {}
        for name in dict.fromkeys(name for columns in each for name in columns):
            for dwell, columns in zip(self.sampled, each, strict=True):
                if name not in columns and name not in UNSTATED:
                    raise DataError(f"{source}: position {dwell.position} has no '{name}', others have")
                values = columns[name] if name in columns else np.full(len(dwell), UNSTATED[name])
                made.setdefault(name, []).append(values)
        if self.free_turn:
            del made["position"]
        return made

    @cached_property
    def turns(self) -> tuple[Turn, ...]:
        """Turns (samples between successive dwells), which are read from the file at the first access.

        Empty if the file has nothing between its dwells.
        """
        if self.turns_from is not None:
            here = {dwell.position for dwell in self.dwells}
            return tuple(turn for turn in self.turns_from() if {turn.before, turn.position} <= here)
        made = []
        if self.recording is not None and not self.free_turn:
            for before, after in pairwise(self.dwells):
                low = int(self.recording.time_s.searchsorted(before.time_s[-1], side="right"))
                high = int(self.recording.time_s.searchsorted(after.time_s[0], side="left"))
                series = self.recording.series(slice(low, max(low, high)))  # views of the rows
                made.append(Turn(before.position, after.position, turned_deg=after.turned_deg, **series))
        return tuple(made)

    @property
    def sampled(self) -> tuple[Dwell, ...]:
        """Dwells in the form for an export, in which the whole recording of a free turn is one dwell."""
        return (self.recording,) if self.free_turn and self.recording is not None else tuple(self.dwells)

    @property
    def free_attitudes(self) -> bool:
        """True if the declared angles carry no information (`fixture_sigma_deg` is infinite)."""
        return self.fixture_sigma_deg is not None and math.isinf(self.fixture_sigma_deg)

    @property
    def gravity_mg(self) -> float:
        """Local gravity in mg (thousandths of the standard 9.80665 m/s²)."""
        return 1000.0 * self.gravity_mps2 / STANDARD_GRAVITY_MPS2
