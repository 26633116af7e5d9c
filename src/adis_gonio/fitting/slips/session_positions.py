"""Find wrong positions of a session: reduce it to angles, search for faults, report them.

A fault is an error that makes the angle or the reading of a position wrong, such as a slip of the part. The
input are the declared angles of a session, its readings, and its gyro turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees, wrap_radians
from adis_gonio.base.errors import DataError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import format_uncertain
from adis_gonio.base.uncertainty import CREDIBLE_SET, NORMAL_95, Value
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.gyros import turn_integration
from adis_gonio.fitting.gyros.gyro_readings import GyroDwells, gyro_dwells_of
from adis_gonio.fitting.slips.position_model import (
    ACCUSED,
    BASE,
    Increments,
    Name,
    Pattern,
    Rows,
    ScatterPoint,
    Weighed,
    Whitened,
    calibrate_by_length,
    combined,
    patterns_of,
    possible_entries,
    rows_at,
    scatters,
    weigh,
)
from adis_gonio.model.records import Session

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
"""Names of faults that have one free size: an error of one position, or of a position and all later
ones."""


class Named(JsonRecord):
    """One possible cause of an error, with its positions and probability.

    The JSON document is one entry of `names`.

    Attributes
    ----------
    name : Name
        Name of the cause.
    positions : tuple of int
        Positions with the error; for a lasting change the first one.
    probability : float
        Share of this cause in the probability of all faults that make a position wrong.
    """

    name: Name
    positions: tuple[int, ...]
    probability: float


@dataclass(frozen=True)
class PositionFinding:
    """A position that differs from its declared angle, or has a wrong reading.

    Attributes
    ----------
    position : int
        Number of the dwell; for a lasting change the first one.
    finding : Name
        Name of the most probable cause.
    declared_deg : float or None
        Declared angle; None if there is none.
    gravity_deg, gyro_deg : Angle or None
        Angle of the part by its reading with the session's own calibration, and by the gyro's turn from the
        dwell before; the second is None without a gyro. The accepted faults are removed from the
        calibration and from the dwell before.
    angle_deg : Angle
        Angle of the part by gravity and gyro together.
    error_deg : Angle
        Angle of the part minus the declared angle.
    meant_deg : float or None
        Angle that was probably meant, if the declared angle is a usual typing error of it; otherwise None.
    others : tuple of int
        Other positions of the same fault: the second of a swap, all later ones of a slip.
    probability : float
        Probability that this position has a fault.
    names : tuple of Named
        The smallest set of names with 95 % of that probability, the most probable first. An error of the
        first or the last position has the same effect as a slip next to it.
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
        """Value for the option `--angles` that corrects the declared angles.

        None if one or two angles do not correct the session, so that positions must be measured again.
        """
        match self.finding:
            case "swapped":
                return (
                    f"{self.position}={_plain(self.meant_deg)},{self.others[0]}={_plain(self.declared_deg)}"
                )
            case "mistyped" | "misset":
                value = self.angle_deg[0] if self.meant_deg is None else self.meant_deg
                return f"{self.position}={_plain(value)}"
        return None

    @property
    def sentence(self) -> str:
        """One sentence for the user: the suspected error of the position, and its remedy."""
        where = f"position {self.position}"
        declared = "" if self.declared_deg is None else f"declared {self.declared_deg:g}°, "
        sources = "gravity" if self.gyro_deg is None else "gravity and gyro"
        correct = f"correct the file or give --angles {self.correction}"
        match self.finding:
            case "gravity_wrong":
                gyro = "" if self.gyro_deg is None else f", {_stated(self.gyro_deg)} by the gyro"
                return (
                    f"{where}: {declared}{_stated(self.gravity_deg)} by gravity{gyro}: "
                    f"{self._named}; repeat it, or leave it out"
                )
            case "slipped":
                off = f"{where} is {_signed(self.error_deg)} from its declared angle"
                if self.others:
                    those = f"positions {self.position} to {self.others[-1]}"
                    off = f"{those} are {_signed(self.error_deg)} from their declared angles"
                repeat = "repeat them" if self.others else "repeat it"
                return f"{off} by {sources}: {self._named}; clamp the part and {repeat}"
            case "reversed":
                return (
                    f"from position {self.position} on the part turned against the declared angles by "
                    f"{sources}: {self._named}; correct the file or repeat them"
                )
        text = f"{where}: {declared}{_stated(self.angle_deg)} by {sources}: {self._named}"
        if self.finding == "swapped":
            text += f" with position {self.others[0]}"
        return f"{text}; {correct}"

    @property
    def _named(self) -> str:
        """Text with the most probable cause, then the other possible causes at this or another position."""
        # If one angle differs from all others, all others differ from it by the opposite.
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
        """Return one entry of the JSON list `positions`."""
        document: dict[str, Any] = {
            "position": self.position, "finding": self.finding, "declared_deg": self.declared_deg
        }  # fmt: skip
        for name in ("gravity", "gyro", "angle", "error"):
            value, u = getattr(self, f"{name}_deg") or (None, None)
            document |= {f"{name}_deg": value, f"{name}_u_deg": u}
        return document | {
            "meant_deg": self.meant_deg,
            "others": list(self.others),
            "probability": self.probability,
            "names": [name.as_dict() for name in self.names],
            "angles": self.correction,
            "sentence": self.sentence,
        }


def listed(findings: Sequence[PositionFinding]) -> dict[str, Any]:
    """Return the entry `positions` of a JSON result, as a mapping; empty if no position is suspected."""
    return {"positions": [found.as_dict() for found in findings]} if findings else {}


def _meaning(name: Name, position: int) -> str:
    return MEANINGS[name] + (f" before position {position}" if name == "slipped" else "")


def _plain(value: float | None) -> str:
    return "" if value is None else f"{round(value, 3):g}"


def _stated(angle: Angle) -> str:
    return str(Value(*angle, "deg"))


def _signed(angle: Angle) -> str:
    return format_uncertain(angle[0], NORMAL_95 * angle[1], "deg", sign=True)


CERTAIN = 0.99
"""Posterior probability of a fault from which a position is reported."""
MOST_FAULTS = 6
LARGEST = 120
"""Largest number of dwells in which wrong positions are searched, because the covariance of all rows is
computed."""
LEAST = 3
"""Smallest number of declared dwells of which one can be recognised as wrong; with a gyro one less is
enough."""
SETTLED_RAD = math.radians(0.5)
"""Largest change of an angle, in rad, by a second calibration, at which the search is not repeated: the
square of the change is 0.004°."""


def sentences_of(findings: Iterable[PositionFinding]) -> tuple[str, ...]:
    """Return sentences for the user, one for each wrong position; two swapped positions share one."""
    lines: dict[tuple[object, ...], str] = {}
    for found in findings:
        key = (found.finding, *sorted((found.position, *found.others)))
        lines.setdefault(key, found.sentence)
    return tuple(lines.values())


def diagnose(readings: Readings, turns: Increments) -> tuple[PositionFinding, ...]:
    """Compute the probability of every fault at every position, and report the probable faults in order.

    A fault is reported if its probability is at least `CERTAIN`. The kinds of faults are listed in
    `position_model`. There are no findings with fewer than `LEAST` declared angles (one less with a gyro)
    or more than `LARGEST` dwells.
    """
    found = search_faults(readings, turns)
    findings = [] if found is None else _findings(readings.position.tolist(), found)
    return tuple(sorted(findings, key=lambda one: one.position))


class FaultSearch(NamedTuple):
    """Faults that were accepted in the search for wrong positions, with the model that they belong to.

    `rows` is the linear model of the session, `grid` the assumptions on its ordinary errors, `accepted` the
    faults, and `scatter` the most probable one of these assumptions after the last accepted fault.
    """

    rows: Rows
    grid: list[ScatterPoint]
    accepted: list[Pattern]
    scatter: ScatterPoint


def search_faults(readings: Readings, turns: Increments) -> FaultSearch | None:
    """Search for faults, and calibrate without them; None with too few or too many angles (`diagnose`)."""
    declared = int(np.isfinite(readings.angle_rad).sum())
    if declared < LEAST - (len(turns.turn) > 0) or len(readings) > LARGEST:
        return None
    grid = scatters(readings.fixture_rad if readings.fixture_stated else None, gyro=len(turns.turn) > 0)
    calibration = calibrate_by_length(readings)
    rows = rows_at(readings, turns, calibration)
    accepted, last = _search(rows, grid)
    # Calibrate again without the accepted faults, and repeat the search if that changes any angle.
    step = _posterior(rows, accepted, last.scatter)[0][1 : 1 + BASE]
    if float(np.abs(rows.design[: len(rows), 1 : 1 + BASE] @ step).max()) > SETTLED_RAD:
        rows = rows_at(readings, turns, calibration + step)
        accepted, last = _search(rows, grid)
    return FaultSearch(rows, grid, accepted, last.scatter)


def _search(rows: Rows, grid: Sequence[ScatterPoint]) -> tuple[list[Pattern], Weighed]:
    """Accept faults one after another, the most probable first, while a fault is more probable than none.

    Return the accepted faults, and the probabilities of further faults after the last one.
    """
    accepted: list[Pattern] = []
    while True:
        patterns, weighed = _weigh_others(rows, grid, accepted)
        if weighed.best is None or len(accepted) == MOST_FAULTS:
            return accepted, weighed
        accepted.append(patterns[weighed.best])


def _weigh_others(
    rows: Rows, grid: Sequence[ScatterPoint], accepted: Sequence[Pattern]
) -> tuple[list[Pattern], Weighed]:
    """List the faults that are possible in addition to the accepted ones, with their probabilities."""
    known = combined(rows, accepted)
    taken = {(p.name, p.dwells) for p in accepted}
    patterns = [p for p in patterns_of(rows, known.error_rad) if (p.name, p.dwells) not in taken]
    return patterns, weigh(rows, grid, patterns, known)


def _posterior(rows: Rows, accepted: Sequence[Pattern], scatter: ScatterPoint) -> tuple[Floats, Floats]:
    """Return the posterior mean (p + q,) and covariance of the calibration and the sizes of faults.

    There are p calibration parameters and q sizes of the `accepted` faults; `scatter` are the standard
    deviations of the ordinary errors.
    """
    known = combined(rows, accepted)
    white = Whitened.of(rows, scatter, known.columns)
    residual = rows.observed(known.error_rad, known.zero_rad)
    z = white.white(residual - rows.design @ rows.prior_mean)
    # Posterior of a linear Gaussian model: prior covariance times design, whitened.
    spread = white.white(white.design * white.prior_sd**2)
    mean = spread.T @ z
    mean[: len(rows.prior_mean)] += rows.prior_mean
    return mean, np.diag(white.prior_sd**2) - spread.T @ spread


# -- findings ------------------------------------------------------------------------------------------


def _findings(position: Sequence[int], search: FaultSearch) -> list[PositionFinding]:
    """Return the findings on accepted faults for which a declared angle or a reading is to blame.

    The probability of each fault is computed as if it were the last to be found.
    """
    rows, grid, accepted, _ = search
    found: dict[tuple[int, Name], PositionFinding] = {}
    for pattern in accepted:
        if pattern.name not in ACCUSED:
            continue
        # Weigh all patterns again as if this one were the last to be found.
        rest = [other for other in accepted if other is not pattern]
        patterns, weighed = _weigh_others(rows, grid, rest)
        if weighed.best is None:
            continue
        accusing = [v for (_, name), v in weighed.named.items() if name in ACCUSED]
        # Posterior probability of all accusing patterns together.
        total = np.logaddexp.reduce([weighed.none, *weighed.named.values()])
        probability = float(np.exp(np.logaddexp.reduce(accusing) - total))
        number, name = max(weighed.named, key=weighed.named.__getitem__)
        if probability < CERTAIN or name not in ACCUSED:
            continue
        chosen = patterns[number]
        names = _set_of_names(position, patterns, weighed)
        account = _FaultErrors(position, rows, (*rest, chosen), chosen, weighed.scatter)
        for k in chosen.dwells:
            one = account.finding(k, name, probability, names)
            found[one.position, one.finding] = one
    return list(found.values())


def _set_of_names(
    position: Sequence[int], patterns: Sequence[Pattern], weighed: Weighed
) -> tuple[Named, ...]:
    """Return the most probable faults with their probabilities, as a 95 % credible set.

    `position` are the numbers of the dwells. The probabilities are relative to all faults that make a
    position wrong.
    """
    accusing = {key: value for key, value in weighed.named.items() if key[1] in ACCUSED}
    total = np.logaddexp.reduce(list(accusing.values()))
    ordered = sorted(accusing.items(), key=lambda item: -item[1])
    shares = np.exp([value - total for _, value in ordered])
    last = int(np.searchsorted(np.cumsum(shares), CREDIBLE_SET))
    return tuple(
        Named(name, tuple(position[j] for j in patterns[k].dwells), float(share))
        for ((k, name), _), share in zip(ordered[: last + 1], shares, strict=False)
    )


@dataclass(frozen=True)
class _FaultErrors:
    """Computes the error of each position that one fault (`pattern`) affects, given all accepted faults.

    `rows` are the linear model and `scatter` the standard deviations of the ordinary errors.
    """

    position: Sequence[int]
    rows: Rows
    accepted: tuple[Pattern, ...]
    pattern: Pattern
    scatter: ScatterPoint

    @cached_property
    def known(self) -> Pattern:
        """All accepted faults as one pattern."""
        return combined(self.rows, self.accepted)

    @cached_property
    def posterior(self) -> tuple[Floats, Floats]:
        """Posterior mean (p + q,) and covariance of the calibration parameters and the sizes of faults."""
        return _posterior(self.rows, self.accepted, self.scatter)

    @cached_property
    def error(self) -> tuple[Floats, float]:
        """Error (n,) of each position by the accepted faults, in rad, and u of the size of this fault.

        The u is 0 unless the size of this fault is a single free number.
        """
        error, first = self.known.error_rad.copy(), len(self.rows.prior_mean)
        mean, covariance = self.posterior
        u = 0.0
        for p in self.accepted:
            q = p.columns.shape[1]
            # Only patterns with one free amplitude have an error of unknown size.
            if q == 1:
                error += p.unit * mean[first]
                if p is self.pattern:
                    u = math.sqrt(max(float(covariance[first, first]), 0.0))
            first += q
        return error, u

    def finding(self, k: int, name: Name, probability: float, names: tuple[Named, ...]) -> PositionFinding:
        """Return the finding for the position with index k: its error and its possible causes.

        `probability` is the probability of a fault there, `name` the most probable cause, and `names` are
        all probable causes.
        """
        declared = _degrees(self.rows.declared_rad[k])
        rows, errors = self.rows, self.known
        # The error by the reading, calibrated by all positions, given the accepted faults.
        about = wrap_radians(rows.seen_rad[k] + errors.error_rad[k] - errors.zero_rad)
        by_reading = errors.error_rad[k] - (about - self._model(k))
        gravity = self._stated(by_reading, k, float(rows.noise[k, k]) + self.scatter.reading**2)
        gyro = self._gyro(k)
        # Mean weighted by u, with the angle of the gyro within half a turn of the other.
        known = [gravity] if gyro is None else [gravity, gyro]
        weights = np.array([1 / max(u, 1e-6) ** 2 for _, u in known])
        values = gravity[0] + np.array([wrap_degrees(value - gravity[0]) for value, _ in known])
        actual = float(weights @ values / weights.sum()), float(1 / math.sqrt(weights.sum()))
        if name == "gravity_wrong":
            actual = gyro or (0.0, math.degrees(self.scatter.position_rad))
        size = actual
        others = [self.position[j] for j in self.pattern.dwells if j != k]
        if name in ("slipped", "reversed"):
            size = math.degrees(self.error[0][k]), math.degrees(self.error[1])
            others = list(self.position[k + 1 :])

        def at(error: Angle) -> Angle:
            return declared + error[0], error[1]

        return PositionFinding(
            self.position[k],
            name,
            declared if self.rows.declared[k] else None,
            at(gravity),
            None if gyro is None else at(gyro),
            at(actual),
            size,
            self._intended(k, name, declared, actual),
            tuple(others),
            probability,
            names,
        )

    def _intended(self, k: int, name: Name, declared: float, actual: Angle) -> float | None:
        """Return the angle in degrees that the operator probably meant to enter; None if unknown.

        The position has the index k, and `actual` is the estimated error of the declared angle. For swapped
        positions the result is the declared angle of the other position. For a typing error it is the
        nearest angle on the list of usual angles, else a whole degree.
        """
        if name == "swapped":
            other = next(j for j in self.pattern.dwells if j != k)
            return _degrees(self.rows.declared_rad[other])
        if name != "mistyped":
            return None
        others = [
            _degrees(v) for j, v in enumerate(self.rows.declared_rad) if self.rows.declared[j] and j != k
        ]
        near = 3 * math.hypot(actual[1], math.degrees(self.scatter.position_rad))
        angle = declared + actual[0]
        for candidates in (possible_entries(declared, others), (float(round(angle)),)):
            off = {c: abs(wrap_degrees(c - angle)) for c in candidates}
            good = [c for c in candidates if off[c] < near]
            if good:
                # Of 270 and -90 the one within the range of the others, or closest to it.
                low, high = min(others), max(others)
                return min(good, key=lambda c: (max(0.0, low - c, c - high), off[c]))
        return None

    def _stated(self, e: float, row: int, variance: float) -> Angle:
        """Convert an error `e` of a position in rad to an `Angle` in degrees with its standard uncertainty.

        The u combines `variance` (rad²) with the uncertainty that the calibration gives the row with index
        `row` of the linear model.
        """
        columns = self.rows.design[row]
        p = len(columns)
        u = math.sqrt(variance + float(columns @ self.posterior[1][:p, :p] @ columns))
        return math.degrees(float(wrap_radians(np.array(e)))), math.degrees(u)

    def _model(self, row: int) -> float:
        """Return the value that the most probable calibration predicts for one row of the linear model."""
        columns = self.rows.design[row]
        return float(columns @ self.posterior[0][: len(columns)])

    def _gyro(self, k: int) -> Angle | None:
        """Return the error in degrees of the position with index k, by a turn that the gyro measured.

        It is the turn from the position before, or else the turn to the next one. None if both records are
        incomplete, or if the gyro is useless.
        """
        rows = self.rows
        if self.scatter.gyro_rad:
            return None
        for dwell, sign in ((k, 1.0), (k + 1, -1.0)):
            found = np.flatnonzero(rows.turn == dwell)
            if not found.size:
                continue
            row = 2 * len(rows) + int(found[0])
            start = self.error[0][dwell - 1] if sign > 0 else self.error[0][dwell]
            asked = rows.declared_rad[dwell] - rows.declared_rad[dwell - 1]
            e = start + sign * (float(rows.gyro_rad[int(found[0])]) - self._model(row) - asked)
            return self._stated(e, row, float(rows.noise[row, row]) + self.scatter.position_rad**2)
        return None


def _degrees(angle_rad: float) -> float:
    return round(math.degrees(angle_rad), 9)


INSTABILITY_DPS = 0.015
"""Drift of a gyro's zero rate between dwells, in °/s, if neither the dwells nor a data sheet show one (the
simulator's default, D)."""


def positions_of(session: Session) -> tuple[PositionFinding, ...]:
    """Find a session's wrong positions by declared angles, gravity and gyro; the result is kept for reuse.

    There are no findings for sessions in space, without declared angles, or with more than `LARGEST`
    dwells.

    Raises
    ------
    DataError
        The readings are unusable: all zero, stuck, not finite, or far from 1 g.
    """
    return session.once(_diagnosed)


def _diagnosed(session: Session) -> tuple[PositionFinding, ...]:
    angles = angles_of(session)
    return () if angles is None else diagnose(*angles)


def failure_message(session: Session, error: Exception) -> str:
    """Return the message for a failed fit, with suspected positions as a possible cause.

    It begins with the file's name, if there is one.
    """
    text = "; ".join((str(error), *sentences_of(positions_of(session))))
    return f"{session.source}: {text}" if session.source else text


def angles_of(session: Session) -> tuple[Readings, Increments] | None:
    """Return the readings with declared angles and the turns for `diagnose`; None if no angle can be wrong.

    None for sessions in space, without declared angles, or with too few or too many dwells.
    """
    if session.plane != "xy" or session.free_attitudes or not 2 <= len(session.dwells) <= LARGEST:
        return None
    readings = readings_of(session)
    if not readings.planar or not np.isfinite(readings.angle_rad).any():
        return None
    return readings, _increments(session, readings)


def _increments(session: Session, readings: Readings) -> Increments:
    found: dict[int, tuple[float, ...]] = {}
    turns = {(turn.before, turn.position): turn for turn in session.turns if turn.gyro is not None}
    if session.accel_unit != "counts" and turns:
        with suppress(DataError):
            rests = session.once(gyro_dwells_of)
            by_position = rests.by_position
            for end, pair in enumerate(pairwise(readings.position.tolist()), 1):
                if pair in turns and by_position.keys() >= set(pair):
                    ends = [rests.dwells[by_position[position]] for position in pair]
                    path = turn_integration.path_between(session, turns[pair], *ends)
                    turned = None if path is None else _turned(path, rests)
                    if turned is not None:
                        found[end] = turned
    # Angle, u and both forces of each turn.
    rows = np.reshape(list(found.values()), (-1, 4))
    angle, u = np.radians(rows[:, :2].T)
    return Increments(np.array(list(found), dtype=np.intp), angle, u, rows[:, 2:])


def _turned(path: turn_integration.Path, rests: GyroDwells) -> tuple[float, float, float, float] | None:
    """Return the angle of a turn about z with its u in degrees, and the integrals of the force on X and Y.

    The integrals are over the readings of X and Y minus their mean at rest, in g·s. `rests` has the noise
    of the gyros. None if the record of the turn has a gap, or too few complete samples around lost scans.
    """
    sampling = rests.sampling
    found = turn_integration.integrate(path, sampling)
    complete = not turn_integration.has_gap(path) and not turn_integration.moving(path, sampling).any()
    if isinstance(found, str) and complete:
        # The part was not turned.
        found = turn_integration.integral_over(path, sampling, 0, len(path.time_s) - 1)
    if isinstance(found, str):
        return None
    length, variance = found.length_s, float(found.covariance_deg2[2, 2])
    rest = path.rest_g.mean(axis=0)
    # Error of the zero rate: noise of both dwells, and drift.
    drift_dps = float(sampling.drift_dps[2]) or INSTABILITY_DPS
    zero = length**2 * (float(rests.variance_dps2[:, 2].mean()) / 2 + drift_dps**2)
    beyond = np.nan_to_num(length * (found.force_g - rest))  # NaN for counts of unknown size in g
    return float(found.turned_deg[2]), math.sqrt(variance + zero), float(beyond[0]), float(beyond[1])
