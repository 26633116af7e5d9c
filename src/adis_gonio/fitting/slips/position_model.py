"""Linear model of the angles of a session, all faults that positions may have, and their probabilities.

A fault is an error that makes the angle or the reading of a position wrong. The model compares the angles
by gravity and by the gyro with the declared angles.

ψ = α − φ is the angle of gravity to X. The part is at φ = θ + e, with declared angle θ and its error e.
The rows are linear around a calibration of the session that is near the truth:

* *angle* of a reading: y = (ψ by the reading) + θ = α − e + (∂ψ/∂calibration) δ + noise
* *length* of a reading: (|reading| − model)/G = (∂/∂calibration) δ + noise; it contains no declared angle
* *gyro*: γ − Δθ = Δe + s·γ + g-sensitivity·∫force + noise

δ are gains, misalignment, biases and every other effect of the catalogue that may be in the readings, each
with its prior. s and the g-sensitivity belong to the gyro. Effects that turn the part act on e.

An error of the first or of the last position has the same angles as a slip next to it.

| name | the part is at θ + e with |
|---|---|
| `mistyped` | e in one dwell, so that θ + e is a usual typing error of θ, or a whole degree |
| `misset` | e of any size in one dwell: the stage was set elsewhere, or slipped there alone |
| `swapped` | the declared angles of two dwells, each in the other's place |
| `slipped` | e in this dwell and all later ones: the part slipped in its fixture, or the stage's scale |
| `reversed` | declared turns of the opposite sign, from this dwell on |
| `gravity_wrong` | e = 0; the reading is wrong: acceleration, tilt out of the plane |
| `gyro_wrong` | e = 0; the integral of one turn is wrong: lost scans, saturation |

Priors are guesses about benches (chosen). The likelihood of an informative session outweighs them. If two
names predict the same readings, the priors alone decide, and the set of names reports both.

The probability of a session's data under each possible fault is the marginal likelihood of a linear
Gaussian model. The unknown parameters of the calibration, of the gyro and of the catalogue's effects have
priors and are integrated in closed form. The scatter of positions and readings beyond their stated
uncertainty is averaged over a grid. The gyro's gain, its g-sensitivity and the fixture are therefore
nuisance parameters of one likelihood, and none of them is a threshold.

The ordinary errors of a session are its errors without any fault: scatter of the set positions, scatter of
the readings beyond their noise, effects of the catalogue and slow changes (`ScatterPoint`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import typical_terms
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import PlanarTurn


@dataclass(frozen=True)
class Increments:
    """Rotations of the sensor from a dwell to the next, by the gyro along the axis of rotation.

    Attributes
    ----------
    turn : (g,) int
        Index of the dwell in which each of g completely recorded turns ends.
    angle_rad : (g,) float
        Integral of the rate minus its zero rate, in the direction of declared angles.
    u_rad : (g,) float
        Standard uncertainty of the angle by noise and by the drift of the zero rate between the dwells.
        Errors of the gain and the g-sensitivity are not included, because all turns share them.
    force_gs : (g, 2) float
        Integral over the turn of the readings of X and Y minus their mean at rest, in g·s: a g-sensitivity
        of 1 rad/s/g changes the angle by this.
    """

    turn: NDArray[np.intp]
    angle_rad: Floats
    u_rad: Floats
    force_gs: Floats


GAIN = 0.02
"""Prior standard deviation of the relative error of an accelerometer's scale factor (ADIS16350 data sheet,
B: ±2 %)."""
SKEW_RAD = math.radians(0.75)
"""Prior standard deviation of the misalignment Δφ, in rad (ADIS16350 data sheet, B: ±0.25° and ±0.5°)."""
BIAS_MG = 60.0
"""Prior standard deviation of a bias, in mg: one real ADIS16350 had +57, −21 and +46 mg."""
CALIBRATION_SD = np.array([GAIN, GAIN, SKEW_RAD, BIAS_MG, BIAS_MG])
"""Prior standard deviations of K_x, K_y, Δφ in rad, b_x and b_y in mg about `NOMINAL`."""
GYRO_GAIN = 0.01
"""Prior standard deviation of the relative error of a gyro's gain (D: no data sheet states it)."""
GYRO_FORCE_RAD = math.radians(0.1)
"""Prior standard deviation of a gyro's g-sensitivity in rad/s/g: twice the 0.05 °/s/g of the ADIS16350 data
sheet (B)."""
TYPICAL = 3.0
"""Prior standard deviation of an effect that may be present, in units of its typical size in the
catalogue."""
BASE = 5
"""Number of calibration parameters of the linear model: two scale factors, the misalignment, two biases."""
_LOOKED_FOR = {"dwell", "cycles"}
"""Choices of catalogue effects that are left out of the model, because the faults describe them: an effect
in one dwell, or with the cycles of the stage."""
ROUNDS = 4


NOMINAL = np.array([1.0, 1.0, 0.0, 0.0, 0.0])
"""Calibration of a perfect sensor: K_x, K_y, Δφ in rad, b_x and b_y in mg."""
TURNED_AWAY = 4.0
"""Deviation of a reading's length, in robust standard deviations, above which the reading hardly counts in
the first calibration."""


@dataclass(frozen=True)
class Rows:
    """Linear model of a session: rows for n angles, n lengths, and g turns with a complete record.

    Attributes
    ----------
    seen_rad : (n,) float
        Start angle α that the reading of each dwell shows at its declared angle (y), within ±π.
    length : (n,) float
        Length of each reading minus the length by the model, as a share of gravity.
    gyro_rad : (g,) float
        Angle γ of each turn by the gyro.
    turn : (g,) int
        Dwell in which each turn ends.
    design : (2n + g, p) float
        Derivatives of the rows by the start angle α, the calibration, the effects, and the gyro's
        parameters.
    prior_sd, prior_mean : (p,) float
        Prior of the values of the columns, as differences from the calibration of the linear model.
    effect : (p,) bool
        True for columns of effects of the catalogue, which have a guessed size.
    by_error : (2n + g, n) float
        Derivative of the rows by the error e of each position.
    noise : (2n + g, 2n + g) float
        Covariance of the rows from the noise of readings and gyro.
    reading : (2n + g, 2) float
        Derivative of each row by the reading of its dwell on X and Y, with the reading in units of gravity.
    course : (n,) float
        Time of each dwell as a share of the session.
    declared_rad : (n,) float
        Declared angle θ of each dwell; the angle by gravity for a dwell without one.
    declared : (n,) bool
        True for dwells with a declared angle.
    """

    seen_rad: Floats
    length: Floats
    gyro_rad: Floats
    turn: NDArray[np.intp]
    design: Floats
    prior_sd: Floats
    prior_mean: Floats
    effect: NDArray[np.bool_]
    by_error: Floats
    noise: Floats
    reading: Floats
    course: Floats
    declared_rad: Floats
    declared: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.declared)

    def observed(self, error_rad: Floats, zero_rad: float) -> Floats:
        """Return the residual (m,) of each row if the positions have these errors.

        The sensor is at the declared angle plus `error_rad` (n,), and the start angle α is `zero_rad`.
        """
        angle = wrap_radians(self.seen_rad + error_rad - zero_rad)
        asked = (self.declared_rad + error_rad)[self.turn] - (self.declared_rad + error_rad)[self.turn - 1]
        return np.concatenate([angle, self.length, wrap_radians(self.gyro_rad - asked)])


def common_zero(angle_rad: Floats) -> float:
    """Return the median of angles (n,) on the circle: the angle with the least sum of distances to all."""
    apart = np.abs(wrap_radians(angle_rad[:, None] - angle_rad[None, :])).sum(axis=0)
    return float(angle_rad[int(np.argmin(apart))])


@dataclass(frozen=True)
class _Local:
    """Model of the readings, linearised at each reading.

    `psi_rad` (n,) is the angle of gravity that each reading shows, and `tangent` (n, 2) the derivative of
    the ideal reading by this angle in mg. `seen` (2, n, 2) converts a change of the reading in mg to a
    change of this angle in rad, and to a change of the reading's length in units of gravity. `left_mg` is
    the reading minus the model, `ideal_mg` the model without biases; `base` (n, 2, 5) is the derivative of
    the readings by the calibration.
    """

    psi_rad: Floats
    tangent: Floats
    seen: Floats
    left_mg: Floats
    base: Floats
    ideal_mg: Floats


def _local(readings: Readings, calibration: Floats) -> _Local:
    model = PlanarTurn(readings.gravity_mg)
    base = np.concatenate([[0.0], calibration[:3]])
    psi = model.angle_rad(base, readings.mean - calibration[3:])
    zero = np.zeros(len(readings))
    ideal = model.ideal(base, psi, zero)
    tangent = model.tangent(base, psi, zero)[:, :, 0]
    square = (tangent**2).sum(axis=1, keepdims=True)
    # The normal of the circle at each reading is its tangent turned by 90°.
    across = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) / np.sqrt(square) / readings.gravity_mg
    columns = np.concatenate(
        [model.columns(base, psi, zero)[:, :, 1:], np.tile(np.eye(2), (len(readings), 1, 1))], axis=2
    )
    residual = readings.mean - ideal - calibration[3:]
    return _Local(psi, tangent, np.stack([tangent / square, across]), residual, columns, ideal)


def calibrate_by_length(readings: Readings) -> Floats:
    """Return a first estimate (5,) of the calibration, which uses no declared angle.

    Each calibrated reading must have the length of gravity. The values are K_x, K_y, Δφ in rad, b_x and b_y
    in mg.
    """
    calibration = NOMINAL
    for _ in range(ROUNDS if len(readings) > 1 else 1):
        near = _local(readings, calibration)
        across = near.seen[1]
        design = np.einsum("ni,nij->nj", across, near.base)
        residual = (across * near.left_mg).sum(axis=1)
        noise = np.einsum("ni,nij,nj->n", across, readings.covariance, across)
        spread = max(float(np.median(np.abs(residual))) / 0.6745, 1e-4)
        # A reading of an accelerated part is too long and has a small weight.
        weight = 1 / ((noise + 1e-4**2) * (1 + (residual / (TURNED_AWAY * spread)) ** 2))
        prior = NOMINAL - calibration
        precision = np.diag(CALIBRATION_SD**-2) + (design * weight[:, None]).T @ design
        step = np.linalg.solve(precision, prior / CALIBRATION_SD**2 + design.T @ (weight * residual))
        calibration = calibration + step
    return calibration


def rows_at(readings: Readings, turns: Increments, calibration: Floats) -> Rows:
    """Return the linear model of readings and turns, in start angle, calibration, effects and gyro.

    `calibration` (5,) is the point of linearisation: K_x, K_y, Δφ in rad, b_x and b_y in mg.
    """
    near, n = _local(readings, calibration), len(readings)
    off_rad, length = (near.seen * near.left_mg).sum(axis=2)
    seen_by = near.psi_rad + off_rad
    declared = np.isfinite(readings.angle_rad)
    given = np.where(declared, readings.angle_rad, 0.0)
    zero = common_zero(wrap_radians(seen_by + given)[declared])
    theta = np.where(declared, given, zero - seen_by)
    columns, turned, sizes = _effect_columns(readings.conditions, theta, near)
    by_angle, by_length = np.einsum("kni,nij->knj", near.seen, columns)
    turn, g = turns.turn, len(turns.turn)
    # Difference of each turn: angle of its end minus angle of the dwell before.
    steps = np.zeros((g, n))
    steps[np.arange(g), turn], steps[np.arange(g), turn - 1] = 1.0, -1.0
    design = np.block(
        [
            [np.ones((n, 1)), by_angle, np.zeros((n, 3))],
            [np.zeros((n, 1)), by_length, np.zeros((n, 3))],
            [np.zeros((g, 1)), -steps @ turned, turns.angle_rad[:, None], turns.force_gs],
        ]
    )
    sd = np.concatenate([[np.pi], CALIBRATION_SD, sizes, [GYRO_GAIN, GYRO_FORCE_RAD, GYRO_FORCE_RAD]])
    mean = np.zeros(len(sd))
    mean[1 : 1 + BASE] = NOMINAL - calibration
    effect = np.zeros(len(sd), dtype=np.bool_)
    effect[1 + BASE : -3] = True
    # Covariance of angle and length of each dwell, by the covariance of its reading.
    pairs = np.einsum("ani,nij,bnj->abn", near.seen, readings.covariance, near.seen)
    noise = np.pad(np.block([[np.diag(values) for values in row] for row in pairs]), (0, g))
    noise[2 * n :, 2 * n :] = np.diag(turns.u_rad**2)
    gone = readings.conditions.time_s - readings.conditions.time_s.min()
    return Rows(
        wrap_radians(seen_by + theta),
        length,
        turns.angle_rad,
        turn,
        design,
        sd,
        mean,
        effect,
        np.concatenate([-np.eye(n), np.zeros((n, n)), steps]),
        noise,
        np.pad(near.seen.reshape(2 * n, 2) * readings.gravity_mg, ((0, g), (0, 0))),
        gone / max(float(gone.max()), 1e-300),
        theta,
        declared,
    )


def _effect_columns(recorded: Conditions, theta: Floats, near: _Local) -> tuple[Floats, Floats, Floats]:
    """Return the derivatives of readings and true angles by the calibration and the catalogue's effects.

    Effects of the base model, effects within a dwell and effects whose conditions are not recorded are left
    out. The results for q amplitudes of effects are the derivatives of the readings (n, 2, 5 + q) in mg,
    the derivatives of the angle (n, 5 + q) by which the part has turned, in rad, and the prior standard
    deviation (q,) of each amplitude. `recorded` are the conditions of the dwells, `theta` (n,) their
    declared angles in rad.
    """
    # The declared angles, which may be wrong, are replaced by the angles of gravity.
    angle = common_zero(wrap_radians(near.psi_rad + theta)) - near.psi_rad
    before = np.concatenate([angle[:1], angle[:-1]])
    conditions = replace(recorded, angle_rad=angle, previous_angle_rad=before)
    moved, turned, sizes = [near.base], [np.zeros((len(theta), BASE))], []
    for term in typical_terms(PlanarTurn.part, 2, conditions, _LOOKED_FOR):
        if term.effect.in_base:
            continue
        columns = term.columns(near.ideal_mg, conditions)
        kept = np.isfinite(columns).reshape(-1, columns.shape[-1]).all(axis=0)
        own, none = columns[..., kept], np.zeros((len(theta), int(kept.sum())))
        moved.append(near.tangent[:, :, None] * own[:, None, :] if term.enters_angle else own)
        turned.append(own if term.enters_angle else none)
        sizes += [TYPICAL * term.effect.parameters[k].typical for k in np.array(term.amplitudes)[kept]]
    return np.concatenate(moved, axis=2), np.concatenate(turned, axis=1), np.array(sizes)


DIGITS = "0123456789"
LARGEST_DEG = 360.0


def possible_entries(declared_deg: float, others_deg: Iterable[float] = ()) -> tuple[float, ...]:
    """Return the angles in degrees that one typing error turns into `declared_deg`, without itself.

    The errors are a sign, a quarter or half turn (90 for 270), two digits exchanged, one digit wrong,
    dropped or doubled, a misplaced decimal point, and the angle of another position of the session
    (`others_deg`).
    """
    found = {*_wrongly_typed(declared_deg), *others_deg}
    return tuple(sorted(v + 0.0 for v in found if abs(v) <= LARGEST_DEG and v != declared_deg))


@lru_cache(1000)  # one search for faults asks several times for each angle of a session
def _wrongly_typed(declared_deg: float) -> frozenset[float]:
    """Return the angles in degrees, of any size, that one typing error turns into `declared_deg`."""
    text = f"{abs(declared_deg):g}"
    sign = -1.0 if declared_deg < 0 else 1.0
    written = {text[:k] + text[k + 1] + text[k] + text[k + 2 :] for k in range(len(text) - 1)}
    written |= {text[:k] + text[k + 1 :] for k in range(len(text))}
    written |= {text[:k] + digit + text[k:] for k in range(len(text) + 1) for digit in DIGITS}
    written |= {
        text[:k] + digit + text[k + 1 :] for k in range(len(text)) if text[k] != "." for digit in DIGITS
    }
    found = {-declared_deg, 10 * declared_deg, declared_deg / 10}
    found |= {declared_deg + turn for turn in (-180.0, -90.0, 90.0, 180.0)}
    for entry in written:
        with suppress(ValueError):
            found.add(sign * float(entry))
    return frozenset(found)


Name = Literal["mistyped", "misset", "swapped", "slipped", "reversed", "gravity_wrong", "gyro_wrong"]

SHARE: dict[Name, float] = {
    "mistyped": 0.02,
    "misset": 0.005,
    "swapped": 0.01,
    "slipped": 0.01,
    "reversed": 0.002,
    "gravity_wrong": 0.01,
    "gyro_wrong": 0.02,
}
"""Prior probability that a session has a fault of each name, at any one of its positions or turns."""
ACCUSED: frozenset[Name] = frozenset(
    {"mistyped", "misset", "swapped", "slipped", "reversed", "gravity_wrong"}
)
"""Names of faults that make a position wrong; `gyro_wrong` does not."""
LEAST_SLIP_RAD = math.radians(0.02)
"""Size of a slip, in rad, below which all sizes are equally probable."""
LISTED, WHOLE = 0.9, 0.07
"""Share of typing errors on the list of `possible_entries`, and share of other errors that give whole
degrees. Of errors in numbers that people copied 79 % were one wrong digit, 10 % two exchanged digits, 9 %
another error (Verhoeff, Error Detecting Decimal Codes, 1969)."""
PUSH_MG = (10.0, 50.0, 250.0)
"""Prior standard deviations, in mg, of the error of a wrong reading, such as by an acceleration."""
NEAR_RAD = math.radians(6.0)
"""Largest difference, in rad, between the angle by gravity before any calibration and the swapped angle, in
both dwells, for a swap to be considered."""

AmplitudePrior = Callable[[Floats, Floats], Floats]
"""Function of estimated sizes (g,) and their standard uncertainties (g,) that returns ln ∫ exp(−(a −
estimate)²/2u²) p(a) da, with the prior p of the size a."""
Names = dict[Name, tuple[float, AmplitudePrior | None]]


@dataclass(frozen=True)
class Pattern:
    """Errors that one fault causes at the positions, with the possible names of the fault.

    Attributes
    ----------
    dwells : tuple of int
        Indices of the affected dwells; for a fault of the gyro, the dwell in which the turn ends.
    unit : (n,) float
        Error of each position for a size of 1.
    amplitude : float
        Size at which the model is linearised.
    columns : (m, q) float
        Change of the rows of the model by each free size of the fault; q is 0, 1 or 2.
    names : mapping of Name to (float, AmplitudePrior or None)
        ln of the prior of each possible name, and the prior of the size; None without a free size.
    zero_rad : float
        Start angle α if the positions have these errors.
    """

    dwells: tuple[int, ...]
    unit: Floats
    amplitude: float
    columns: Floats
    names: Names
    zero_rad: float

    @property
    def name(self) -> Name:
        """First of the possible names of the fault."""
        return next(iter(self.names))

    @property
    def error_rad(self) -> Floats:
        """Error (n,) of each position at which the model is linearised."""
        return self.amplitude * self.unit


def patterns_of(rows: Rows, before_rad: Floats) -> list[Pattern]:
    """Return all patterns of errors that one further fault could cause.

    `before_rad` (n,) are the errors of the positions by the faults already accepted.
    """
    seen = wrap_radians(rows.seen_rad + before_rad)
    zero = common_zero(seen[rows.declared])
    found = list(_single(rows, seen, zero))
    found += _slipped(rows, seen)
    found += _swapped(rows, before_rad, seen, zero)
    found += _reversed(rows, before_rad, zero)
    n, m = len(rows), len(rows.by_error)
    for k in range(n):
        columns = np.zeros((m, 2))
        columns[k, 0] = columns[n + k, 1] = 1.0
        pushed: Names = {"gravity_wrong": (math.log(SHARE["gravity_wrong"] / n), None)}
        found.append(Pattern((k,), np.zeros(n), 0.0, columns, pushed, zero))
    for row, k in enumerate(rows.turn.tolist()):
        columns = np.zeros((m, 1))
        columns[2 * n + row] = 1.0
        names: Names = {"gyro_wrong": (math.log(SHARE["gyro_wrong"] / len(rows.turn)), _any_size)}
        found.append(Pattern((k,), np.zeros(n), 0.0, columns, names, zero))
    return found


def _single(rows: Rows, seen: Floats, zero: float) -> Iterator[Pattern]:
    places = np.flatnonzero(rows.declared).tolist()
    others = np.degrees(rows.declared_rad[rows.declared])
    for k in places:
        unit = np.zeros(len(rows))
        unit[k] = 1.0
        # The error that moves this dwell onto the angle of the others.
        amplitude = -float(wrap_radians(seen[k] - zero))
        declared = float(np.degrees(rows.declared_rad[k]))
        listed = np.radians(np.array(possible_entries(declared, others)) - declared)
        typed = partial(_typing_error, listed, declared)
        names: Names = {
            "mistyped": (math.log(SHARE["mistyped"] / len(places)), typed),
            "misset": (math.log(SHARE["misset"] / len(places)), _any_size),
        }
        yield Pattern((k,), unit, amplitude, rows.by_error @ unit[:, None], names, zero)


def _slipped(rows: Rows, seen: Floats) -> Iterator[Pattern]:
    n, declared = len(rows), rows.declared
    prior = math.log(SHARE["slipped"] / max(n - 1, 1))
    for k in range(1, n):
        later = np.arange(n) >= k
        if not (declared & later).any() or not (declared & ~later).any():
            continue
        # Median angles before and after the slip.
        zero = common_zero(seen[declared & ~later])
        amplitude = -float(wrap_radians(np.array(common_zero(seen[declared & later]) - zero)))
        unit = later.astype(float)
        names: Names = {"slipped": (prior, _any_size)}
        yield Pattern((k,), unit, amplitude, rows.by_error @ unit[:, None], names, zero)


def _swapped(rows: Rows, before_rad: Floats, seen: Floats, zero: float) -> Iterator[Pattern]:
    places = np.flatnonzero(rows.declared).tolist()
    pairs = len(places) * (len(places) - 1) / 2
    angle = rows.declared_rad + before_rad
    left = wrap_radians(seen - zero)
    for a, i in enumerate(places):
        for j in places[a + 1 :]:
            apart = float(wrap_radians(angle[j] - angle[i]))
            error = np.zeros(len(rows))
            # Each dwell gets the declared angle of the other.
            error[i], error[j] = apart, -apart
            near = np.abs(wrap_radians(left + error)[[i, j]]).max() < NEAR_RAD
            if abs(apart) > LEAST_SLIP_RAD and near:
                yield _fixed(rows, "swapped", (i, j), error, SHARE["swapped"] / pairs, zero)


def _reversed(rows: Rows, before_rad: Floats, zero: float) -> Iterator[Pattern]:
    n = len(rows)
    angle = rows.declared_rad + before_rad
    for k in range(1, n):
        # Mirror all later angles at the last one before.
        error = np.where(np.arange(n) >= k, -2 * (angle - angle[k - 1]), 0.0)
        error[~rows.declared] = 0.0
        if np.abs(wrap_radians(error)).max() > LEAST_SLIP_RAD:
            own = common_zero(wrap_radians(rows.seen_rad + before_rad + error)[rows.declared])
            yield _fixed(rows, "reversed", (k,), error, SHARE["reversed"] / (n - 1), own)


def _fixed(
    rows: Rows, name: Name, dwells: tuple[int, ...], error: Floats, prior: float, zero: float
) -> Pattern:
    none = np.zeros((len(rows.by_error), 0))
    return Pattern(dwells, error, 1.0, none, {name: (math.log(prior), None)}, zero)


def combined(rows: Rows, accepted: Sequence[Pattern]) -> Pattern:
    """Return the faults accepted so far as one pattern without a name; without any it has no error."""
    error = sum((p.error_rad for p in accepted), np.zeros(len(rows)))
    columns = np.hstack([np.zeros((len(rows.by_error), 0)), *(p.columns for p in accepted)])
    zero = common_zero(wrap_radians(rows.seen_rad + error)[rows.declared])
    return Pattern((), error, 1.0, columns, {}, zero)


# -- priors of amplitudes ------------------------------------------------------------------------------


def _any_size(estimate: Floats, u: Floats) -> Floats:
    """Return the log likelihood (g,) of a slip of unknown size, averaged over a prior of its size.

    `estimate` and `u` (g,) are the estimated size and its standard uncertainty in rad, under each of g
    assumptions on the scatter of positions and readings. Each order of magnitude of the size is equally
    probable, up to half a turn.
    """
    # Density 1/size up to half a turn, constant below the least slip.
    size = np.maximum(np.maximum(np.abs(wrap_radians(estimate)), u), LEAST_SLIP_RAD)
    density = 1 / (2 * size * (1 + math.log(math.pi / LEAST_SLIP_RAD)))
    return np.asarray(np.log(density * u * math.sqrt(2 * math.pi)))


def _typing_error(listed_rad: Floats, declared_deg: float, estimate: Floats, u: Floats) -> Floats:
    """Return the log likelihood (g,) of a wrongly typed angle, averaged over the possible intended angles.

    `estimate` and `u` (g,) are the estimated error and its standard uncertainty in rad, under each of g
    assumptions on the scatter of positions and readings. Three kinds of intended angle compete:
    `declared_deg` plus one of the errors `listed_rad`; a whole number of degrees; any angle.
    """
    spread = u * math.sqrt(2 * math.pi)
    # Mean over the list of Gaussians around each possible entry.
    on_list = np.exp(-0.5 * (wrap_radians(listed_rad[:, None] - estimate) / u) ** 2).mean(axis=0)
    meant = declared_deg + np.degrees(estimate)
    off = np.radians(meant - np.rint(meant))
    anywhere = spread / (2 * math.pi)
    whole = np.where(u < math.radians(0.3), np.exp(-0.5 * (off / u) ** 2) / 360, anywhere)
    return np.asarray(np.log(LISTED * on_list + WHOLE * whole + (1 - LISTED - WHOLE) * anywhere))


NOWHERE_RAD = 10.0
"""Standard deviation, in rad, of the error of an undeclared angle: so large that the angle is unknown."""
MORE_RAD = tuple(math.radians(value) for value in (0.0, 0.05, 0.2, 0.8))
"""Possible scatter of positions, in rad, in addition to the stated uncertainty of a declared angle; without
a stated uncertainty the scatter itself (0 stands for 0.01°)."""
MORE_STATED, MORE_UNSTATED = (0.8, 0.12, 0.06, 0.02), (0.25, 0.25, 0.25, 0.25)
LEAST_RAD = math.radians(0.01)
ROUGH = (0.0, 0.001, 0.005)
"""Possible standard deviations of readings in addition to their noise, as a share of gravity."""
ROUGH_PRIOR = (0.6, 0.3, 0.1)
LARGER = (1.0, 8.0)
"""Possible factors on the typical sizes of the catalogue's effects, common to all effects."""
LARGER_PRIOR = (0.7, 0.3)
WANDERS = ((math.radians(0.1), 0.0), (math.radians(0.5), 0.0), (0.0, 0.002))
"""Possible slow changes during a session: rotation of the part in its mount by the end (standard deviation
of a random walk, rad), and drift of the bias of an axis (as a share of gravity)."""
WANDERS_PRIOR = 0.02
"""Prior probability of each entry of `WANDERS`."""
GYRO_FAILS = 0.01
"""Prior probability that the gyro is useless: another unit, another axis, dead."""
USELESS_RAD = math.sqrt(2 * math.pi)
"""Standard deviation, in rad, of a turn by a useless gyro; it gives small angles the density 1/2π of an
angle that may have any value."""


@dataclass(frozen=True)
class ScatterPoint:
    """Assumed standard deviations of the errors that a session without a wrong position has.

    Attributes
    ----------
    position_rad : float
        Standard deviation of the set positions, in rad.
    reading : float
        Standard deviation of the readings, as a share of gravity.
    effects : float
        Factor on the typical amplitudes of the catalogue's effects.
    log_prior : float
        Natural logarithm of the prior probability of this assumption.
    turns_rad, drifts : float
        Standard deviation, at the end of the session, of a slow turn of the part (rad) and of a slow change
        of the readings (share of gravity).
    gyro_rad : float
        Standard deviation of each turn by the gyro, in addition to its noise.
    """

    position_rad: float
    reading: float
    effects: float
    log_prior: float
    turns_rad: float = 0.0
    drifts: float = 0.0
    gyro_rad: float = 0.0


def scatters(fixture_rad: float | None, *, gyro: bool) -> list[ScatterPoint]:
    """Return a grid of possible standard deviations of the errors that a session without a fault has.

    Each point of the grid has its prior probability. With a `gyro` each point occurs twice: the gyro works,
    or it is useless.

    `fixture_rad` is the stated standard uncertainty of a declared angle; None if it is not stated.
    """
    more = MORE_UNSTATED if fixture_rad is None else MORE_STATED
    stated = LEAST_RAD if fixture_rad is None else max(fixture_rad, LEAST_RAD / 10)
    # Without a random walk: all combinations of the three scatters.
    at_rest = math.log(1 - len(WANDERS) * WANDERS_PRIOR)
    still = [
        ScatterPoint(math.hypot(stated, a), b, c, math.log(pa * pb * pc) + at_rest)
        for (a, pa), (b, pb), (c, pc) in itertools.product(
            zip(MORE_RAD, more, strict=True),
            zip(ROUGH, ROUGH_PRIOR, strict=True),
            zip(LARGER, LARGER_PRIOR, strict=True),
        )
    ]
    wandering = [
        ScatterPoint(math.hypot(stated, a), 0.0, LARGER[0], math.log(pa * WANDERS_PRIOR), turns, drifts)
        for (a, pa), (turns, drifts) in itertools.product(zip(MORE_RAD, more, strict=True), WANDERS)
    ]
    grid = still + wandering
    cases = ((0.0, 1 - GYRO_FAILS), (USELESS_RAD, GYRO_FAILS)) if gyro else ((0.0, 1.0),)
    return [
        replace(one, log_prior=one.log_prior + math.log(share), gyro_rad=gyro_rad)
        for gyro_rad, share in cases
        for one in grid
    ]


@dataclass(frozen=True)
class Whitened:
    """Rows of the linear model, scaled to unit covariance under one assumption on the ordinary errors.

    Ordinary errors are the errors that a session without a fault has. The assumption is one point of the
    grid over which probabilities are averaged. The sizes of the known faults are free.

    Attributes
    ----------
    design : (m, p + q) float
        Columns of all values with a prior: calibration, effects, and sizes of known faults.
    prior_sd : (p + q,) float
        Prior standard deviation of the value of each column of `design`.
    inverse : (m, m) float
        Inverse of the Cholesky factor of the total covariance of the rows.
    log_scale : float
        ln of the prior of the assumption, and of the likelihood of residuals that are zero.
    """

    design: Floats
    prior_sd: Floats
    inverse: Floats
    log_scale: float

    @classmethod
    def of(cls, rows: Rows, scatter: ScatterPoint, known: Floats) -> Whitened:
        """Whiten the rows; the columns of `known` (m, q) are changes by free sizes of known faults."""
        design = np.hstack([rows.design, known])
        larger = np.where(rows.effect, scatter.effects, 1.0)
        prior_sd = np.concatenate([rows.prior_sd * larger, np.full(known.shape[1], np.pi)])
        spread = design * prior_sd
        root = np.linalg.cholesky(_noise(rows, scatter) + spread @ spread.T)
        normal = np.log(np.diag(root)).sum() + 0.5 * len(root) * math.log(2 * math.pi)
        return cls(design, prior_sd, np.linalg.inv(root), scatter.log_prior - float(normal))

    def weight(self, z: Floats) -> Floats:
        """Return ln (prior · likelihood) (k,) of the assumption for k sets of whitened residuals (m, k)."""
        return np.asarray(self.log_scale - 0.5 * (z * z).sum(axis=0))

    def white(self, values: Floats) -> Floats:
        """Whiten changes (m, …) of the rows: mix the rows so that their covariance is the identity."""
        return np.asarray(self.inverse @ values)


def _noise(rows: Rows, scatter: ScatterPoint) -> Floats:
    """Return the covariance (m, m) of the rows from noise and ordinary errors."""
    n = len(rows)
    # Random walks over the session: of the part in its mount, and of the zeros of both axes.
    walk = np.minimum(rows.course[:, None], rows.course)
    # e without a fault scatters around the declared angle, or anywhere without one.
    error = np.diag(np.where(rows.declared, scatter.position_rad, NOWHERE_RAD) ** 2)
    error += scatter.turns_rad**2 * walk
    readings = np.tile(walk, (2, 2)) * (rows.reading[: 2 * n] @ rows.reading[: 2 * n].T)
    noise = rows.noise + rows.by_error @ error @ rows.by_error.T
    noise[: 2 * n, : 2 * n] += scatter.reading**2 * np.eye(2 * n) + scatter.drifts**2 * readings
    noise[2 * n :, 2 * n :] += scatter.gyro_rad**2 * np.eye(len(rows.turn))
    return np.asarray(noise)


@dataclass(frozen=True)
class Weighed:
    """Log probabilities of each possible fault and of no further fault.

    Attributes
    ----------
    none : float
        ln of the probability that there is no further fault, not normalized.
    named : mapping of (int, Name) to float
        ln of the probability, not normalized, of each possible fault under each of its possible names. A
        key is the index of the fault and the name.
    scatter : ScatterPoint
        Most probable assumption on the ordinary errors, under the most probable fault or none.
    """

    none: float
    named: dict[tuple[int, Name], float]
    scatter: ScatterPoint

    @property
    def best(self) -> int | None:
        """Index of the fault that is most probable in total over its names.

        None if no fault is more probable than the absence of a further fault.
        """
        whole: dict[int, float] = {}
        for (k, _), value in self.named.items():
            whole[k] = float(np.logaddexp(whole.get(k, -math.inf), value))
        chosen = max(whole, key=whole.__getitem__, default=None)
        return None if chosen is None or whole[chosen] <= self.none else chosen


def weigh(rows: Rows, grid: Sequence[ScatterPoint], patterns: Sequence[Pattern], known: Pattern) -> Weighed:
    """Return the log probability of each further fault, given the known faults.

    `rows` are the linearised equations of the session, `grid` the assumptions on its ordinary errors over
    which the probability is averaged, `patterns` the possible faults, and `known` the known faults as one
    pattern (`combined`).
    """
    nothing = replace(known, amplitude=0.0, columns=known.columns[:, :0])
    every = [nothing, *patterns]
    residual = [rows.observed(known.error_rad + p.error_rad, p.zero_rad) for p in every]
    # First and second free direction of each pattern, zero without one.
    first, second = ([p.columns[:, k : k + 1].sum(axis=1) for p in every] for k in (0, 1))
    columns = np.stack([*residual, *first, *second], axis=1)
    columns[:, : len(every)] -= (rows.design @ rows.prior_mean)[:, None]
    plain = np.empty((len(every), len(grid)))
    moments = np.empty((5, len(every), len(grid)))
    for g, scatter in enumerate(grid):
        white = Whitened.of(rows, scatter, known.columns)
        z, v, w = np.split(white.white(columns), 3, axis=1)
        plain[:, g] = white.weight(z)
        for k, (a, b) in enumerate(((v, v), (v, z), (w, w), (w, z), (v, w))):
            moments[k, :, g] = (a * b).sum(axis=0)
    # ln (prior · likelihood) of no further fault and of each fault by name, at each point of the grid.
    keys = [(k, name) for k, pattern in enumerate(patterns) for name in pattern.names]
    named = [plain[1 + k] + _of_name(patterns[k], name, moments[:, 1 + k]) for k, name in keys]
    table = np.vstack([plain[:1], *named])
    logs = np.logaddexp.reduce(table, axis=1)
    best = int(np.argmax(table[int(np.argmax(logs))]))
    return Weighed(float(logs[0]), dict(zip(keys, logs[1:].tolist(), strict=True)), grid[best])


def _of_name(pattern: Pattern, name: Name, moments: Floats) -> Floats:
    """Return the log prior of a fault under a name, plus the gain in log likelihood by its size.

    The result has one value for each point of the grid.

    Parameters
    ----------
    moments : (5, grid) float
        Scalar products of the whitened directions v and w and the residual z: vv, vz, ww, wz, vw.
    """
    log_prior, amplitude = pattern.names[name]
    vv, vz, ww, wz, vw = moments
    if pattern.columns.shape[1] == 2:
        return np.asarray(log_prior + _pushes(vv, vz, ww, wz, vw))
    if amplitude is None or not vv.any():  # without the gyro its error is not observed
        return np.full(len(vv), log_prior)
    # If only the size of the pattern's linearisation is wrong, the residual is column · step.
    step = vz / vv
    found = amplitude(pattern.amplitude + step, 1 / np.sqrt(vv))
    return np.asarray(log_prior + 0.5 * vz * step + found)


def _pushes(vv: Floats, vz: Floats, ww: Floats, wz: Floats, vw: Floats) -> Floats:
    """Return the gain in log likelihood if the two amplitudes of a fault are free instead of zero.

    The vectors v and w are the changes of the whitened rows per unit of each amplitude, and z is the
    whitened residual. The arguments are scalar products of them: `vw` is v · w, and so on. The likelihood
    is averaged over several prior standard deviations of the amplitudes.
    """
    inverse = (1000.0 / np.array(PUSH_MG)[:, None]) ** 2
    # Two by two normal equations for each prior size, solved by hand.
    a, d = vv + inverse, ww + inverse
    det = a * d - vw * vw
    fit = (d * vz * vz - 2 * vw * vz * wz + a * wz * wz) / det
    gains = 0.5 * fit - 0.5 * np.log(det) + np.log(inverse)
    return np.asarray(np.logaddexp.reduce(gains, axis=0) - math.log(len(gains)))
