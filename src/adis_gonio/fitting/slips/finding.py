"""What is said of a position: its three angles, the names that could stand for it, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.fitting.slips.faults import Name

Angle = tuple[float, float]
"""An angle and its standard uncertainty in degrees."""

MEANINGS: dict[Name, str] = {
    "mistyped": "mistyped",
    "misset": "the stage was set or slipped there, in this position alone",
    "swapped": "swapped",
    "slipped": "the part slipped in its fixture (or the stage's scale on its axis)",
    "reversed": "the stage counts the other way",
    "gravity_wrong": "the reading is wrong: the part was pushed or tilted",
    "gyro_wrong": "the gyro lost this turn",
}

SIZED: frozenset[Name] = frozenset({"mistyped", "misset", "slipped"})
"""Names of one error, which has a size."""


@dataclass(frozen=True)
class Named(JsonRecord):
    """One name of a set.

    The JSON document is one entry of `names`.

    Attributes
    ----------
    positions : tuple of int
        That it accuses; of what lasts the first one.
    probability : float
        Of all that may be wrong here.
    """

    name: Name
    positions: tuple[int, ...]
    probability: float


@dataclass(frozen=True)
class PositionFinding:
    """One position that is not where it was declared, or whose reading is wrong.

    Attributes
    ----------
    position : int
        Number of the dwell; of what lasts the first one.
    finding : Name
        The most probable name.
    declared_deg : float or None
        None where no angle is declared.
    gravity_deg, gyro_deg : Angle or None
        By the reading with the session's own calibration, and by the turn from the dwell before; None
        without one. Calibration and neighbours are those that remain when what was found is set aside.
    angle_deg : Angle
        Both together: where the part stood.
    error_deg : Angle
        How much more than declared.
    meant_deg : float or None
        What the entry should have said, where hands make the declared angle of it.
    others : tuple of int
        Other positions that the same fault touches: the second of a swap, all that follow a slip.
    probability : float
        That something is wrong here.
    names : tuple of Named
        The smallest set of names that holds 95 % of it, the most probable first; what an error of the first
        or the last position does, a slip beside it does as well.
    """

    position: int
    finding: Name
    declared_deg: float | None
    gravity_deg: Angle
    gyro_deg: Angle | None
    angle_deg: Angle
    error_deg: Angle
    meant_deg: float | None
    others: tuple[int, ...]
    probability: float
    names: tuple[Named, ...]

    @property
    def correction(self) -> str | None:
        """Value of `--angles` that mends the session; None where the position has to be repeated."""
        match self.finding:
            case "swapped":
                return (
                    f"{self.position}={_plain(self.meant_deg)},{self.others[0]}={_plain(self.declared_deg)}"
                )
            case "mistyped" | "misset":
                value = self.angle_deg[0] if self.meant_deg is None else self.meant_deg
                return f"{self.position}={_plain(value)}"
            case "slipped":
                return f"{_range(self.position, self.others)}+={_plain(self.error_deg[0])}"
            case "reversed":
                return f"{_range(self.position, self.others)}=reverse"
        return None

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        where = f"position {self.position}"
        declared = "" if self.declared_deg is None else f"declared {self.declared_deg:g}°, "
        if self.finding == "gravity_wrong":
            return (
                f"{where}: {declared}gravity says {_stated(self.gravity_deg)}{self._gyro_agrees}: "
                f"{self._named}; repeat it, or leave it out"
            )
        if self.finding == "slipped":
            stands = f"{where} stands {_signed(self.error_deg)} from where it is"
            if self.others:
                those = f"positions {self.position} to {self.others[-1]}"
                stands = f"{those} stand {_signed(self.error_deg)} from where they are"
            repeat = "repeat them" if self.others else "repeat it"
            return (
                f"{stands} declared by {self._sources}: {self._named}; clamp the part and {repeat},"
                f" or give --angles {self.correction}"
            )
        if self.finding == "reversed":
            return (
                f"from position {self.position} on the part turned against the declared angles by "
                f"{self._sources}: {self._named}; correct the file or give --angles {self.correction}"
            )
        said = f"{where}: {declared}{self._sources} {self._say} {_stated(self.angle_deg)}: {self._named}"
        if self.finding == "swapped":
            said += f" with position {self.others[0]}"
        return f"{said}; correct the file or give --angles {self.correction}"

    @property
    def _sources(self) -> str:
        return "gravity" if self.gyro_deg is None else "gravity and gyro"

    @property
    def _say(self) -> str:
        return "says" if self.gyro_deg is None else "say"

    @property
    def _gyro_agrees(self) -> str:
        return "" if self.gyro_deg is None else f", the gyro {_stated(self.gyro_deg)}"

    @property
    def _named(self) -> str:
        """The name that stands first, then the others of the set, with places where they are others."""
        # One angle that is off from all others, or all others from it.
        by = f"by {_signed((-self.error_deg[0], self.error_deg[1]))}"
        own, elsewhere = [_meaning(self.finding, self.position)], dict[int, list[str]]()
        for named in self.names:
            if named.name == self.finding:
                continue
            place = self.position if self.position in named.positions else named.positions[0]
            text = _meaning(named.name, place)
            if place == self.position or named.name not in SIZED:
                own.append(text)
            elif named.name == "slipped":
                own.append(f"{text}, {by}")
            else:
                elsewhere.setdefault(place, []).append(text.split(",")[0])
        own += [f"position {k} alone {by}: {' or '.join(texts)}" for k, texts in elsewhere.items()]
        return ", or ".join(dict.fromkeys(own))

    def as_dict(self) -> dict[str, Any]:
        """One entry of `positions`."""
        gyro = self.gyro_deg
        return {
            "position": self.position,
            "finding": self.finding,
            "declared_deg": self.declared_deg,
            "gravity_deg": self.gravity_deg[0],
            "gravity_u_deg": self.gravity_deg[1],
            "gyro_deg": None if gyro is None else gyro[0],
            "gyro_u_deg": None if gyro is None else gyro[1],
            "angle_deg": self.angle_deg[0],
            "angle_u_deg": self.angle_deg[1],
            "error_deg": self.error_deg[0],
            "error_u_deg": self.error_deg[1],
            "meant_deg": self.meant_deg,
            "others": list(self.others),
            "probability": self.probability,
            "names": [name.as_dict() for name in self.names],
            "angles": self.correction,
            "sentence": self.sentence,
        }


def listed(findings: Sequence[PositionFinding]) -> dict[str, Any]:
    """The key `positions` of a result's JSON; nothing where nothing was found."""
    return {"positions": [found.as_dict() for found in findings]} if findings else {}


def _meaning(name: Name, position: int) -> str:
    return MEANINGS[name] + (f" before position {position}" if name == "slipped" else "")


def _range(first: int, others: tuple[int, ...]) -> str:
    return f"{first}-{others[-1]}" if others else str(first)


def _plain(value: float | None) -> str:
    return "" if value is None else f"{round(value, 3):g}"


def _stated(angle: Angle) -> str:
    return f"{angle[0]:.2f}° ± {max(angle[1], 0.005):.2f}°"


def _signed(angle: Angle) -> str:
    return f"{angle[0]:+.2f}° ± {max(angle[1], 0.005):.2f}°"
