"""Every position that each dwell of a plan could have, with what it would show: the search's ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.determination import natural_units
from adis_gonio.fitting.estimation.fit import Fit, Values
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.uncertainty import ShownAngle
from adis_gonio.model.effects import AXES, Conditions, effect
from adis_gonio.plan.criteria import Best, Criterion
from adis_gonio.plan.imagined import Bench, imagined, perfect_mg
from adis_gonio.plan.sight import plain_terms
from adis_gonio.record.plans import Approach, Plan, Position
from adis_gonio.tracing.proposals import TYPICALS

_LOOSE = 1.0
"""Prior standard deviation of a base parameter in natural units: nothing beside any session."""
_HIDDEN = 1e-6
"""Share of a column's length beside the base model below which no plan shows it."""

Choice = NDArray[np.intp]


@dataclass(frozen=True)
class Candidates:
    """What each of n dwells would show at each of m positions.

    Attributes
    ----------
    angle_deg, approach : (m,) float
        The positions.
    columns : (n, m, 2, p) float
        ∂reading/∂parameter in mg: base parameters in natural units, amplitudes in typical ones.
    noise : (m, 2, 2) float
        Covariance of a reading in mg², without what dwells share: its own noise and the fixture's.
    own : (n, 2) float
        What a dwell has of its own beside, by when it is measured.
    shared : (2 n, 2 n) float
        Covariance of what dwells share, dwell by dwell and axis by axis.
    base : int
        Parameters of the base model and biases, the first of the p.
    gradient : (k, base) float
        Degrees of the shown angle by the base parameters, around the turn.
    """

    angle_deg: Floats
    approach: Floats
    columns: Floats
    noise: Floats
    own: Floats
    shared: Floats
    base: int
    gradient: Floats

    @property
    def dwells(self) -> int:
        """Dwells of a plan."""
        return len(self.columns)

    @property
    def precision(self) -> Floats:
        """Of the prior, (p,)."""
        precision = np.full(self.columns.shape[3], 1 / TYPICALS**2)
        precision[: self.base] = 1 / _LOOSE**2
        return precision

    def criterion(self, best: Best) -> Criterion:
        """The criterion by its name."""
        return Criterion(best, self.base, self.gradient, self.precision)

    def _covariance(self, choice: Choice) -> Floats:
        n = len(choice)
        covariance = self.shared.copy()
        each = np.arange(n)
        covariance.reshape(n, 2, n, 2)[each, :, each, :] += self.noise[choice] + self.own[
            :, :, None
        ] * np.eye(2)
        return covariance

    def information(self, choice: Choice) -> Floats:
        """Information (p, p) of a plan that takes position choice[k] in dwell k, the prior in it."""
        n, p = self.dwells, self.columns.shape[3]
        rows = self.columns[np.arange(n), choice].reshape(2 * n, p)
        solved = np.linalg.solve(self._covariance(choice), rows)
        return np.asarray(rows.T @ solved + np.diag(self.precision))

    def exchanged(self, choice: Choice, dwell: int) -> Floats:
        """The same (m, p, p) with each position in turn in the place of one dwell's.

        Of readings with a common covariance the information is that of all others and that of this one
        given them: with B = C_ir C_rr⁻¹, (J_i − B J_r)ᵀ (C_ii − B C_ri)⁻¹ (J_i − B J_r).
        """
        n, p = self.dwells, self.columns.shape[3]
        rows = self.columns[np.arange(n), choice].reshape(2 * n, p)
        here = np.zeros(2 * n, dtype=bool)
        here[2 * dwell : 2 * dwell + 2] = True
        covariance = self._covariance(choice)
        across = self.shared[np.ix_(~here, here)]
        solved = np.linalg.solve(
            covariance[np.ix_(~here, ~here)], np.concatenate([rows[~here], across], axis=1)
        )
        rest = rows[~here].T @ solved[:, :p] + np.diag(self.precision)
        left = self.columns[dwell] - across.T @ solved[:, :p]
        own = self.noise + np.diag(self.own[dwell]) + self.shared[np.ix_(here, here)]
        given = own - across.T @ solved[:, p:]
        return np.asarray(rest + left.transpose(0, 2, 1) @ np.linalg.solve(given, left))

    def plan(self, name: str, choice: Choice) -> Plan:
        """The plan of a choice.

        Where no effect minds the side of approach all are from below: a play of the stage that nobody
        thought of then turns the start angle and nothing else.
        """
        positions = tuple(
            Position(float(self.angle_deg[k]), _side(float(self.approach[k]))) for k in choice.tolist()
        )
        return Plan(name, positions)

    def nearest(self, plan: Plan) -> Choice:
        """The choice that is nearest to another plan of as many positions."""
        out = []
        for position in plan.positions:
            off = np.abs(wrap_degrees(self.angle_deg - (position.angle_deg or 0.0)))
            out.append(int((off + 1e-3 * (self.approach != position.approach)).argmin()))
        return np.array(out, dtype=np.intp)


def _side(approach: float) -> Approach:
    return -1 if approach < 0 else 1


def candidates(bench: Bench, dwells: int, beware: Sequence[str], grid_deg: float) -> Candidates:
    """Positions on a grid of angles, those of even spacing among them; from both sides where that matters.

    Raises
    ------
    UsageError
        An effect that no plan of positions decides about, or that no plan can show.
    """
    even = 360.0 * np.arange(dwells) / dwells
    angles = np.unique(np.round(np.concatenate([np.arange(0.0, 360.0 - 1e-9, grid_deg), even]), 9))
    up = Plan("even", tuple(Position(float(a), _side((-1.0) ** k)) for k, a in enumerate(even)))
    readings = imagined(up, bench)
    terms = plain_terms(readings, beware)
    sided = any("approach" in term.effect.needs for term in terms)
    sides = [1.0, -1.0] if sided else [0.0]
    place, side = np.tile(angles, len(sides)), np.repeat(sides, len(angles))
    fit = _everywhere(bench, readings, place, np.where(side == 0, 1.0, side))
    natural = natural_units(fit.data)
    columns = [fit.columns * natural]
    for term in terms:
        typical = np.array([term.effect.parameters[k].typical for k in term.amplitudes])
        columns.append(fit.candidate(term) * np.abs(typical))
        _refuse_hidden(term, columns[0], columns[-1])
    m, base = len(place), len(natural)
    tangent = fit.tangent[:m, :, 0]
    white = float(readings.own_covariance[0, 0, 0] - _own_flicker(readings)[0, 0])
    return Candidates(
        angle_deg=place,
        approach=side,
        columns=np.concatenate(columns, axis=2).reshape(dwells, m, 2, -1),
        noise=white * np.eye(2) + readings.fixture_rad**2 * tangent[:, :, None] * tangent[:, None, :],
        own=_own_flicker(readings),
        shared=_shared(readings),
        base=base,
        gradient=ShownAngle.around(fit).gradient,
    )


def _own_flicker(readings: Readings) -> Floats:
    assert readings.flicker is not None  # imagined readings have it, be it zero
    return readings.flicker


def _shared(readings: Readings) -> Floats:
    n = len(readings)
    if readings.slow is None:
        return np.zeros((2 * n, 2 * n))
    rows = readings.slow.reshape(2 * n, -1)
    return np.asarray(rows @ rows.T)


def _everywhere(bench: Bench, readings: Readings, place: Floats, side: Floats) -> Fit:
    """The base model and biases of a perfect part at every position (m,) in every dwell, dwell by dwell."""
    n, m = len(readings), len(place)
    angle = np.radians(np.tile(place, n))
    mean = perfect_mg(angle, bench)
    conditions = Conditions(
        time_s=np.repeat(readings.conditions.time_s, m),
        angle_rad=angle,
        order=np.repeat(np.arange(n, dtype=float), m),
        approach=np.tile(side, n),
    )
    data = from_means(
        mean,
        np.tile(np.eye(2), (n * m, 1, 1)),
        conditions,
        gravity_mg=readings.gravity_mg,
        fixture_rad=readings.fixture_rad,
        fitted=np.ones(len(readings.model.parameters), dtype=bool),
    )
    bias = NamedTerm("bias", (), 0.0, effect("bias", AXES[:2]))
    base = data.model.nominal
    base[data.model.index("alpha")] = np.radians(bench.start_deg)
    return Fit(data, (bias,), Values(base, np.zeros(n * m), (np.zeros(2),)), with_prior=False)


def _refuse_hidden(term: NamedTerm, base: Floats, columns: Floats) -> None:
    rows = columns.reshape(-1, columns.shape[2])
    within = base.reshape(len(rows), -1)
    size = np.maximum(np.linalg.norm(within, axis=0), 1e-300)
    left = rows - (within / size) @ np.linalg.lstsq(within / size, rows, rcond=1e-10)[0]
    if (np.linalg.norm(left, axis=0) <= _HIDDEN * np.linalg.norm(rows, axis=0)).any():
        raise UsageError(
            f"beware: {term.name} lies in the model that every session fits, so that no plan can show it: "
            "leave it out"
        )
