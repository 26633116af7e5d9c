"""What is said of a position: its three angles, the names that could stand for it, and what to do.

Which positions are wrong, and how: the search over patterns, and what is said of those that stand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees, wrap_radians
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.uncertainty import CREDIBLE_SET
from adis_gonio.fitting.slips.position_evidence import (
    Beside,
    Detectability,
    ScatterPoint,
    Weighed,
    Whitened,
    scatters,
    weigh,
)
from adis_gonio.fitting.slips.position_faults import (
    ACCUSED,
    Name,
    Pattern,
    may_have_been_meant,
    patterns_of,
)
from adis_gonio.fitting.slips.position_model import (
    BASE,
    Angles,
    BelievedParameters,
    Rows,
    calibrated_by_length,
    rows_at,
)

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


CERTAIN = 0.99
"""Posterior from which a position is accused."""
MOST_FAULTS = 6
LARGEST = 120
"""Dwells beyond which a session is not looked at: the covariance of all rows is worked out as a whole."""
LEAST = 3
"""Dwells from which one can be wrong and the others right; with a gyro two."""
SETTLED_RAD = math.radians(0.5)
"""A calibration that moves the angles by less is not improved upon: its square is 0.004°."""


@dataclass(frozen=True)
class Diagnosis:
    """What the three angles say of a session.

    Attributes
    ----------
    findings : tuple of PositionFinding
        Accused positions, in their order.
    scatter_deg : float
        Standard deviation of a position, beyond what was found.
    sight : Detectability or None
        What would have been seen; None where nothing was looked at.
    """

    findings: tuple[PositionFinding, ...] = ()
    scatter_deg: float = math.nan
    sight: Detectability | None = field(default=None, repr=False, compare=False)

    def detectable_deg(self, name: Name = "slipped") -> dict[int, float]:
        """Smallest error of a name at each position that is accused with 99 % power; inf: none is."""
        return {} if self.sight is None else self.sight.detectable_deg(name, CERTAIN)

    @property
    def sentences(self) -> tuple[str, ...]:
        """One line each, swaps once."""
        said: dict[tuple[object, ...], str] = {}
        for found in self.findings:
            key = (found.finding, *sorted((found.position, *found.others)))
            said.setdefault(key, found.sentence)
        return tuple(said.values())


def diagnose(angles: Angles) -> Diagnosis:
    """Weigh every fault of `faults` on every position; name those that are certain."""
    if not _enough(angles):
        return Diagnosis()
    grid = scatters(angles.fixture_rad)
    calibration = calibrated_by_length(angles)
    rows = rows_at(angles, calibration)
    accepted, last = _search(rows, grid)
    moved = _recalibrated(rows, calibration, accepted, last.scatter)
    if _apart(rows, calibration, moved) > SETTLED_RAD:
        rows = rows_at(angles, moved)
        accepted, last = _search(rows, grid)
    findings = _findings(angles, rows, grid, accepted)
    return Diagnosis(
        tuple(sorted(findings, key=lambda found: found.position)),
        math.degrees(last.scatter.position_rad),
        Detectability(angles.position, rows, tuple(grid), Beside.of(rows, accepted)),
    )


def _enough(angles: Angles) -> bool:
    declared = int(np.isfinite(angles.declared_rad).sum())
    watched = angles.turns is not None and bool(np.isfinite(angles.turns.angle_rad).any())
    return LEAST - watched <= declared and len(angles) <= LARGEST


def _search(rows: Rows, grid: Sequence[ScatterPoint]) -> tuple[list[Pattern], Weighed]:
    """Faults one after another, the most probable first, until none more is probable."""
    accepted: list[Pattern] = []
    while True:
        beside = Beside.of(rows, accepted)
        patterns = _others(patterns_of(rows, beside.error_rad), accepted)
        weighed = weigh(rows, grid, patterns, beside)
        best = weighed.best
        if best is None or len(accepted) == MOST_FAULTS:
            return accepted, weighed
        accepted.append(patterns[best[0]])


def _others(patterns: Sequence[Pattern], accepted: Sequence[Pattern]) -> list[Pattern]:
    """Patterns that no accepted one holds already."""
    taken = {(p.name, p.dwells) for p in accepted}
    return [p for p in patterns if (p.name, p.dwells) not in taken]


def _recalibrated(
    rows: Rows, calibration: BelievedParameters, accepted: Sequence[Pattern], scatter: ScatterPoint
) -> BelievedParameters:
    mean, _ = _posterior(rows, accepted, scatter)
    return calibration.moved(mean[1 : 1 + BASE])


def _apart(rows: Rows, one: BelievedParameters, other: BelievedParameters) -> float:
    """Most that two calibrations differ in an angle."""
    step = other.values - one.values
    return float(np.abs(rows.design[: len(rows), 1 : 1 + BASE] @ step).max())


def _posterior(rows: Rows, accepted: Sequence[Pattern], scatter: ScatterPoint) -> tuple[Floats, Floats]:
    """Mean (p + q,) and covariance of all columns' values."""
    beside = Beside.of(rows, accepted)
    white = Whitened(rows, scatter, beside.known)
    z = white.white(white.mean_of(beside.left(rows)[:, None]))[:, 0]
    spread = white.white(white.design * white.prior_sd**2)
    mean = spread.T @ z
    mean[: len(rows.prior_mean)] += rows.prior_mean
    return mean, np.diag(white.prior_sd**2) - spread.T @ spread


# -- what is said --------------------------------------------------------------------------------------


def _findings(
    angles: Angles, rows: Rows, grid: Sequence[ScatterPoint], accepted: Sequence[Pattern]
) -> list[PositionFinding]:
    found = []
    for pattern in accepted:
        if pattern.name not in ACCUSED:
            continue
        rest = [other for other in accepted if other is not pattern]
        beside = Beside.of(rows, rest)
        patterns = _others(patterns_of(rows, beside.error_rad), rest)
        weighed = weigh(rows, grid, patterns, beside)
        if weighed.best is None:
            continue
        accusing = [v for (_, name), v in weighed.named.items() if name in ACCUSED]
        total = np.logaddexp.reduce([weighed.none, *weighed.named.values()])
        probability = float(np.exp(np.logaddexp.reduce(accusing) - total))
        number, name = weighed.likeliest
        if probability < CERTAIN or name not in ACCUSED:
            continue
        chosen = patterns[number]
        names = _set_of_names(angles.position, patterns, weighed)
        speaker = _Speaker(angles, rows, [*rest, chosen], chosen, weighed.scatter)
        found += speaker.findings(name, probability, names)
    return _once(found)


def _once(found: Sequence[PositionFinding]) -> list[PositionFinding]:
    """Each position under each name once."""
    return list({(one.position, one.finding): one for one in found}.values())


def _set_of_names(
    position: Sequence[int], patterns: Sequence[Pattern], weighed: Weighed
) -> tuple[Named, ...]:
    """Names by their share of what accuses, the smallest set that holds 95 % of it."""
    accusing = {key: value for key, value in weighed.named.items() if key[1] in ACCUSED}
    total = np.logaddexp.reduce(list(accusing.values()))
    ordered = sorted(accusing.items(), key=lambda item: -item[1])
    held, kept = 0.0, []
    for (k, name), value in ordered:
        share = math.exp(value - total)
        kept.append(Named(name, tuple(position[j] for j in patterns[k].dwells), share))
        held += share
        if held >= CREDIBLE_SET:
            break
    return tuple(kept)


@dataclass(frozen=True)
class _Speaker:
    """Says where the accused positions of one pattern stood, given all that was found."""

    angles: Angles
    rows: Rows
    accepted: list[Pattern]
    pattern: Pattern
    scatter: ScatterPoint

    @property
    def _beside(self) -> Beside:
        return Beside.of(self.rows, self.accepted)

    def findings(self, name: Name, probability: float, names: tuple[Named, ...]) -> list[PositionFinding]:
        mean, covariance = _posterior(self.rows, self.accepted, self.scatter)
        error = self._error(mean, covariance)
        return [self._finding(k, name, probability, names, mean, covariance, error)
                for k in self.pattern.dwells]  # fmt: skip

    def _error(self, mean: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """E (n,) by the patterns, and the variance of the one free amplitude of this pattern's."""
        error, first = self._beside.error_rad.copy(), len(self.rows.prior_mean)
        variance = 0.0
        for p in self.accepted:
            q = p.columns.shape[1]
            if q == 1:
                error += p.unit * mean[first]
                if p is self.pattern:
                    variance = float(covariance[first, first])
            first += q
        return error, np.array(variance)

    def _finding(
        self,
        k: int,
        name: Name,
        probability: float,
        names: tuple[Named, ...],
        mean: Floats,
        covariance: Floats,
        error: tuple[Floats, Floats],
    ) -> PositionFinding:
        number = self.angles.position
        declared = _degrees(self.rows.declared_rad[k])
        gravity = self._gravity(k, mean, covariance)
        gyro = self._gyro(k, mean, covariance, error[0])
        stood = _together([gravity, gyro])
        if name == "gravity_wrong":
            stood = gyro or (0.0, math.degrees(self.scatter.position_rad))
        size = stood
        if name in ("slipped", "reversed"):
            size = (math.degrees(error[0][k]), math.degrees(math.sqrt(max(float(error[1]), 0.0))))
        others = [number[j] for j in self.pattern.dwells if j != k]
        if name in ("slipped", "reversed"):
            others = list(number[k + 1 :])
        return PositionFinding(
            number[k],
            name,
            declared if self.rows.declared[k] else None,
            _at(declared, gravity),
            None if gyro is None else _at(declared, gyro),
            _at(declared, stood),
            size,
            self._meant(k, name, declared, stood),
            tuple(others),
            probability,
            names,
        )

    def _meant(self, k: int, name: Name, declared: float, stood: Angle) -> float | None:
        """What was meant: of a swap the other's angle, else what is on the list or whole and near."""
        if name == "swapped":
            other = next(j for j in self.pattern.dwells if j != k)
            return _degrees(self.rows.declared_rad[other])
        if name != "mistyped":
            return None
        others = [
            _degrees(v) for j, v in enumerate(self.rows.declared_rad) if self.rows.declared[j] and j != k
        ]
        near = 3 * math.hypot(stood[1], math.degrees(self.scatter.position_rad))
        angle = declared + stood[0]
        for candidates in (may_have_been_meant(declared, others), (float(round(angle)),)):
            off = {c: abs(wrap_degrees(c - angle)) for c in candidates}
            good = [c for c in candidates if off[c] < near]
            if good:
                # Of 270 and -90 the one that is among the others.
                return min(good, key=lambda c: (_outside(c, others), off[c]))
        return None

    def _gravity(self, k: int, mean: Floats, covariance: Floats) -> Angle:
        """E by the reading alone, with the calibration by all others, in degrees."""
        rows, beside = self.rows, self._beside
        columns = rows.design[k]
        p = len(columns)
        about = wrap_radians(rows.seen_rad[k] + beside.error_rad[k] - beside.zero_rad)
        e = beside.error_rad[k] - (about - float(columns @ mean[:p]))
        own = float(rows.noise[k, k]) + self.scatter.reading**2
        u = math.sqrt(own + float(columns @ covariance[:p, :p] @ columns))
        return math.degrees(float(wrap_radians(np.array(e)))), math.degrees(u)

    def _gyro(self, k: int, mean: Floats, covariance: Floats, error: Floats) -> Angle | None:
        """E by the turn from the dwell before, or to the one after where that was not watched."""
        rows, n = self.rows, len(self.rows)
        for dwell, sign in ((k, 1.0), (k + 1, -1.0)):
            found = np.flatnonzero(rows.turn == dwell)
            if not found.size:
                continue
            row = 2 * n + int(found[0])
            columns = rows.design[row]
            p = len(columns)
            start = error[dwell - 1] if sign > 0 else error[dwell]
            asked = rows.declared_rad[dwell] - rows.declared_rad[dwell - 1]
            turned = float(rows.gyro_rad[int(found[0])] - columns @ mean[:p])
            e = start + sign * (turned - asked)
            spread = float(rows.noise[row, row]) + self.scatter.position_rad**2
            u = math.sqrt(spread + float(columns @ covariance[:p, :p] @ columns))
            return math.degrees(float(wrap_radians(np.array(e)))), math.degrees(u)
        return None


def _degrees(angle_rad: float) -> float:
    return round(math.degrees(angle_rad), 9)


def _outside(angle_deg: float, others_deg: Sequence[float]) -> float:
    """How far an angle lies outside of the range of others."""
    return max(0.0, min(others_deg) - angle_deg, angle_deg - max(others_deg))


def _together(found: Sequence[Angle | None]) -> Angle:
    """Weighted mean of angles in degrees, on the turn of the first."""
    known = [one for one in found if one is not None]
    weights = np.array([1 / max(u, 1e-6) ** 2 for _, u in known])
    first = known[0][0]
    values = np.array([first + wrap_degrees(value - first) for value, _ in known])
    return float((weights * values).sum() / weights.sum()), float(1 / math.sqrt(weights.sum()))


def _at(declared_deg: float, error: Angle) -> Angle:
    return declared_deg + error[0], error[1]
