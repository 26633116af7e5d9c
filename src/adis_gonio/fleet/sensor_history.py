"""History of one sensor: quantities over time, drift, control charts, effects found; as data and texts.

Drift is a weighted line with additional scatter between sessions: y_i = a + b t_i + w_i + e_i, with e_i of
standard deviation u_i and w_i of τ. τ² follows from Paule and Mandel (J. Res. NBS 87, 1982, 377): the
residual is then as large as expected. The uncertainty is by Knapp and Hartung (Stat. Med. 22, 2003, 2693),
at least as large as the stated u require, with Student's t at n − 2.

The charts compare each session with the weighted mean of all sessions before it (recursive residuals;
Brown, Durbin and Evans, J. R. Stat. Soc. B 37, 1975). If nothing changes, the differences are independent
and standard normal, so that neither chart needs a baseline of good sessions and the average run lengths of
the textbooks apply. Shewhart's chart detects a session that is far off; the CUSUM (Page, Biometrika 41,
1954) detects a small shift that stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError, suggest
from adis_gonio.base.jsonable import JsonRecord, json_object
from adis_gonio.base.numbers import NAMES, counted, format_number, format_p, label_quantity, with_unit
from adis_gonio.base.uncertainty import DRIFTING, NORMAL_95, Value
from adis_gonio.fleet.fleet_summary import unshared_u
from adis_gonio.fleet.session_record import ANGLE, QUANTITIES, SessionRecord

CUSUM_K = 0.5
"""Slack k of the CUSUM in standard deviations: half of the shift that it detects best.

The choice follows Montgomery, chapter 9.
"""
CUSUM_H = 5.0
"""Limit h of the CUSUM in standard deviations, which gives one false alarm in 465 sessions."""
SHEWHART = 3.0
"""Limit of Shewhart's chart in standard deviations, which gives one false alarm in 370 sessions."""
_MOVING_RANGE = 2 / math.sqrt(math.pi)
"""Mean distance of two successive normal values, in their standard deviations (d₂ of two)."""
_MOVING_RANGE_DOF = 0.62
"""Effective degrees of freedom of a mean moving range, for each moving range (Palm and Wheeler, 1990)."""


class ControlChart(JsonRecord):
    """Control charts of a quantity, which compare each session with the sessions before it.

    Entries of the first session are NaN, unless stated otherwise.

    Attributes
    ----------
    expected : (n,) float
        Weighted mean of the values of all sessions before this session.
    low, high : (n,) float
        Shewhart's limits for this session.
    z : (n,) float
        Difference of the value from `expected` in standard deviations. They include the scatter between
        the other sessions; if this is estimated from few sessions, z is the standard normal value that is
        as improbable as Student's t.
    up, down : (n,) float
        The two sums of the CUSUM, in standard deviations; 0 at the first session.
    between : float
        Standard deviation of the values between sessions in excess of their standard uncertainties u.
    since : int or None
        Index of the first session after a change that the CUSUM signals, by the most likely split of the
        sessions up to the signal into two means (Pignatiello and Samuel, J. Qual. Technol. 33, 2001); None
        without a signal.
    k, h : float
        Slack and limit of the CUSUM, in standard deviations.
    """

    document_keys = (
        *("expected", "low", "high", "z", "up", "down"),
        *("between", "k", "h", "outside", "signal", "since"),
    )

    expected: Floats
    low: Floats
    high: Floats
    z: Floats
    up: Floats
    down: Floats
    between: float
    since: int | None = None
    k: float = CUSUM_K
    h: float = CUSUM_H

    @property
    def outside(self) -> list[int]:
        """Indices of the sessions outside the 3σ limits of Shewhart's chart."""
        return [int(n) for n in np.flatnonzero(np.abs(self.z) > SHEWHART)]

    @property
    def signal(self) -> int | None:
        """Index of the first session at which a sum of the CUSUM exceeds its limit; None if none does."""
        over = np.flatnonzero(np.maximum(self.up, self.down) > self.h)
        return int(over[0]) if len(over) else None


def control_chart(value: Floats, u: Floats) -> ControlChart:
    """Make the Shewhart and CUSUM charts of the values of a quantity in successive sessions.

    `value` (n,) and `u` (n,) are the values and their standard uncertainties, in order of time.
    """
    from scipy.special import ndtr, stdtrit

    expected, sigma = np.full(len(value), np.nan), np.full(len(value), np.nan)
    dof = np.full(len(value), np.inf)
    for k in range(1, len(value)):
        # A session that is far off must not widen its own limits.
        others = np.arange(len(value)) != k
        between = between_neighbours(value[others], u[others])
        variance = u**2 + between**2
        weight = 1 / variance[:k]
        expected[k] = np.average(value[:k], weights=weight)
        sigma[k] = math.sqrt(variance[k] + 1 / weight.sum())
        if between:
            spread = between**2 + float((u[others] ** 2).mean())
            dof[k] = _MOVING_RANGE_DOF * (len(value) - 2) * (variance[k] / spread) ** 2
    t = (value - expected) / sigma
    z = as_normal(t, dof)
    up, down = np.insert(cusum(z[1:]), 0, 0.0, axis=1)
    limit = sigma * -stdtrit(dof, ndtr(-SHEWHART))
    between = between_neighbours(value, u)
    chart = ControlChart(expected, expected - limit, expected + limit, z, up, down, between)
    if chart.signal is None:
        return chart
    return replace(chart, since=_split(value, 1 / (u**2 + between**2), chart.signal))


def as_normal(t: Floats, dof: Floats) -> Floats:
    """Convert values (n,) of Student's t with `dof` (n,) degrees of freedom to normal deviates.

    A value and its deviate have equal probability.
    """
    from scipy.special import ndtri, stdtr

    few = np.isfinite(dof) & (dof < 1e6)
    out = np.array(t, dtype=float)
    # The lower tail keeps the digits of small probabilities.
    tail = np.maximum(stdtr(np.maximum(dof[few], 1.0), -np.abs(out[few])), 1e-300)
    out[few] = -np.sign(out[few]) * ndtri(tail)
    return out


def _split(value: Floats, weight: Floats, last: int) -> int:
    """Return the index of the session at which the mean most probably changed.

    `value` (n,) and `weight` (n,) are the values and the inverse squares of their standard uncertainties.
    Only the sessions up to the index `last`, included, are used; the session returned is the first after
    the change.
    """

    def gain(at: int) -> float:
        one, other = slice(0, at), slice(at, last + 1)
        means = [float(np.average(value[part], weights=weight[part])) for part in (one, other)]
        return (means[1] - means[0]) ** 2 / float(1 / weight[one].sum() + 1 / weight[other].sum())

    return max(range(1, last + 1), key=gain)


def between_neighbours(value: Floats, u: Floats) -> float:
    """Estimate the standard deviation between sessions in excess of their standard uncertainties.

    `value` (n,) and `u` (n,) are the values and their standard uncertainties in order of time. The estimate
    is made from the differences of successive sessions (moving range), so that a single step in the series
    hardly changes it. It is 0 with fewer than three sessions.
    """
    if len(value) < 3:
        return 0.0
    # Scatter of neighbours minus the mean variance of the stated u.
    spread = float(np.abs(np.diff(value)).mean()) / _MOVING_RANGE
    return math.sqrt(max(spread**2 - float((u**2).mean()), 0.0))


def cusum(z: Floats) -> tuple[Floats, Floats]:
    """Return the upper and lower CUSUM (n,) of standardised values z (n,).

    They are S⁺ = max(0, S⁺ + z − k) and S⁻ = max(0, S⁻ − z − k), with k = `CUSUM_K`.
    """
    sums = np.cumsum([z - CUSUM_K, -z - CUSUM_K], axis=1)
    # A sum that starts again at 0 is the whole sum above its lowest value so far, at most 0.
    up, down = sums - np.minimum(np.minimum.accumulate(sums, axis=1), 0.0)
    return up, down


YEAR_DAYS = 365.25
LEAST = 3
"""Smallest number of sessions for a straight line with an estimate of the scatter about it."""


class Drift(JsonRecord):
    """A straight line through the values of a quantity over time.

    Attributes
    ----------
    slope : Value
        Change of the quantity per year, in `<unit>/a`.
    level : Value
        Value of the line at `reference_day`.
    reference_day : float
        Weighted mean time of the sessions in days, at which level and slope are independent.
    between : float
        Standard deviation τ of the values between sessions in excess of their standard uncertainties u.
    birge : float
        Birge ratio: square root of χ² per degree of freedom about the line, with the stated standard
        uncertainties u alone.
    birge_p : float
        Probability of at least this scatter, if the stated u are its only cause.
    p_value : float
        Probability of at least this slope, of either sign, without drift.
    """

    slope: Value
    level: Value
    reference_day: float
    between: float
    birge: float
    birge_p: float
    p_value: float


def drift_of(day: Floats, value: Floats, u: Floats, unit: str) -> Drift | None:
    """Fit a straight line to the values of the sessions over time.

    Returns None for fewer than `LEAST` sessions, or if all sessions have the same time.

    Parameters
    ----------
    day, value, u : (n,) float
        Time in days, value and standard uncertainty of each session; the uncertainty is above zero.
    unit : str
        Unit of the values.
    """
    if len(day) < LEAST or not np.ptp(day) > 0:
        return None
    from scipy.optimize import brentq
    from scipy.special import gammaincc, stdtr

    dof = len(day) - 2
    stated = _line(day, value, u**2)

    def excess(tau: float) -> float:
        return _line(day, value, u**2 + tau**2)[-1] - dof

    # τ at which Cochran's Q has its expectation (Paule and Mandel); 0 if Q is not larger without τ.
    between = 0.0
    if excess(0.0) > 0:
        high = float(np.ptp(value))
        while excess(high) > 0:
            high *= 2
        between = float(brentq(excess, 0.0, high, xtol=1e-7 * high, rtol=1e-6))
    middle, level, slope, variances, chi2 = _line(day, value, u**2 + between**2)
    scale = max(1.0, chi2 / dof)  # Knapp and Hartung, never below the stated u
    u_level, u_slope = (math.sqrt(scale * v) for v in variances)
    return Drift(
        slope=Value(slope * YEAR_DAYS, u_slope * YEAR_DAYS, f"{unit}/a", dof),
        level=Value(level, u_level, unit, dof),
        reference_day=middle,
        between=between,
        birge=math.sqrt(stated[-1] / dof),
        birge_p=float(gammaincc(dof / 2, stated[-1] / 2)),
        p_value=float(2 * stdtr(dof, -abs(slope) / u_slope)),
    )


def _line(
    day: Floats, value: Floats, variance: Floats
) -> tuple[float, float, float, tuple[float, float], float]:
    """Fit a straight line to values over days, weighted by 1/variance.

    Returns the weighted mean time, the value of the line at that time, the slope per day, the variances of
    both, and χ².
    """
    # Weighted straight line about the weighted mean time, where level and slope are independent.
    weight = 1 / variance
    total = float(weight.sum())
    middle = float((weight * day).sum()) / total
    t = day - middle
    spread = float((weight * t**2).sum())
    level, slope = float((weight * value).sum()) / total, float((weight * t * value).sum()) / spread
    chi2 = float((weight * (value - level - slope * t) ** 2).sum())
    return middle, level, slope, (1 / total, 1 / spread), chi2


_IN_PLANE = ("delta_k", "delta_phi", "bias_x", "bias_y")
_DAY_S = 86400.0

LISTED = (
    *("when", "path", "operator", "stage", "plan", "method", "effects"),
    *("adequate", "temperature_c", "angle_max_deg"),
)
"""Fields of a session's record that the JSON document of `history` includes."""


class Track(JsonRecord):
    """Values of one quantity over time, from the sessions of a sensor that determine it.

    Attributes
    ----------
    name, unit : str
        Name and unit of the quantity.
    sessions : tuple of int
        Indices of the sessions in the history, from 0. Sessions with the quantity in another unit than the
        latest session are missing.
    day : (n,) float
        Time of each session in days since 1970.
    values : tuple of Value
        Value of the quantity in each session, with uncertainty.
    drift : Drift or None
        Straight line over time; None with fewer than three sessions, and for the error of the angle, which
        has no sign.
    chart : ControlChart or None
        Control charts; None with fewer than two sessions.
    drifts : bool
        True if the slope differs from zero: its p-value times the number of quantities is below 5 %
        (`DRIFTING`).
    """

    document_keys = ("unit", "sessions", "values", "drift", "drifts", "chart")

    name: str
    unit: str
    sessions: tuple[int, ...]
    day: Floats
    values: tuple[Value, ...]
    drift: Drift | None = None
    chart: ControlChart | None = None
    drifts: bool = False

    @property
    def label(self) -> str:
        """Name of the quantity with its unit, such as `Δφ / °`."""
        return label_quantity(self.name, self.unit)

    @property
    def value(self) -> Floats:
        """Values (n,) of the quantity, one per session that determines it."""
        return np.array([value.value for value in self.values])

    @property
    def u(self) -> Floats:
        """Standard uncertainties (n,) of the values, of normal errors with the same U."""
        return self.expanded / NORMAL_95

    @property
    def expanded(self) -> Floats:
        """Expanded uncertainties U (n,) of the values, 95 %."""
        return np.array([value.U for value in self.values], dtype=float)


@dataclass(frozen=True)
class History:
    """The sessions of one sensor over time, with the values of each quantity.

    Attributes
    ----------
    serial : str
        Serial number of the sensor.
    sessions : tuple of SessionRecord
        Sessions in the order of time.
    tracks : mapping of str to Track
        Values of each quantity over time, by its name.
    left_out : tuple of (SessionRecord, str)
        Sessions that are not used, without a date or with a doubtful result, and the reason.
    """

    serial: str
    sessions: tuple[SessionRecord, ...]
    tracks: dict[str, Track]
    left_out: tuple[tuple[SessionRecord, str], ...] = ()

    @property
    def days(self) -> Floats:
        """Time at which each session began, in days since 1970-01-01, (n,)."""
        return np.array([day_of(record.when or "") for record in self.sessions])

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio history --json` prints."""
        return json_object(
            serial=self.serial,
            sessions=[
                {name: getattr(record, name) for name in LISTED}
                | ({} if record.traced else {"effects": None})
                for record in self.sessions
            ],
            quantities=self.tracks,
            left_out=[{"path": record.path, "reason": reason} for record, reason in self.left_out],
        )


def history_of(serial: str, records: Sequence[SessionRecord]) -> History:
    """Make the history of a sensor from the records of its sessions.

    Sessions that take the biases as zero are left out if other sessions determine the biases.
    """
    biases = any("bias_x" in record.values for record in records if not _unfit(record))
    left_out = tuple((record, reason) for record in records if (reason := _unfit(record, biases=biases)))
    good = [record for record in records if not _unfit(record, biases=biases)]
    good.sort(key=lambda record: (day_of(record.when or ""), record.path))
    # In the plane the gain ratio ΔK is tracked instead of gains: a common factor of both gains cannot be
    # distinguished from a change of gravity.
    names = [name for name in QUANTITIES if name.startswith(("bias_", "scale_", "skew_"))]
    if any("delta_k" in record.values for record in good):
        names = [*_IN_PLANE, ANGLE]
    tracks = []
    for name in names:
        stated = [
            (n, record, value)
            for n, record in enumerate(good)
            if (value := record.values.get(name)) is not None
            and np.isfinite(value.value)
            and (value.u or 0.0) > 0
        ]
        if not stated:
            continue
        # Sessions in counts and sessions in mg have no common line: the unit of the latest one is used.
        unit = stated[-1][2].unit
        numbers, shown, values = zip(*(one for one in stated if one[2].unit == unit), strict=True)
        day = np.array([day_of(record.when or "") for record in shown])
        track = Track(name, unit, numbers, day, values)
        if name != ANGLE and len(values) > 1:
            u = own_u(shown, name)
            drift = drift_of(day, track.value, u, track.unit)
            track = replace(track, drift=drift, chart=control_chart(track.value, u))
        tracks.append(track)
    drifts = {track.name: track.drift for track in tracks if track.drift is not None}
    moving = {name for name, drift in drifts.items() if drift.p_value * len(drifts) <= DRIFTING}
    judged = {track.name: replace(track, drifts=track.name in moving) for track in tracks}
    return History(serial, tuple(good), judged, left_out)


def known_serial(serial: str, known: Sequence[str]) -> str:
    """Return the serial number `serial` if it is one of the known serial numbers.

    Raises
    ------
    UsageError
        The serial number is unknown; the message names the most similar serial number.
    """
    if serial in known:
        return serial
    if known:
        otherwise = f"known: {', '.join(known[:5])}{' …' if len(known) > 5 else ''}"
    else:
        otherwise = (
            "no session in these folders has a serial number (calibrate --serial, or '# serial:' in a CSV)"
        )
    hint = suggest(serial, known, otherwise)
    raise UsageError(f"no session is of a sensor with serial number '{serial}'; {hint}")


def alike(serial: str, known: Sequence[str]) -> list[str]:
    """Return the known serial numbers that differ from this one only by capitals and spaces."""

    def bare(text: str) -> str:
        return "".join(text.split()).casefold()

    return [other for other in known if other != serial and bare(other) == bare(serial)]


def day_of(when: str) -> float:
    """Convert an ISO time to days since 1970-01-01."""
    return datetime.fromisoformat(when).timestamp() / _DAY_S


def date_of(day: float) -> str:
    """Convert days since 1970-01-01 to a date (UTC); `UsageError` for a day beyond the calendar's end."""
    try:
        return (datetime(1970, 1, 1) + timedelta(days=float(day))).date().isoformat()
    except OverflowError:
        raise UsageError(f"day {day:g} is beyond the calendar") from None


def _unfit(record: SessionRecord, *, biases: bool = False) -> str:
    """Return the reason to leave a session out of a history; empty if there is none.

    `biases` is True if other sessions determine the biases.
    """
    if record.status != "ok":
        return record.reason
    if record.when is None:
        return "no date: a samples CSV has one only if time_s has times like 2026-11-24 10:00:00"
    if biases and "bias_x" not in record.values:
        return "its ΔK and Δφ take the biases as zero, but other sessions show the biases"
    return f"the result cannot be right: {record.doubts[0]}" if record.doubts else ""


def own_u(records: Sequence[SessionRecord], name: str) -> Floats:
    """Return the standard uncertainties (n,) of a quantity without the errors of a stage that all share.

    `name` is the quantity. The result applies to differences between the sessions (`unshared_u`). A u with
    few degrees of freedom counts as the u of a normal error with the same U: by chance it may be far below
    the error, and then no chart could tell this session from a changed sensor.
    """
    return unshared_u(
        np.array([record.values[name].U or 0.0 for record in records]) / NORMAL_95,
        [record.stage_curve for record in records],
        [record.stage_influence.get(name, ()) for record in records],
    )


def drift_sentences(track: Track) -> list[str]:
    """Return sentences on the drift of a quantity, and on its scatter between sessions.

    The list is empty without a drift fit.
    """
    drift = track.drift
    if drift is None:
        return []
    said = "drifts" if track.drifts else "no drift shown"
    lines = [f"{said}: {drift.slope} (U, 95 %), {format_p(drift.p_value)}"]
    if drift.birge_p < DRIFTING:
        lines.append(
            f"sessions scatter by {with_unit(format_number(drift.between, 2), track.unit)}, beyond their u "
            f"(Birge ratio {drift.birge:.2f}, {format_p(drift.birge_p)})"
        )
    return lines


def chart_sentences(track: Track, history: History) -> list[str]:
    """Return sentences on the sessions at which the control charts of a quantity signal a change."""
    chart = track.chart
    if chart is None:
        return []
    lines = []
    if chart.signal is not None and chart.since is not None:
        at, since = (history.sessions[track.sessions[n]] for n in (chart.signal, chart.since))
        way = "up" if chart.up[chart.signal] > chart.h else "down"
        lines.append(f"CUSUM signals a change {way} since {_date(since)} (seen on {_date(at)})")
    if chart.outside:
        dates = ", ".join(_date(history.sessions[track.sessions[n]]) for n in chart.outside)
        lines.append(f"outside the 3σ limits: {dates}")
    return lines


def _date(record: SessionRecord) -> str:
    return (record.when or "")[:10]


def headline(history: History) -> str:
    """Return one line on a history: sessions, drifts, scatter beyond u, signals of control charts."""
    names = {NAMES.get(name, name): track for name, track in history.tracks.items()}
    charts = {name: track.chart for name, track in names.items() if track.chart is not None}
    moving = [name for name, track in names.items() if track.drifts]
    signals = [name for name, chart in charts.items() if chart.signal is not None]
    outside = [name for name, chart in charts.items() if chart.outside]
    parts = [counted(len(history.sessions), "session")]
    parts.append(f"drift in {', '.join(moving)}" if moving else "no drift shown")
    scatter = {name: track.drift.birge_p for name, track in names.items() if track.drift is not None}
    if beyond := [name for name, p in scatter.items() if p * len(scatter) <= DRIFTING]:
        parts.append(f"scatter beyond u in {', '.join(beyond)}")
    if signals:
        parts.append(f"control chart signals {', '.join(signals)}")
    if outside:
        parts.append(f"a session is outside the 3σ limits of {', '.join(outside)}")
    if not signals and not outside:
        parts.append("control charts quiet")
    return "; ".join(parts)
