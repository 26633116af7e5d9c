"""What was measured, as plain data: samples, dwells, sessions. No files, no devices.

A *dwell* is the scans taken while the part is still in one *position*; a *session* is all dwells with
what surrounded them. Files become sessions in `adis_gonio.record`; fits read them in
`adis_gonio.fitting`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.computed_once import ComputedOnce
from adis_gonio.base.errors import one_line
from adis_gonio.base.numbers import counted

if TYPE_CHECKING:
    import pandas as pd

    from adis_gonio.model.turns import Turn

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

METADATA = ("operator", "serial", "stage")
"""Fields of a session that hold what the operator wrote down besides its title."""


@dataclass(frozen=True)
class Dwell:
    """Samples of one position.

    Attributes
    ----------
    position : int
        Number of the dwell in the session.
    time_s : (n,) float
        Time of each sample, increasing.
    accel : (n, 2) or (n, 3) float
        Accelerometer samples in `Session.accel_unit`.
    angle_deg : float or None
        Declared angle of the stage, positive for the rotation of the paper's equation 6; None unknown.
    approach : int
        Direction from which the position was reached, +1 or -1; 0 unknown.
    use : {"fit", "check"}
        `check` dwells take no part in a fit or in a choice of effects.
    gyro : (n, 3) float or None
        Gyro samples in `Session.gyro_unit`.
    temperature_c, supply_v : (n,) float or None
        Temperature in °C (of several thermometers their mean) and supply in V.
    temperatures_c : (n, 3) float or None
        Of the three gyros' dies, where all three were recorded.
    first_row : int or None
        Row of the file where the dwell begins, for messages.
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
    first_row: int | None = None
    temperatures_c: Floats | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def __repr__(self) -> str:
        angle = "no angle" if self.angle_deg is None else f"{self.angle_deg:g}°"
        return f"Dwell({self.position}: {angle}, {counted(len(self), 'sample')})"

    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns (n,) of the samples CSV that the dwell has; an angle that is not known is NaN."""
        n = len(self)
        made: dict[str, NDArray[Any]] = {
            "time_s": self.time_s,
            "position": np.full(n, self.position),
            "angle_deg": np.full(n, np.nan if self.angle_deg is None else self.angle_deg),
            "approach": np.full(n, self.approach),
            "use": np.full(n, self.use),
        }
        for letter, series in (("a", self.accel), ("g", self.gyro)):
            if series is not None:
                made |= {f"{letter}{axis}": series[:, k] for k, axis in enumerate("xyz"[: series.shape[1]])}
        if self.temperature_c is not None:
            made["temp_c"] = self.temperature_c
        if self.supply_v is not None:
            made["supply_v"] = self.supply_v
        return made


@dataclass(frozen=True)
class Session(ComputedOnce):
    """All dwells of a calibration with what surrounded them.

    Attributes
    ----------
    sensor : str
        `adis16354`, `adis16350`, `adis16355` or `generic`.
    accel_unit : str
        Unit of `Dwell.accel`; `counts` means an unknown scale and zero that the fit has to find.
    gravity_mps2 : float
        Local gravity in m/s².
    fixture_sigma_deg : float or None
        Standard uncertainty of a declared angle in degrees; `inf` where attitudes are free; None not
        stated.
    plane : {"xy", "none"}
        Plane of rotation, or none where attitudes are anywhere in space.
    reading_u_mg : float or None
        Standard uncertainty of a dwell that has one sample only.
    title, operator, serial, stage : str
        Name of the session, the operator, the part's serial number and the stage, as written down; each
        is kept as one printable line.
    source : str
        File that it came from.
    notes : tuple of str
        What the reader of the file has to tell, one line each (segmentation, an unfinished session).
    cut_by_stillness : bool
        True where the dwells were cut out of a continuous recording, so that nobody declared that the part
        was at rest.
    recording : Dwell or None
        The whole of a continuous recording, what lies between its dwells too.
    free_turn : bool
        True where that is one turn without declared angles; there may then be no dwells.
    facts : mapping
        Whatever else the file knows (configuration, registers, versions, truth of a simulation).
    turns_from : callable or None
        Reads the turns between the dwells as the file has them; None without any.
    """

    dwells: tuple[Dwell, ...]
    sensor: str = "adis16354"
    accel_unit: AccelUnit = "lsb"
    gyro_unit: GyroUnit = "dps"
    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    fixture_sigma_deg: float | None = None
    plane: Plane = "xy"
    reading_u_mg: float | None = None
    title: str = ""
    operator: str = ""
    serial: str = ""
    stage: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    cut_by_stillness: bool = False
    recording: Dwell | None = field(default=None, repr=False)
    free_turn: bool = False
    facts: dict[str, Any] = field(default_factory=dict)
    turns_from: Callable[[], tuple[Turn, ...]] | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("title", "operator", "serial", "stage"):
            object.__setattr__(self, name, one_line(getattr(self, name)))
        object.__setattr__(self, "notes", tuple(one_line(note) for note in self.notes))

    def __repr__(self) -> str:
        name = self.title or self.source or "untitled"
        samples = sum(len(dwell) for dwell in self.sampled)
        what = "a free turn" if self.free_turn else counted(len(self.dwells), "dwell")
        held = f"{what}, {counted(samples, 'sample')}"
        return f"Session({name}: {held}, {self.sensor})"

    def to_pandas(self) -> pd.DataFrame:
        """Samples as a data frame with the columns of the samples CSV (extra: pandas)."""
        from adis_gonio.base.tables import frame

        columns: dict[str, list[Any]] = {}
        for dwell in self.sampled:
            for name, rows in dwell.columns().items():
                columns.setdefault(name, []).append(rows)
        return frame(
            {name: np.concatenate(rows) for name, rows in columns.items() if len(rows) == len(self.sampled)}
        )

    @property
    def turns(self) -> tuple[Turn, ...]:
        """What lies between dwells that follow one another; read when first asked for.

        Empty where the file has nothing between its dwells, as a samples CSV with positions.
        """
        kept: tuple[Turn, ...] | None = vars(self).get("_turns")
        if kept is None:
            kept = self._read_turns()
            vars(self)["_turns"] = kept
        return kept

    def _read_turns(self) -> tuple[Turn, ...]:
        from adis_gonio.model.turns import turns_of_recording

        if self.turns_from is not None:
            here = {dwell.position for dwell in self.dwells}
            return tuple(turn for turn in self.turns_from() if {turn.before, turn.position} <= here)
        if self.recording is not None and not self.free_turn:
            return turns_of_recording(self.recording, self.dwells)
        return ()

    @property
    def sampled(self) -> tuple[Dwell, ...]:
        """What an export holds the samples of: the dwells, or a free turn as one."""
        return (self.recording,) if self.free_turn and self.recording is not None else tuple(self.dwells)

    @property
    def free_attitudes(self) -> bool:
        """True where declared angles carry no information."""
        return self.fixture_sigma_deg is not None and math.isinf(self.fixture_sigma_deg)

    @property
    def gravity_mg(self) -> float:
        """Local gravity in mg (thousandths of the standard 9.80665 m/s²)."""
        return 1000.0 * self.gravity_mps2 / STANDARD_GRAVITY_MPS2

    def used_for(self, use: Use) -> Session:
        """Session that holds only the dwells of one use."""
        return replace(self, dwells=tuple(dwell for dwell in self.dwells if dwell.use == use))
