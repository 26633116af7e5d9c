"""List of all possible faults of positions: the errors that each one causes, and its prior.

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
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.fitting.slips.position_model import Halts, Rows, common_zero

DIGITS = "0123456789"
LARGEST_DEG = 360.0


def possible_entries(declared_deg: float, others_deg: Iterable[float] = ()) -> tuple[float, ...]:
    """Angles in degrees that one typing error turns into `declared_deg`; this angle is not included.

    The errors are a sign, a quarter or half turn (90 for 270), two digits exchanged, one digit wrong,
    dropped or doubled, a misplaced decimal point, and the angle of another position of the session.
    """
    found = {*_wrongly_typed(declared_deg), *others_deg}
    return tuple(sorted(v + 0.0 for v in found if abs(v) <= LARGEST_DEG and v != declared_deg))


@lru_cache(1000)  # one search for faults asks several times for each angle of a session
def _wrongly_typed(declared_deg: float) -> frozenset[float]:
    """Like `possible_entries`, without the other positions and without a limit."""
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
"""Prior probability that a session has such a fault, at one of all its places."""
ACCUSED: frozenset[Name] = frozenset(
    {"mistyped", "misset", "swapped", "slipped", "reversed", "gravity_wrong"}
)
"""Names that accuse a position; an error of a gyro accuses none."""
LEAST_SLIP_RAD = math.radians(0.02)
"""Size below which all slips are equally probable."""
LISTED, WHOLE = 0.9, 0.07
"""Share of mistakes on the list of `possible_entries`, and share of other whole degrees.

Of errors in numbers that people copied 79 % were one wrong digit, 10 % two exchanged digits, 9 % another
error (Verhoeff, Error Detecting Decimal Codes, 1969)."""
PUSH_MG = (10.0, 50.0, 250.0)
"""Prior standard deviations of a wrong reading, such as by an acceleration, in mg."""
NEAR_RAD = math.radians(6.0)
"""Largest distance of gravity from both angles of a swap, before any calibration, for the swap to be
considered."""

AmplitudePrior = Callable[[Floats, Floats], Floats]
"""(estimates (g,), their standard uncertainties (g,)) → ln ∫ exp(−(a − estimate)²/2u²) p(a) da."""
Names = dict[Name, tuple[float, AmplitudePrior | None]]


@dataclass(frozen=True)
class Pattern:
    """Errors that one fault causes at the positions, with the possible names of the fault.

    Attributes
    ----------
    dwells : tuple of int
        Rows of the affected dwells; for a fault of the gyro, the dwell in which the turn ends.
    error_rad : (n,) float
        Error of each position at which the model is linearised.
    columns : (m, q) float
        Change of the rows of the model by each free size of the fault; q is 0, 1 or 2.
    unit : (n,) float
        Error of each position for a size of 1, if one size is free.
    amplitude : float
        Size of the fault that is already in `error_rad`.
    names : mapping of Name to (float, AmplitudePrior or None)
        ln of the prior of each name, and the prior of the size; None without a free size.
    """

    dwells: tuple[int, ...]
    error_rad: Floats
    columns: Floats
    unit: Floats
    amplitude: float
    names: Names
    zero_rad: float

    @property
    def name(self) -> Name:
        """First name of a cause in `names`."""
        return next(iter(self.names))


def patterns_of(rows: Rows, before_rad: Floats) -> list[Pattern]:
    """All patterns of error that one further fault can cause.

    `before_rad` (n,) are the errors of the positions by the faults already accepted.
    """
    seen = wrap_radians(rows.seen_rad + before_rad)
    zero = common_zero(seen[rows.declared])
    found = list(_single(rows, seen, zero))
    found += _slipped(rows, seen)
    found += _swapped(rows, before_rad, seen, zero)
    found += _reversed(rows, before_rad, zero)
    found += _pushed(rows, zero)
    found += _gyro(rows, zero)
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
        names: Names = {
            "mistyped": (
                math.log(SHARE["mistyped"] / len(places)),
                partial(_typing_error, listed, declared),
            ),
            "misset": (math.log(SHARE["misset"] / len(places)), _any_size),
        }
        yield Pattern((k,), amplitude * unit, rows.by_error @ unit[:, None], unit, amplitude, names, zero)


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
        halts = rows.halts.get(k)
        names: Names = {
            "slipped": (prior, _any_size if halts is None else partial(_slip_after_rests, halts))
        }
        yield Pattern((k,), amplitude * unit, rows.by_error @ unit[:, None], unit, amplitude, names, zero)


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
    return Pattern(dwells, error, none, np.zeros(len(rows)), 0.0, {name: (math.log(prior), None)}, zero)


def _pushed(rows: Rows, zero: float) -> Iterator[Pattern]:
    n = len(rows)
    names: Names = {"gravity_wrong": (math.log(SHARE["gravity_wrong"] / n), None)}
    for k in range(n):
        columns = np.zeros((len(rows.by_error), 2))
        columns[k, 0] = columns[n + k, 1] = 1.0
        yield Pattern((k,), np.zeros(n), columns, np.zeros(n), 0.0, names, zero)


def _gyro(rows: Rows, zero: float) -> Iterator[Pattern]:
    n = len(rows)
    for row, k in enumerate(rows.turn):
        columns = np.zeros((len(rows.by_error), 1))
        columns[2 * n + row] = 1.0
        names: Names = {"gyro_wrong": (math.log(SHARE["gyro_wrong"] / len(rows.turn)), _any_size)}
        yield Pattern((int(k),), np.zeros(n), columns, np.zeros(n), 0.0, names, zero)


# -- priors of amplitudes ------------------------------------------------------------------------------


def _any_size(estimate: Floats, u: Floats) -> Floats:
    """Ln of the evidence of a slip without a known size, from its estimate and u in rad.

    Each order of magnitude of the slip is equally probable, up to half a turn.
    """
    # Density 1/size up to half a turn, constant below the least slip.
    size = np.maximum(np.maximum(np.abs(wrap_radians(estimate)), u), LEAST_SLIP_RAD)
    density = 1 / (2 * size * (1 + math.log(math.pi / LEAST_SLIP_RAD)))
    return np.asarray(np.log(density * u * math.sqrt(2 * math.pi)))


def _slip_after_rests(halts: Halts, estimate: Floats, u: Floats) -> Floats:
    """Like `_any_size`, with the evidence from the rests that the gyro recorded during the turn."""
    return _any_size(estimate, u) + halts.log_odds(wrap_radians(estimate), u)


def _typing_error(listed_rad: Floats, declared_deg: float, estimate: Floats, u: Floats) -> Floats:
    """Ln of the evidence of a wrongly typed angle, from the estimated error and its u in rad.

    The intended angle is on the list of usual angles, a whole degree, or any angle.
    """
    spread = u * math.sqrt(2 * math.pi)
    # Mean over the list of Gaussians around each possible entry.
    on_list = np.exp(-0.5 * (wrap_radians(listed_rad[:, None] - estimate) / u) ** 2).mean(axis=0)
    meant = declared_deg + np.degrees(estimate)
    off = np.radians(meant - np.rint(meant))
    anywhere = spread / (2 * math.pi)
    whole = np.where(u < math.radians(0.3), np.exp(-0.5 * (off / u) ** 2) / 360, anywhere)
    return np.asarray(np.log(LISTED * on_list + WHOLE * whole + (1 - LISTED - WHOLE) * anywhere))
