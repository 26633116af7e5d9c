"""The most that anybody could tell of the sessions of `slip_statistics`: one who knows how they are made.

Nothing of `adis_gonio.fitting.slips` is in here. The oracle knows what the tool guesses: the shares of good
and faulty sessions, the sizes of slips, the list of mistakes from which entries were drawn, the fixture's
uncertainty, the variant's figures and the gyros'. It does not know what a session cannot: this part's own
gains and biases, the angle of the part at the stage's zero, where the hand truly stood, and the plan. Of
every fault that could have been made it works out the probability of all that was recorded, each part's
unknowns by Gauss–Newton and Laplace's approximation, in the readings themselves. It names the fault of the
highest posterior, and nothing where that is that nothing is wrong: the best that can be done on average.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.model.records import Session

GOOD = 5 / 7
"""Share of good sessions; the three faults have equal shares of the others."""
GYRO_GAIN, GYRO_G_DPS = 0.0085, 0.05
TEMPERATURE_C = 0.3
"""How far the temperature goes during a session."""
NEAR_DEG = 8.0
"""Faults that leave an angle so far off are not worked out: many times what biases do."""
ROUNDS = 5

Listed = Callable[[float], Iterable[float]]


@dataclass(frozen=True)
class Fault:
    """One thing that may have been done, and ln of how often it is done just so."""

    name: str
    positions: tuple[int, ...]
    stood_deg: Floats
    log_prior: float
    later: Floats | None = None


@dataclass(frozen=True)
class Answer:
    """The most probable fault with its posterior and error in degrees; `none` where nothing is wrong."""

    name: str
    positions: tuple[int, ...]
    probability: float
    error_deg: float
    u_deg: float


@dataclass(frozen=True)
class Law:
    """How faults are made: sizes of slips, and which entries hands make of an angle."""

    least_deg: float
    most_deg: float
    mistakes: Mistakes


class Mistakes:
    """Entries that hands make of an angle, those that are near enough to be none left out."""

    def __init__(self, listed: Listed, apart_deg: float) -> None:
        self._listed, self._apart = listed, apart_deg
        self._known: dict[float, Floats] = {}

    def of(self, angle_deg: float) -> Floats:
        """Declared angles that may come of a true one, each as probable as another."""
        if angle_deg not in self._known:
            found = np.array([*self._listed(angle_deg)])
            self._known[angle_deg] = found[np.abs(_wrapped(found - angle_deg)) > self._apart]
        return self._known[angle_deg]

    def meant_by(self, declared_deg: float) -> Iterator[tuple[float, int]]:
        """True angles from which an entry may come, and of how many entries of that angle it is one."""
        for angle in self._listed(declared_deg):  # what hands do hands undo: the same mistakes, backwards
            entries = self.of(angle)
            if np.abs(entries - declared_deg).min(initial=1.0) < 1e-3:
                yield angle, len(entries)


def answer(session: Session, law: Law) -> Answer:
    """What the oracle says of a session."""
    seen = _Seen.of(session)
    every = [*_faults(seen, law)]
    faults = [fault for fault in every if seen.near(fault)] or every
    found = [seen.evidence(fault, law) for fault in faults]
    logs = np.array([one[0] for one in found])
    best = int(np.argmax(logs))
    fault, (_, size, u) = faults[best], found[best]
    share = float(np.exp(logs[best] - np.logaddexp.reduce(logs)))
    if fault.later is None and fault.positions:
        size = float(_wrapped(fault.stood_deg - seen.declared_deg)[fault.positions[0]])
    return Answer(fault.name, fault.positions, share, size, u)


def _faults(seen: _Seen, law: Law) -> Iterator[Fault]:
    declared, n = seen.declared_deg, len(seen.declared_deg)
    each = math.log((1 - GOOD) / 3)
    yield Fault("none", (), declared, math.log(GOOD))
    for k in range(1, n):
        later = (np.arange(n) >= k).astype(float)
        size = seen.shift_deg(later)
        yield Fault("slipped", (k,), declared + size * later, each - math.log(n - 1), later)
    pairs = [
        (i, j) for i in range(n) for j in range(i + 1, n) if abs(_wrapped(declared[i] - declared[j])) > 1.0
    ]
    for i, j in pairs:
        stood = declared.copy()
        stood[[i, j]] = declared[[j, i]]
        yield Fault("swapped", (i, j), stood, each - math.log(len(pairs)))
    for k in range(n):
        for angle, entries in law.mistakes.meant_by(float(declared[k])):
            stood = declared.copy()
            stood[k] = angle
            yield Fault("mistyped", (k,), stood, each - math.log(n * entries))


@dataclass(frozen=True)
class _Seen:
    """What was recorded: readings (n, 2) in mg with their u, turns (n - 1,) in degrees with theirs."""

    declared_deg: Floats
    reading_mg: Floats
    reading_u_mg: float
    turned_deg: Floats | None
    turned_u_deg: Floats | None
    fixture_deg: float
    gravity_mg: float
    sd: Floats

    @classmethod
    def of(cls, session: Session) -> _Seen:
        figures = VARIANTS["adis16354"].performance
        dwells = session.dwells
        samples = np.mean([len(dwell) for dwell in dwells])
        u = np.sqrt(
            figures.noise_mg**2 / samples
            + figures.bias_instability_mg**2
            + (TEMPERATURE_C * figures.bias_tempco_mg_per_c) ** 2
        )
        turned, turned_u = _turned(session, figures.gyro_instability_dps)
        skew = math.radians(figures.non_orthogonality_deg) / math.sqrt(3)
        gain = figures.scale_error_typical
        sd = np.array([10.0, gain, gain, skew, figures.initial_bias_mg, figures.initial_bias_mg, GYRO_GAIN])
        return cls(
            np.array([dwell.angle_deg for dwell in dwells], float),
            np.array([dwell.accel.mean(axis=0)[:2] for dwell in dwells]),
            float(u), turned, turned_u, float(session.fixture_sigma_deg or 0.0), 1000.0, sd,
        )  # fmt: skip

    @property
    def _angle_deg(self) -> Floats:
        """Of gravity to X, as a perfect part would have it."""
        return np.degrees(np.arctan2(self.reading_mg[:, 1], self.reading_mg[:, 0]))

    def shift_deg(self, later: Floats) -> float:
        """How much further those marked stand than the others, by medians."""
        alpha = self._angle_deg + self.declared_deg
        zero = _middle(alpha[later == 0])
        return -float(_wrapped(_middle(alpha[later == 1]) - zero))

    def near(self, fault: Fault) -> bool:
        """Whether it is worth working out."""
        alpha = self._angle_deg + fault.stood_deg
        return bool(np.abs(_wrapped(alpha - _middle(alpha))).max() < NEAR_DEG)

    def evidence(self, fault: Fault, law: Law) -> tuple[float, float, float]:
        """Ln of the joint probability, and the size of a slip with its u in degrees."""
        n, free = len(self.declared_deg), int(fault.later is not None)
        sigma = math.radians(max(self.fixture_deg, 1e-4))
        # The angle at zero, gains, misalignment, biases, the gyro's gain, the hand's errors; a slip.
        mean = np.concatenate([[0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0], np.zeros(n + free)])
        sd = np.concatenate([self.sd, np.full(n, sigma), np.full(free, 10.0)])
        value = mean.copy()
        value[0] = math.radians(_middle(self._angle_deg + fault.stood_deg))
        mean[0] = value[0]  # any angle is as probable
        for _ in range(ROUNDS):
            left, slope = self._left(value, fault)
            precision = slope.T @ slope + np.diag(sd**-2)
            value = value + np.linalg.solve(precision, slope.T @ left - (value - mean) / sd**2)
        left, slope = self._left(value, fault)
        precision = slope.T @ slope + np.diag(sd**-2)
        off = (value - mean) / sd
        fixed = slice(0, 7 + n)
        log = -0.5 * (left @ left + off[fixed] @ off[fixed]) - np.log(sd[fixed]).sum()
        log += fault.log_prior - 0.5 * np.linalg.slogdet(precision)[1]
        if not free or fault.later is None:
            return float(log), 0.0, self.fixture_deg
        u = math.degrees(math.sqrt(np.linalg.inv(precision)[-1, -1]))
        k = fault.positions[0]
        size = float(_wrapped(fault.stood_deg[k] - self.declared_deg[k])) + math.degrees(value[-1])
        log += 0.5 * math.log(2 * math.pi) + _log_share(size, u, law)
        return float(log), size, u

    def _left(self, value: Floats, fault: Fault) -> tuple[Floats, Floats]:
        """Rows over their u: what is left, and what the unknowns do to them."""
        n, free = len(self.declared_deg), int(fault.later is not None)
        alpha, gain_x, gain_y, skew, bias_x, bias_y, gyro = value[:7]
        error, g = value[7 : 7 + n], self.gravity_mg
        stood = np.radians(fault.stood_deg)
        later = np.zeros(n) if fault.later is None else fault.later
        if free:
            stood = stood + value[-1] * later
        psi = alpha - stood + error
        model = [gain_x * g * np.cos(psi) + bias_x, gain_y * g * np.sin(psi + skew) + bias_y]
        left = (self.reading_mg - np.stack(model, axis=1)).T / self.reading_u_mg
        by_x, by_y = -gain_x * g * np.sin(psi), gain_y * g * np.cos(psi + skew)
        slope = np.zeros((2, n, len(value)))
        slope[0, :, 0], slope[1, :, 0] = by_x, by_y
        slope[0, :, 1], slope[1, :, 2] = g * np.cos(psi), g * np.sin(psi + skew)
        slope[1, :, 3] = by_y
        slope[0, :, 4] = slope[1, :, 5] = 1.0
        slope[0, np.arange(n), 7 + np.arange(n)], slope[1, np.arange(n), 7 + np.arange(n)] = by_x, by_y
        if free:
            slope[0, :, -1], slope[1, :, -1] = -by_x * later, -by_y * later
        slope = slope.reshape(2 * n, -1) / self.reading_u_mg
        if self.turned_deg is None or self.turned_u_deg is None:
            return left.ravel(), slope
        step = np.diff(stood - error)
        rows = np.zeros((n - 1, len(value)))
        rows[:, 6] = step
        rows[np.arange(n - 1), 8 + np.arange(n - 1)] = -(1 + gyro)
        rows[np.arange(n - 1), 7 + np.arange(n - 1)] = 1 + gyro
        if free:
            rows[:, -1] = (1 + gyro) * np.diff(later)
        u = np.radians(self.turned_u_deg)
        asked = (1 + gyro) * step
        off = np.radians(_wrapped(self.turned_deg - np.degrees(asked)))
        return np.concatenate([left.ravel(), off / u]), np.concatenate([slope, rows / u[:, None]])


def _turned(session: Session, drift_dps: float) -> tuple[Floats | None, Floats | None]:
    """Angles turned from dwell to dwell, and their u, by the trapezoidal rule over all of the recording."""
    whole = session.recording
    if whole is None or whole.gyro is None:
        return None, None
    turned, u = [], []
    for before, after in zip(session.dwells[:-1], session.dwells[1:], strict=True):
        assert before.gyro is not None
        assert after.gyro is not None
        rows = slice(*np.searchsorted(whole.time_s, [before.time_s[-1], after.time_s[0]]))
        time, rate = whole.time_s[rows], whole.gyro[rows, 2]
        length = float(time[-1] - time[0])
        zero = (before.gyro[:, 2].mean() + after.gyro[:, 2].mean()) / 2
        turned.append(float(np.trapezoid(rate - zero, time)))
        u.append(math.hypot(0.02, length * math.hypot(drift_dps, GYRO_G_DPS / 2)))
    return np.array(turned), np.array(u)


def _log_share(size_deg: float, u_deg: float, law: Law) -> float:
    """Ln of the density (1/rad) of slips, by the part of the posterior that sizes allow."""
    a, b = law.least_deg, law.most_deg

    def below(x: float) -> float:
        return 0.5 * math.erfc((size_deg - x) / (u_deg * math.sqrt(2)))

    part = below(b) - below(a) + below(-a) - below(-b)
    return math.log(max(part, 1e-300)) - math.log(2 * math.radians(b - a))


def _middle(angle_deg: Floats) -> float:
    """The angle from which the others are least away."""
    apart = np.abs(_wrapped(angle_deg[:, None] - angle_deg[None, :])).sum(axis=0)
    return float(angle_deg[int(np.argmin(apart))])


def _wrapped(angle_deg: Floats) -> Floats:
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)


__all__ = ["Answer", "Law", "Mistakes", "answer"]
