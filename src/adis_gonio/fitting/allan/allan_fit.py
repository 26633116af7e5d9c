"""What of a session is at rest: equally spaced records of three gyros or accelerometers.

From a session to the noise of its gyros or accelerometers: `fit_allan`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from scipy import fft, stats

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import INADEQUATE, NORMAL_95, SLOW_NOISE, Value
from adis_gonio.device.sensor.settings import (
    filter_response,
    filter_weights,
    rounding_covariance,
    white_noise_gain,
)
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.allan.allan_result import AllanResult, AxisNoise, notes_of, parameters
from adis_gonio.fitting.allan.noise_processes import KINDS, Kind, curve
from adis_gonio.fitting.allan.spectral_likelihood import (
    Likelihood,
    Ordinates,
    Profile,
    SpectralLine,
    ordinates,
    profile,
    together,
    without_lines,
)
from adis_gonio.fitting.estimation.screening import steps_of
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session

Part = Literal["gyro", "accelerometer"]
PARTS: tuple[Part, ...] = get_args(Part)

LEAST = 128
"""Samples of a record that says something of its noise."""
_GAP = 2.5
"""Sample periods between two samples that end a record."""
_EVEN = 1.5
_MANY_LOST = 1e-3
_SHORT = 4
"""Part of the longest record below which another takes no part."""
_FAST = 100_000
"""Samples from which a record is cut to a length that transforms quickly (less than 2 % is lost)."""


@dataclass(frozen=True)
class Rests:
    """Records at rest of one part.

    Attributes
    ----------
    part : {"gyro", "accelerometer"}
    unit : str
        `dps`, `mg`, or `counts`.
    period_s : float
        Time between samples.
    filter_m : int or None
        The chip's filter; None where the file does not know it.
    records : tuple of (n, axes) float
        Samples in `unit`, each record about its first sample.
    positions : tuple of int
        Dwell of each record.
    step : (axes,) float
        Step of the converter in `unit`; 0 unknown.
    notes : tuple of str
        What there is to say of them.
    """

    part: Part
    unit: str
    period_s: float
    filter_m: int | None
    records: tuple[Floats, ...]
    positions: tuple[int, ...]
    step: Floats
    notes: tuple[str, ...]

    @property
    def axes(self) -> int:
        """Axes of a sample."""
        return int(self.records[0].shape[1])

    @property
    def duration_s(self) -> float:
        """Time of all records together."""
        return self.period_s * sum(len(record) for record in self.records)

    @property
    def longest_s(self) -> float:
        """Time of the longest one."""
        return self.period_s * max(len(record) for record in self.records)


def rests_of(session: Session, part: Part) -> Rests:
    """Records at rest of a session: its dwells, which of a continuous recording are what stood still.

    Raises
    ------
    UsageError
        No such part.
    DataError
        No gyros, no rest that is long enough, times that stand still, an axis that never changes.
    """
    where = session.source or session.title or "session"
    if part not in PARTS:
        raise UsageError(f"'{part}' is no part of the sensor: give {' or '.join(PARTS)}")
    held = [(dwell, series) for dwell in session.dwells if (series := _series(dwell, part)) is not None]
    if not held:
        if session.dwells:
            raise DataError(f"{where}: there are no gyros (gx, gy, gz): give --sensor-part accelerometer")
        raise DataError(f"{where}: nothing in it is at rest; record the part lying still")
    unit, scale = _unit(session, part, where)
    period_s = _period([dwell for dwell, _ in held], where)
    records, positions, lost = [], [], 0
    for dwell, series in held:
        if not np.isfinite(series).all():
            raise DataError(f"{where}: dwell {dwell.position} holds NaN or infinity")
        for rows in _pieces(dwell.time_s, period_s):
            lost += _lost(dwell.time_s[rows], period_s)
            if rows.stop - rows.start >= LEAST:
                records.append(np.asarray(series[_quick(rows)], np.float64))
                positions.append(dwell.position)
    _refuse_short(records, [series for _, series in held], period_s, where)
    _refuse_stuck(records, where)
    records, positions, notes = _long(records, positions)
    step = scale * steps_of(records)
    samples = sum(len(record) for record in records)
    if lost > _MANY_LOST * samples:
        notes.append(f"{counted(lost, 'sample')} of {samples} are missing: high frequencies are less sure")
    kept = tuple((record - record[0]) * scale for record in records)
    return Rests(part, unit, period_s, _filter(session), kept, tuple(positions), step, tuple(notes))


def _series(dwell: Dwell, part: Part) -> Floats | None:
    return dwell.gyro if part == "gyro" else dwell.accel


def _unit(session: Session, part: Part, where: str) -> tuple[str, float]:
    """Unit in which results stand, and by what the file's numbers are multiplied."""
    if part == "gyro":
        return {"dps": ("dps", 1.0), "radps": ("dps", 180 / np.pi), "counts": ("counts", 1.0)}[
            session.gyro_unit
        ]
    if session.accel_unit == "lsb":
        if session.sensor not in VARIANTS:
            raise DataError(f"{where}: the LSB of sensor '{session.sensor}' is not known; give --unit")
        return "mg", VARIANTS[session.sensor].accel_mg_per_lsb
    known = {"mg": 1.0, "g": 1000.0, "mps2": 1000.0 / STANDARD_GRAVITY_MPS2}
    return ("mg", known[session.accel_unit]) if session.accel_unit in known else ("counts", 1.0)


def _filter(session: Session) -> int | None:
    found = (session.facts.get("configuration") or {}).get("filter_m")
    return None if found is None else int(found)


def _period(dwells: list[Dwell], where: str) -> float:
    """Time between samples, by the whole of the longest dwell: coarse times may stand still between two."""
    longest = max(dwells, key=len)
    if len(longest) < 2:
        raise DataError(
            f"{where}: its dwells hold one averaged sample each; the noise needs the samples themselves"
        )
    steps = np.diff(longest.time_s)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not usual > 0:
        raise DataError(f"{where}: the times of the samples stand still; without them there is no rate")
    # Beyond it a sample is missing; coarse times that stand still count.
    return float(steps[steps < _EVEN * usual].mean())


def _pieces(time_s: Floats, period_s: float) -> list[slice]:
    """Rows between gaps."""
    gaps = np.flatnonzero(np.diff(time_s) > _GAP * period_s) + 1
    edges = [0, *gaps.tolist(), len(time_s)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _lost(time_s: Floats, period_s: float) -> int:
    return max(0, round(float(time_s[-1] - time_s[0]) / period_s) + 1 - len(time_s))


def _long(records: list[Floats], positions: list[int]) -> tuple[list[Floats], list[int], list[str]]:
    """Without the records that are short against the longest: they say nothing of slow noise."""
    least = max(len(record) for record in records) / _SHORT
    kept = [k for k, record in enumerate(records) if len(record) >= least]
    left = len(records) - len(kept)
    notes = [f"{counted(left, 'rest')} shorter than a quarter of the longest left out"] if left else []
    return [records[k] for k in kept], [positions[k] for k in kept], notes


def _quick(rows: slice) -> slice:
    size = rows.stop - rows.start
    if size < _FAST:
        return rows
    kept = next(n for n in range(size, 0, -1) if fft.next_fast_len(n, real=True) == n)
    return slice(rows.start, rows.start + kept)


def _refuse_short(records: list[Floats], series: list[Floats], period_s: float, where: str) -> None:
    if not records:
        longest = max(len(rows) for rows in series)
        raise DataError(
            f"{where}: the longest rest without a gap has {counted(longest, 'sample')} at most"
            f" ({longest * period_s:.3g} s): noise needs {LEAST}; let the part lie still for longer"
        )


def _refuse_stuck(records: list[Floats], where: str) -> None:
    still = [axis for axis in range(records[0].shape[1]) if all(not np.ptp(r[:, axis]) for r in records)]
    if still:
        names = ", ".join("xyz"[axis] for axis in still)
        raise DataError(
            f"{where}: {names} never changes at rest: a dead axis, or noise below the converter"
        )


MOST_M = 6
_PASSED = 0.01
"""Least |H|² of the chip's filter that is fitted: beyond it rounding and the ends of a record show."""
_FINE = 0.5
"""Noise in steps of the converter from which rounding adds to it and no more."""
_BANDS = ((0.04, 0.3), (0.3, 1.0))
"""Parts of the band in which records are compared: above their slow noise."""
_LOUDER = 1.1
_TRIAL = 1 << 16
"""Samples by which a filter that nobody stated is told."""


@solvable
def fit_allan(session: Session, part: Part = "gyro", *, filter_m: int | None = None) -> AllanResult:
    """Noise of a part at rest by restricted maximum likelihood, beside its Allan deviation.

    White noise (angle or velocity random walk), flicker (bias instability), rate random walk, and where no
    filter is known or set quantization, of IEEE Std 952-1997, Annex C: each with a profile-likelihood
    interval, or with a limit where the data do not refuse that it is absent.

    Parameters
    ----------
    session : Session
        With dwells, or continuous with rests: each is a record with a mean and a line of its own.
    part : {"gyro", "accelerometer"}
    filter_m : int, optional
        M of the chip's filter, 0 to 6; by default the session's, or what the spectrum of a known sensor
        says. Other sensors count as unfiltered in the band where their spectrum is one of these noises.

    Raises
    ------
    UsageError
        No such part or filter.
    DataError
        Nothing at rest, or too short.
    """
    if filter_m is not None and not 0 <= filter_m <= MOST_M:
        raise UsageError(f"filter M is {filter_m}: give 0 to {MOST_M}")
    rests = rests_of(session, part)
    stated = rests.filter_m if filter_m is None else filter_m
    m = stated if stated is not None else _filter_seen(rests, session.sensor in VARIANTS)
    notes = list(rests.notes)
    if stated is None:
        notes.append(_of_filter(m, session.sensor in VARIANTS))
    share = current().share
    found = []
    for axis in range(rests.axes):
        share(axis / rests.axes)
        found.append(_axis(rests, axis, m))
    return AllanResult(
        part=part,
        unit=rests.unit,
        title=session.title,
        sensor=session.sensor,
        source=session.source,
        simulated=bool(session.facts.get("simulated")),
        period_s=rests.period_s,
        filter_m=m,
        filter_known=stated is not None,
        positions=rests.positions,
        samples=tuple(len(record) for record in rests.records),
        axes=tuple(found),
        notes=tuple(notes),
    )


def _of_filter(m: int, chip: bool) -> str:
    if chip:
        return f"the file does not say the chip's filter: M = {m} by the spectrum; --filter says it"
    return "no filter is known: fitted in the band whose spectrum these noises explain"


def _flat(record: Floats) -> Floats:
    """Samples (n,) without their mean and slope."""
    at = np.arange(len(record)) - (len(record) - 1) / 2
    centred = record - record.mean()
    return np.asarray(centred - at * float(at @ centred) / float(at @ at), np.float64)


def _rounding(flat: Sequence[Floats], step: float, m: int) -> tuple[Floats, bool]:
    """Autocovariance of the rounding, and whether the converter is too coarse for one."""
    # What changes within the filter's window is white noise: slow noise does not count.
    lag = 1 << m
    weights = filter_weights(m)
    shape = np.correlate(weights, weights, "full")[len(weights) - 1 :]
    kept = float(shape[0] - (shape[lag] if lag < len(shape) else 0.0))
    change = float(np.median([np.mean((record[lag:] - record[:-lag]) ** 2) / 2 for record in flat]))
    sigma = math.sqrt(max(change - step**2 / 12, 0.0) / kept)
    if step <= 0 or sigma * white_noise_gain(m) < _FINE * step:
        return np.zeros(1), step > 0
    return step**2 * rounding_covariance(m, sigma / step), False


def _highest(m: int) -> float:
    """Frequency in cycles a sample up to which the filter lets enough pass."""
    if m == 0:
        return 0.5
    grid = np.linspace(0.0, 0.5**m, 2049)
    return float(grid[filter_response(m, grid) >= _PASSED].max())


def _filter_seen(rests: Rests, chip: bool) -> int:
    """M by which the whole spectrum is most likely; 0 for sensors that have another filter or none."""
    if not chip:
        return 0
    record = max(rests.records, key=len)[:_TRIAL]
    losses = np.zeros(MOST_M + 1)
    for axis in range(rests.axes):
        flat = _flat(record[:, axis])
        for m in range(MOST_M + 1):
            if 8 << m > len(record):
                losses[m] = np.inf
                continue
            rounding, _ = _rounding([flat], float(rests.step[axis]), m)
            data = ordinates(flat, m, rests.period_s, rounding, np.zeros(0, np.intp))
            losses[m] += Likelihood(data, (0,)).best()[1]
    return int(losses.argmin())


@dataclass(frozen=True)
class _Fitted:
    likelihood: Likelihood
    theta: Floats
    deviance: float
    adequacy: float
    band: float


def _fitted(data: Ordinates, band: float, kinds: Sequence[Kind]) -> _Fitted:
    likelihood = Likelihood(data, [k for k, kind in enumerate(KINDS) if kind not in kinds])
    theta, deviance = likelihood.best()
    return _Fitted(likelihood, theta, deviance, likelihood.adequacy(theta), band)


def _kinds(m: int) -> Sequence[Kind]:
    """Processes that a record may have: behind the chip's filter no angle is counted any more."""
    return KINDS if m == 0 else KINDS[1:]


def _widest(data: Ordinates, band: float, kinds: Sequence[Kind]) -> _Fitted:
    """Fit in the widest band, halved from the whole one, that the noises explain; the best one of none."""
    tried = []
    while True:
        inside = data.below(band)
        tried.append(_fitted(inside, band, kinds))
        if tried[-1].adequacy >= INADEQUATE:
            return tried[-1]
        band /= 2
        if data.below(band).weight.sum() < LEAST / 2:
            return max(tried, key=lambda found: found.adequacy)


def _axis(rests: Rests, axis: int, m: int) -> AxisNoise:
    period_s, step = rests.period_s, float(rests.step[axis])
    columns = [record[:, axis] for record in rests.records]
    slopes = [float(np.polyfit(np.arange(len(c)) - (len(c) - 1) / 2, c, 1)[0]) for c in columns]
    flat = [_flat(column) for column in columns]
    rounding, coarse = _rounding(flat, step, m)
    highest = _highest(m)
    lines: list[list[SpectralLine]] = []
    parts = []
    for record in flat:
        clean, own, masked = without_lines(record, period_s, highest)
        lines.append(own)
        parts.append(ordinates(_flat(clean) if own else record, m, period_s, rounding, masked))
    quiet = _quiet(parts, highest)
    fitted = _widest(together([parts[k] for k in quiet]), highest, _kinds(m))
    profiles = _profiles(fitted, _kinds(m))
    slow = _slow(fitted)
    ramp = _ramp(fitted, [slopes[k] for k in quiet], period_s, rests.unit)
    found = AxisNoise(
        axis="xyz"[axis],
        parameters=parameters(rests.part, rests.unit, profiles),
        ramp=ramp,
        slow_p_value=slow,
        adequacy=fitted.adequacy,
        band_hz=(1 / (2 * rests.longest_s), fitted.band / period_s),
        lines=_joined([line for k in quiet for line in lines[k]]),
        step=step,
        curve=curve([columns[k] for k in quiet], _drawn(fitted, profiles), m, period_s, rounding),
        notes=(),
    )
    notes = notes_of(
        found,
        narrowed=fitted.band < highest,
        coarse=coarse,
        loud=[rests.positions[k] for k in range(len(parts)) if k not in quiet],
    )
    return replace(found, notes=tuple(notes))


def _quiet(parts: Sequence[Ordinates], highest: float) -> list[int]:
    """Records as quiet as the quietest: a hand or a shaken table makes others louder.

    From the quietest on, each that is not louder than those before it together, in either of two bands.
    """
    bands = [(low * highest, high * highest) for low, high in _BANDS]
    level = np.empty((len(parts), len(bands)))
    weight = np.empty_like(level)
    for row, part in enumerate(parts):
        for column, (low, high) in enumerate(bands):
            inside = (part.frequency > low) & (part.frequency <= high)
            weight[row, column] = max(float(part.weight[inside].sum()), 1e-9)
            level[row, column] = part.weight[inside] @ part.power[inside] / weight[row, column]
    order = np.argsort(level.prod(axis=1), kind="stable")
    kept = [int(order[0])]
    for k in order[1:].tolist():
        pool = weight[kept].sum(axis=0)
        usual = (weight[kept] * level[kept]).sum(axis=0) / pool
        limit = _LOUDER + 4 * np.sqrt(2 / weight[k] + 2 / pool)
        if (level[k] <= limit * usual).all():
            kept.append(k)
    return sorted(kept)


def _profiles(fitted: _Fitted, kinds: Sequence[Kind]) -> dict[Kind, Profile]:
    return {
        kind: profile(fitted.likelihood, fitted.theta, fitted.deviance, KINDS.index(kind)) for kind in kinds
    }


def _drawn(fitted: _Fitted, profiles: dict[Kind, Profile]) -> Floats:
    """Squared coefficients of the curve: without what is not present, unless the data need one of both."""
    lacking = [kind for kind, found in profiles.items() if not found.present and kind != "white"]
    absent = {KINDS.index(kind): 0.0 for kind in lacking}
    if {2, 3} <= absent.keys() and _slow(fitted) < SLOW_NOISE:
        absent.pop(2)
        absent.pop(3)
    return fitted.likelihood.maximum(fitted.theta.copy(), absent)[0]


def _slow(fitted: _Fitted) -> float:
    """That neither flicker nor walk is there: a bound, two coefficients on their boundary."""
    _, without = fitted.likelihood.maximum(fitted.theta.copy(), {2: 0.0, 3: 0.0})
    ratio = max(without - fitted.deviance, 0.0)
    if ratio <= 0:
        return 1.0
    return float(0.5 * stats.chi2.sf(ratio, 1) + 0.5 * stats.chi2.sf(ratio, 2))


def _ramp(fitted: _Fitted, slopes: list[float], period_s: float, unit: str) -> Value:
    """Weighted mean of the records' slopes, per second."""
    rest = fitted.likelihood.slopes(fitted.theta)
    weight = np.array([1 / u**2 if u > 0 else 0.0 for _, u in rest])
    if not weight.sum() > 0:
        return Value(float(np.mean(slopes)) / period_s, None, f"{unit}/s")
    total = np.array(slopes) + np.array([left for left, _ in rest])
    mean = float(np.average(total, weights=weight))
    return Value(mean / period_s, 1 / math.sqrt(weight.sum()) / period_s, f"{unit}/s", factor=NORMAL_95)


def _joined(lines: list[SpectralLine]) -> tuple[SpectralLine, ...]:
    """Lines of all records; those within 1 % of each other are one, with the largest amplitude."""
    kept: list[SpectralLine] = []
    for line in sorted(lines, key=lambda one: -one.amplitude):
        if all(abs(line.frequency_hz / other.frequency_hz - 1) > 0.01 for other in kept):
            kept.append(line)
    return tuple(sorted(kept, key=lambda one: one.frequency_hz))
