"""Estimate the noise of a session's gyros or accelerometers from its records at rest: `fit_allan`.

The result has coefficients with uncertainties or limits, as JSON, a table and notes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import fft, special

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.jsonable import HIDDEN, KEYED_BY_NAME, JsonRecord, key
from adis_gonio.base.numbers import QuantityRow, counted, format_number, format_p, format_unit
from adis_gonio.base.uncertainty import INADEQUATE, NORMAL_95, SLOW_NOISE, Value
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.device.sensor.settings import (
    filter_response,
    filter_weights,
    rounding_covariance,
    white_noise_gain,
)
from adis_gonio.fitting.allan.spectral_likelihood import (
    KINDS,
    AllanCurve,
    Kind,
    Likelihood,
    NoiseParameter,
    Ordinates,
    SpectralLine,
    curve,
    ordinates,
    profile,
    subtract_sinusoids,
    together,
)
from adis_gonio.fitting.estimation.readings import GYRO, known_part, mg_per_unit
from adis_gonio.fitting.estimation.screening import steps_of
from adis_gonio.fitting.gyros.turn_integration import dps_per_unit
from adis_gonio.model.records import Dwell, Session

Part = Literal["gyro", "accelerometer"]
PARTS: dict[Part, str] = {"gyro": "gyros", "accelerometer": "accelerometers"}
_NAMES: dict[Part, tuple[str, ...]] = {
    "gyro": ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk"),
    "accelerometer": (
        "quantization",
        "velocity_random_walk",
        "bias_instability",
        "acceleration_random_walk",
    ),
}
"""Names of the noise processes in `spectral_likelihood.KINDS`, by sensor part."""
_UNITS = {
    "dps": ("deg", "dps/√Hz", "dps", "dps/√s"),
    "mg": ("mg·s", "mg/√Hz", "mg", "mg/√s"),
    "counts": ("counts·s", "counts/√Hz", "counts", "counts/√s"),
}
"""Units of the coefficients of the noise processes, by the unit of the samples."""


class AxisNoise(JsonRecord):
    """Noise of one axis.

    Attributes
    ----------
    name : str
        `x`, `y` or `z`.
    parameters : tuple of NoiseParameter
        Noise processes in the order of `spectral_likelihood.KINDS`; with the chip's filter on, without
        quantization.
    ramp : Value
        Drift per second: weighted mean of the slopes of straight lines through the records.
    slow_p_value : float
        p-value of the hypothesis that the axis has no flicker noise and no random walk; small if slow noise
        is present.
    adequacy : float
        p-value of the spectrum under the fitted noise; small if this noise does not explain the spectrum.
    band_hz : (float, float)
        Lowest and highest fitted frequency.
    lines : tuple of SpectralLine
        Sinusoids that were found in the records and subtracted before the fit.
    step : float
        Step of the analogue-to-digital converter, 0 if unknown; the coefficients do not include its
        rounding.
    curve : AllanCurve
        Allan deviation of the axis, measured and by the fitted noise.
    notes : tuple of str
        Remarks for the user, one line each.
    """

    name: str = field(metadata=HIDDEN)
    parameters: tuple[NoiseParameter, ...] = field(metadata=KEYED_BY_NAME)
    ramp: Value
    slow_p_value: float = field(metadata=key("slow_noise_p_value"))
    adequacy: float = field(metadata=key("adequacy_p_value"))
    band_hz: tuple[float, float]
    lines: tuple[SpectralLine, ...]
    step: float = field(metadata=key("converter_step"))
    curve: AllanCurve = field(metadata=key("allan"))
    notes: tuple[str, ...]

    def __getitem__(self, name: str) -> NoiseParameter:
        """Return a noise process by its name, such as `angle_random_walk`, or kind, such as `white`."""
        return {key: one for one in self.parameters for key in (one.name, one.kind)}[name]

    @property
    def ramps(self) -> bool:
        """True if the axis drifts: the size of its drift is larger than U of the drift."""
        return self.ramp.U is not None and abs(self.ramp.value) > self.ramp.U

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the axis: its noise processes, Allan deviation, drift and sinusoids."""
        return super().as_dict() | {"ramp": {**self.ramp.as_dict(), "present": self.ramps}}


class AllanResult(JsonRecord):
    """Noise of the gyros or accelerometers of a session at rest.

    Attributes
    ----------
    part : {"gyro", "accelerometer"}
        Sensors that were fitted.
    unit : str
        `dps`, `mg` or `counts`.
    title, sensor, source : str
        Title, sensor and file of the session.
    simulated : bool
        True if the file states that it is simulated.
    period_s : float
        Time between samples.
    filter_m : int
        Parameter M of the chip's filter that the samples have passed.
    filter_known : bool
        True if the file or the user states the filter, False if the spectrum shows it.
    positions : tuple of int
        Number of the dwell that each record comes from.
    samples : tuple of int
        Number of samples of each record.
    axes : tuple of AxisNoise
        Noise of each axis.
    notes : tuple of str
        Remarks for the user on the session.
    """

    document_keys = (
        *("part", "unit", "title", "sensor", "source", "sample_rate_hz", "filter_m", "filter_known"),
        *("records", "duration_s", "axes", "notes"),
    )

    part: Part
    unit: str
    title: str
    sensor: str
    source: str
    simulated: bool
    period_s: float
    filter_m: int
    filter_known: bool
    positions: tuple[int, ...]
    samples: tuple[int, ...]
    axes: tuple[AxisNoise, ...] = field(metadata=KEYED_BY_NAME)
    notes: tuple[str, ...]

    @property
    def sample_rate_hz(self) -> float:
        """Number of samples per second."""
        return 1 / self.period_s

    @property
    def records(self) -> list[dict[str, Any]]:
        """Position, number of samples and duration of each record, as in the JSON document."""
        return [
            {"position": position, "samples": n, "duration_s": n * self.period_s}
            for position, n in zip(self.positions, self.samples, strict=True)
        ]

    @property
    def duration_s(self) -> float:
        """Total duration of all records in s."""
        return self.period_s * sum(self.samples)

    @property
    def longest_s(self) -> float:
        """Duration of the longest record in s."""
        return self.period_s * max(self.samples)

    def __getitem__(self, axis: str) -> AxisNoise:
        """Return the noise of the axis with this letter."""
        return {found.name: found for found in self.axes}[axis]

    def __repr__(self) -> str:
        held = "; ".join(
            f"{found.name}: "
            + ", ".join(f"{p.name} {p.likeliest:.3g} {p.unit}" for p in found.parameters if p.present)
            for found in self.axes
        )
        return f"AllanResult({self.part}, {math.floor(self.duration_s)} s at rest; {held})"


_FEW_DOF = 3.0


def name_shown(parameter: NoiseParameter) -> str:
    """Return the name of a noise process for people, such as `angle random walk`."""
    return parameter.name.replace("_", " ")


SWAY_HZ = 1.0
"""Frequency in Hz below which a sinusoid is named a sway: machines run faster, and buildings do not."""


class MovingPeak(NamedTuple):
    """A peak of the spectrum that moves during the records.

    `low_hz` and `high_hz` are its lowest and highest frequency in the pieces of the records. `ratio` is its
    median height, relative to the spectrum around it.
    """

    low_hz: float
    high_hz: float
    ratio: float

    @property
    def line(self) -> str:
        """Sentence for the user on the frequency and the height of the peak."""
        return (
            f"a line between {self.low_hz:.3g} and {self.high_hz:.3g} Hz, {self.ratio:.2g} times the noise"
            " around it: a resonance of the sensor, or a vibration that changes its speed"
        )


def notes_of(
    axis: AxisNoise, *, narrowed: bool, coarse: bool, loud: Sequence[int], peak: MovingPeak | None = None
) -> Iterator[str]:
    """Yield sentences for the user on the noise of an axis, such as excess noise, sinusoids or drift.

    `narrowed` is True if only a part of the frequency band was fitted, `coarse` if the noise is small
    against the step of the converter. `loud` has the dwell numbers of records that were left out because of
    larger noise or without noise. `peak` is a peak above the fitted band.
    """
    if loud:
        which = ", ".join(map(str, loud[:8])) + (", …" if len(loud) > 8 else "")
        yield (
            f"{counted(len(loud), 'record')} left out, louder than the quietest or without noise (positions"
            f" {which})"
        )
    if coarse:
        yield (
            f"the noise is below half a step of the converter ({format_number(axis.step)}): it shows"
            " its rounding"
        )
    if narrowed and axis.adequacy >= INADEQUATE:
        yield f"above {format_number(axis.band_hz[1])} Hz the spectrum is of another kind and was left out"
    yield from [] if peak is None else [peak.line]
    if axis.adequacy < INADEQUATE:
        yield f"these noises do not explain the spectrum ({format_p(axis.adequacy)}): u is too small"
    for line in axis.lines:
        yield (
            f"a sinusoid of {format_number(line.frequency_hz, 4)} Hz, amplitude"
            f" {format_number(line.amplitude)}, subtracted:"
            f" {'a sway, as of a building' if line.frequency_hz < SWAY_HZ else 'a vibration'}, or its alias"
        )
    flicker, walk = axis["flicker"], axis["walk"]
    if not flicker.present and not walk.present and axis.slow_p_value < SLOW_NOISE:
        yield (
            "there is slow noise, and the records are too short to separate bias instability from random"
            " walk: record four times as long at rest"
        )
    for parameter in (flicker, walk):
        if parameter.present and parameter.dof < _FEW_DOF:
            yield (
                f"{name_shown(parameter)} rests on {format_number(parameter.dof, 2)} degrees of"
                " freedom: a longer record makes it sure"
            )
    if axis.ramps:
        yield f"drifts by {format_number(axis.ramp.value)} {format_unit(axis.ramp.unit)}, which is no noise"


def cells(parameter: NoiseParameter) -> tuple[str, ...]:
    """Return the name, value, u, 95 % interval, ν and unit of a noise process that is present, as texts."""
    row = QuantityRow.of(parameter.name, Value(parameter.likeliest, parameter.u, parameter.unit))
    return (
        name_shown(parameter),
        row.value,
        row.u,
        f"{format_number(parameter.low)} … {format_number(parameter.high)}",
        "> 10⁴" if parameter.dof > 1e4 else format_number(parameter.dof, 2),
        row.unit,
    )


def headline(result: AllanResult) -> str:
    """Return one line of text with the total length, the number and the sample rate of the records."""
    records = counted(len(result.samples), "record")
    rate_hz = format_number(result.sample_rate_hz, 4)
    held = f"{format_number(result.duration_s, 4)} s in {records} at {rate_hz} Hz"
    return f"{held}, filter M = {result.filter_m}" if result.filter_m or result.filter_known else held


LEAST = 128
"""Smallest number of samples with which a record is used."""
_GAP = 2.5
"""Time between two samples, in sample periods, above which a record ends."""
_EVEN = 1.5
_MANY_LOST = 1e-3
_SHORT = 4
"""Largest ratio of the length of the longest record to the length of a record that is used."""
_FAST = 100_000
"""Number of samples from which a record is cut to a length with a fast transform (less than 2 % is
lost)."""


def rests_of(
    session: Session, part: Part, filter_m: int | None
) -> tuple[AllanResult, list[Floats], Floats]:
    """Return the gap-free records of a session at rest: its dwells, or the still parts of a recording.

    `filter_m` is the stated parameter M of the chip's filter; None if the user and the file state none.

    Returns
    -------
    AllanResult
        Facts of the session and of its records, without the noise of the axes.
    list of (n, axes) float
        Samples of each record in the result's unit, with the first sample of the record subtracted.
    (axes,) float
        Step of the analogue-to-digital converter in this unit; 0 if unknown.

    Raises
    ------
    UsageError
        No such part.
    DataError
        The session has no gyros or no gap-free record of `LEAST` samples, its times do not increase, an
        axis never changes, or the filter of an ADIS1635x is unknown.
    """
    where = session.source or session.title or "session"
    of_gyros = known_part(part) == GYRO
    held = [
        (dwell, series)
        for dwell in session.dwells
        if (series := dwell.gyro if of_gyros else dwell.accel) is not None
    ]
    if not held:
        if session.dwells:
            raise DataError(f"{where}: there are no gyros (gx, gy, gz): give --sensor-part accelerometer")
        raise DataError(f"{where}: nothing in it is at rest; record the part lying still")
    unit, scale = _unit(session, part, where)
    period_s = _period([dwell for dwell, _ in held], where)
    records, positions, lost = _records(held, period_s, (filter_m or 0) > 1, where)
    if not records:
        raise DataError(
            f"{where}: no rest has {counted(LEAST, 'sample')} ({LEAST * period_s:.3g} s) without a gap, as"
            " noise needs; let the part lie still for longer"
        )
    still = [axis for axis in range(records[0].shape[1]) if all(not np.ptp(r[:, axis]) for r in records)]
    if still:
        names = ", ".join("xyz"[axis] for axis in still)
        raise DataError(
            f"{where}: {names} never changes at rest: a dead axis, or noise below the converter"
        )
    # Records that are short against the longest show no slow noise.
    least = max(len(record) for record in records) / _SHORT
    kept = [k for k, record in enumerate(records) if len(record) >= least]
    short = len(records) - len(kept)
    notes = [f"{counted(short, 'rest')} shorter than a quarter of the longest left out"] if short else []
    records, positions = [records[k] for k in kept], [positions[k] for k in kept]
    step = scale * steps_of(records)
    samples = sum(len(record) for record in records)
    if lost > _MANY_LOST * samples:
        notes.append(f"{counted(lost, 'sample')} of {samples} are missing: high frequencies are less sure")
    if filter_m is None:
        if session.sensor in VARIANTS:
            raise DataError(
                f"{where}: does not state the chip's filter: add '# filter_m: M' or give --filter M"
            )
        notes.append("no filter is known: fitted in the band that these noises explain")
    result = AllanResult(
        part=part,
        unit=unit,
        title=session.title,
        sensor=session.sensor,
        source=session.source,
        simulated=bool(session.facts.get("simulated")),
        period_s=period_s,
        filter_m=filter_m or 0,
        filter_known=filter_m is not None,
        positions=tuple(positions),
        samples=tuple(len(record) for record in records),
        axes=(),
        notes=tuple(notes),
    )
    return result, [(record - record[0]) * scale for record in records], step


def _records(
    held: list[tuple[Dwell, Floats]], period_s: float, filtered: bool, where: str
) -> tuple[list[Floats], list[int], int]:
    """Split the samples of dwells at gaps into records without gaps.

    A gap is 2.5 sample periods `period_s` or longer; `where` names the session in messages. Samples lost in
    shorter gaps are interpolated if they are `filtered`: a filter of four taps makes neighbours alike.

    Returns the records, the number of the dwell of each, and the number of samples lost in shorter gaps.
    """
    records, positions, lost = [], [], 0
    for dwell, series in held:
        if not np.isfinite(series).all():
            raise DataError(f"{where}: dwell {dwell.position} holds NaN or infinity")
        gaps = np.flatnonzero(np.diff(dwell.time_s) > _GAP * period_s) + 1
        for first, last in pairwise([0, *gaps.tolist(), len(dwell)]):
            time_s, rows = dwell.time_s[first:last], series[first:last]
            missing = max(0, round(float(time_s[-1] - time_s[0]) / period_s) + 1 - len(rows))
            lost, after = lost + missing, np.flatnonzero(np.diff(time_s) > _EVEN * period_s) + 1
            # Times of a coarse clock do not show which samples are missing.
            if filtered and len(after) == missing:
                rows = np.insert(rows, after, (rows[after - 1] + rows[after]) / 2, axis=0)
            if (size := len(rows)) >= LEAST:
                if size >= _FAST:
                    # The largest size for which the Fourier transform is fast.
                    size = next(n for n in range(size, 0, -1) if fft.next_fast_len(n, real=True) == n)
                records.append(np.asarray(rows[:size], np.float64))
                positions.append(dwell.position)
    return records, positions, lost


def _unit(session: Session, part: Part, where: str) -> tuple[str, float]:
    """Return the unit of the result (dps, mg or counts), and the factor from the file's samples to it.

    `where` names the session in messages.
    """
    unit = session.gyro_unit if part == "gyro" else session.accel_unit
    if unit == "counts":
        return "counts", 1.0
    if part == "gyro":
        return "dps", dps_per_unit(session)
    if unit == "lsb" and session.sensor not in VARIANTS:
        raise DataError(f"{where}: the LSB of sensor '{session.sensor}' is not known; give --unit")
    return "mg", mg_per_unit(session)


def _period(dwells: list[Dwell], where: str) -> float:
    """Return the mean time in s between the samples of the longest dwell, without its gaps.

    `where` names the session in messages. The mean is over all its samples, because clocks with a coarse
    resolution repeat times.
    """
    longest = max(dwells, key=len)
    if len(longest) < 2:
        raise DataError(
            f"{where}: its dwells hold one averaged sample each; the noise needs the samples themselves"
        )
    steps = np.diff(longest.time_s)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not usual > 0:
        raise DataError(f"{where}: the times of the samples do not increase, so the rate is unknown")
    # A longer step is a missing sample; a step of zero comes from coarse times and counts.
    return float(steps[steps < _EVEN * usual].mean())


MOST_M = 6
_PASSED = 0.01
"""Smallest squared gain |H|² of the chip's filter at which the spectrum is fitted: at higher frequencies
rounding and the ends of a record disturb it.
"""
_FINE = 0.5
"""Ratio of the noise to the step of the converter above which rounding acts as additive noise."""
_BANDS = ((0.04, 0.3), (0.3, 1.0))
"""Bands in which the noise of records is compared, as shares of the highest fitted frequency; the slow
noise is below them."""
_LOUDER = 1.1


@solvable
def fit_allan(session: Session, part: Part = "gyro", *, filter_m: int | None = None) -> AllanResult:
    """Fit the noise of accelerometers or gyros at rest by restricted maximum likelihood.

    The result also has their Allan deviation.

    The processes are white noise (angle or velocity random walk), flicker (bias instability), rate random
    walk, and without a filter also quantization, of IEEE Std 952-1997, Annex C. Each has a
    profile-likelihood interval, or a limit if it may be absent.

    Parameters
    ----------
    session : Session
        Session with dwells, or a continuous recording with rests: each is a record with its own mean and
        slope.
    part : {"gyro", "accelerometer"}
        Sensors to fit the noise of.
    filter_m : int, optional
        Parameter M of the chip's filter, 0 to 6. By default it is the value that the session states, or 0
        (no filter) for a sensor other than an ADIS1635x.

    Raises
    ------
    UsageError
        No such part or filter.
    DataError
        Nothing at rest, too short, or the filter of an ADIS1635x is unknown.
    """
    if filter_m is not None and not 0 <= filter_m <= MOST_M:
        raise UsageError(f"filter M is {filter_m}: give 0 to {MOST_M}")
    rests, records, steps = rests_of(session, part, session.filter_m if filter_m is None else filter_m)
    found = []
    for axis, step in enumerate(steps.tolist()):
        current().share(axis / len(steps))
        found.append(_axis(rests, "xyz"[axis], [record[:, axis] for record in records], step))
    return replace(rests, axes=tuple(found))


def _flat(record: Floats) -> tuple[Floats, float]:
    """Subtract from samples (n,) the straight line that fits best; also return its slope per sample."""
    # Least squares slope against sample numbers about their middle.
    at = np.arange(len(record)) - (len(record) - 1) / 2
    centred = record - record.mean()
    slope = float(at @ centred) / float(at @ at)
    return np.asarray(centred - at * slope, np.float64), slope


def _rounding(flat: Sequence[Floats], step: float, m: int) -> tuple[Floats, bool]:
    """Return the autocovariance, by lag, of the errors that rounding to `step` causes.

    The noise passes the chip's filter of parameter M = `m` and is then rounded. `flat` are the records
    without their slopes. The second result is True if the step is too large against the noise of the
    samples for this computation; the first result is then zero.
    """
    # Changes within the filter's window are white noise, without the slow noise.
    lag = 1 << m
    weights = filter_weights(m)
    shape = np.correlate(weights, weights, "full")[len(weights) - 1 :]
    # Share of white noise in front of the filter that such a difference shows.
    kept = float(shape[0] - (shape[lag] if lag < len(shape) else 0.0))
    change = float(np.median([np.mean((record[lag:] - record[:-lag]) ** 2) / 2 for record in flat]))
    sigma = math.sqrt(max(change - step**2 / 12, 0.0) / kept)
    if step <= 0 or sigma * white_noise_gain(m) < _FINE * step:
        return np.zeros(1), step > 0
    return step**2 * rounding_covariance(m, sigma / step), False


@dataclass(frozen=True)
class _Fitted:
    likelihood: Likelihood
    theta: Floats
    deviance: float
    adequacy: float
    band: float


def _widest(data: Ordinates, band: float, kinds: Sequence[Kind]) -> _Fitted:
    """Fit the noise processes to the widest frequency band in which they explain the spectrum.

    The search starts at `band` (highest frequency in cycles per sample) and halves it. If no band is
    explained, it returns the fit that explains its band best.
    """
    tried = []
    fixed = [k for k, kind in enumerate(KINDS) if kind not in kinds]
    while True:
        likelihood = Likelihood(data.below(band), fixed)
        theta, deviance = likelihood.best()
        tried.append(_Fitted(likelihood, theta, deviance, likelihood.adequacy(theta), band))
        if tried[-1].adequacy >= INADEQUATE:
            return tried[-1]
        band /= 2
        if data.below(band).weight.sum() < LEAST / 2:
            return max(tried, key=lambda found: found.adequacy)


def _axis(rests: AllanResult, letter: str, columns: Sequence[Floats], step: float) -> AxisNoise:
    """Return the noise of one axis from its records `columns` (n,); `step` is the converter's step."""
    period_s, m = rests.period_s, rests.filter_m
    flat, slopes = zip(*map(_flat, columns), strict=True)
    rounding, coarse = _rounding(flat, step, m)
    # Above the highest fitted frequency (in cycles per sample) the filter passes too little power.
    grid = np.linspace(0.0, 0.5**m, 2049)
    highest = float(grid[filter_response(m, grid) >= _PASSED].max()) if m else 0.5
    lines: list[list[SpectralLine]] = []
    parts = []
    for record in flat:
        clean, own, masked = subtract_sinusoids(record, period_s, highest)
        lines.append(own)
        parts.append(ordinates(_flat(clean)[0] if own else record, m, period_s, rounding, masked))
    quiet = _quiet(parts, highest)
    # If the chip's filter is on, quantization is not fitted.
    kinds = KINDS if m == 0 else KINDS[1:]
    fitted = _widest(together([parts[k] for k in quiet]), highest, kinds)
    estimate = partial(profile, fitted.likelihood, fitted.theta, fitted.deviance)
    units = _UNITS[rests.unit]
    parameters = tuple(estimate(k, _NAMES[rests.part][k], units[k]) for k in map(KINDS.index, kinds))
    slow = _slow(fitted)
    ramp = _ramp(fitted, [slopes[k] for k in quiet], period_s, rests.unit)
    # Of the sinusoids that records show at one frequency (within 1 %), the strongest represents the others.
    strongest: list[SpectralLine] = []
    for line in sorted((one for k in quiet for one in lines[k]), key=lambda one: -one.amplitude):
        if all(abs(line.frequency_hz / other.frequency_hz - 1) > 0.01 for other in strongest):
            strongest.append(line)
    found = AxisNoise(
        name=letter,
        parameters=parameters,
        ramp=ramp,
        slow_p_value=slow,
        adequacy=fitted.adequacy,
        band_hz=(1 / (2 * period_s * max(map(len, columns))), fitted.band / period_s),
        lines=tuple(sorted(strongest, key=lambda one: one.frequency_hz)),
        step=step,
        curve=curve([columns[k] for k in quiet], _drawn(fitted, parameters), m, period_s, rounding),
        notes=(),
    )
    notes = notes_of(
        found,
        narrowed=fitted.band < highest,
        peak=moving_peak([flat[k] for k in quiet], period_s, fitted.band / period_s),
        coarse=coarse,
        loud=[rests.positions[k] for k in range(len(parts)) if k not in quiet],
    )
    return replace(found, notes=tuple(notes))


_PIECES, _SEGMENT, _AROUND = 12, 512, 33
"""Number of pieces of a record in which a peak is followed, samples in a segment of their spectra, and
number of frequencies around a peak that it is compared with."""
_LEAST_PEAK = 2.0
"""Least height of a peak relative to the spectrum around it; lobes of a filter are rounder."""


def moving_peak(records: Sequence[Floats], period_s: float, above_hz: float) -> MovingPeak | None:
    """Return the highest peak in the spectrum of records (n,) above the frequency `above_hz`.

    Each record is divided into pieces. The result is None unless every piece shows the peak, and its
    frequency changes little from one piece to the next.
    """
    pieces = [piece for one in records for piece in np.array_split(one, _PIECES)]
    if min((len(piece) for piece in pieces), default=0) < 8 * _SEGMENT:
        return None
    # Only long records need these imports, which are slow.
    from scipy.ndimage import median_filter
    from scipy.signal import welch
    from scipy.special import chdtri

    tops, ratios = [], []
    for piece in pieces:
        frequency, power = welch(piece, 1 / period_s, nperseg=_SEGMENT)
        # Power relative to the spectrum around each frequency, which needs neighbours on both sides.
        ratio = np.where(frequency > above_hz, power / median_filter(power, _AROUND), 0.0)
        ratio[: _AROUND // 2] = ratio[-_AROUND // 2 :] = 0.0
        tops.append(int(ratio.argmax()))
        ratios.append(float(ratio.max()))
        means = 2 * len(piece) // _SEGMENT
        if ratios[-1] < max(float(chdtri(means, INADEQUATE / _SEGMENT)) / means, _LEAST_PEAK):
            return None
    if np.abs(np.diff(tops)).max() > _AROUND // 2:
        return None
    low, high = (float(top / (_SEGMENT * period_s)) for top in (min(tops), max(tops)))
    return MovingPeak(low, high, float(np.median(ratios)))


def _quiet(parts: Sequence[Ordinates], highest: float) -> list[int]:
    """Return the indices of the records that are about as quiet as the quietest record with noise.

    The other records are louder, as by vibration, or never change, as at a limit of the range. `highest` is
    the highest fitted frequency in cycles per sample. Records are added from the quietest to the loudest. A
    record is left out if its mean power in one of two frequency bands is clearly larger than the mean power
    of the records added before.
    """
    bands = [(low * highest, high * highest) for low, high in _BANDS]
    level = np.empty((len(parts), len(bands)))
    weight = np.empty_like(level)
    for row, part in enumerate(parts):
        for column, (low, high) in enumerate(bands):
            inside = (part.frequency > low) & (part.frequency <= high)
            weight[row, column] = max(float(part.weight[inside].sum()), 1e-9)
            level[row, column] = part.weight[inside] @ part.power[inside] / weight[row, column]
    # From the quietest record on, by the product of both levels.
    order = np.argsort(level.prod(axis=1), kind="stable")
    order = order[level[order].any(axis=1)]
    kept = [int(order[0])]
    for k in order[1:].tolist():
        pool = weight[kept].sum(axis=0)
        usual = (weight[kept] * level[kept]).sum(axis=0) / pool
        limit = _LOUDER + 4 * np.sqrt(2 / weight[k] + 2 / pool)
        if (level[k] <= limit * usual).all():
            kept.append(k)
    return sorted(kept)


def _drawn(fitted: _Fitted, parameters: Sequence[NoiseParameter]) -> Floats:
    """Return the squared coefficients (4,) of the noise processes with which the Allan curve is predicted.

    They are zero for processes that may be absent. If the data show slow noise but cannot tell flicker
    noise from random walk, both keep their coefficients.
    """
    lacking = {one.kind for one in parameters if not one.present and one.kind != "white"}
    if lacking >= {"flicker", "walk"} and _slow(fitted) < SLOW_NOISE:
        lacking -= {"flicker", "walk"}
    absent = {KINDS.index(kind): 0.0 for kind in lacking}
    return fitted.likelihood.maximum(fitted.theta, absent)[0]


def _slow(fitted: _Fitted) -> float:
    """Return the p-value of the hypothesis that the records have no flicker noise and no random walk.

    It is an upper bound of this probability, because both coefficients cannot be negative.
    """
    without = fitted.likelihood.maximum(fitted.theta, {2: 0.0, 3: 0.0})[1]
    # Mixture of χ² with one and two degrees of freedom, an upper bound on the boundary; 1 for no gain.
    ratio = max(without - fitted.deviance, 0.0)
    return float(0.5 * special.chdtrc(1, ratio) + 0.5 * special.chdtrc(2, ratio))


def _ramp(fitted: _Fitted, slopes: list[float], period_s: float, unit: str) -> Value:
    """Return the drift of an axis in `unit` per second, with its standard uncertainty.

    It is the weighted mean of the slopes of all records. `slopes` are the slopes per sample of straight
    lines through the records, and `period_s` is the time between samples.
    """
    rest, weight = fitted.likelihood.slopes(fitted.theta)
    if not weight.sum() > 0:
        return Value(float(np.mean(slopes)) / period_s, None, f"{unit}/s")
    # Weighted mean of the slopes, each corrected by the slope of the likelihood.
    mean = float(np.average(slopes + rest, weights=weight))
    return Value(mean / period_s, 1 / math.sqrt(weight.sum()) / period_s, f"{unit}/s", factor=NORMAL_95)
