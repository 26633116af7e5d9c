"""Conformity of an angle with a tolerance, by JCGM 106:2012 and ILAC-G8:09/2019.

The measurand is the largest |error| of the angle over the turn, E = max |e(ψ)|. The errors at all angles
have the joint posterior distribution e = m + R z: m is the estimate, R Rᵀ the covariance, and z is standard
normal (or has Student's distribution), with a flat prior. E exceeds the tolerance if the error exceeds it
at any angle, so the specific risk of a false accept is

    p = P(E > T) = 1 − P(|m(ψ) + R(ψ) z| ≤ T at all ψ)

The set of all z for which the angle conforms is convex. Along a direction d, with z = r d, it is therefore
one interval of r ≥ 0; its probability follows from the distribution of r = |z|. The mean of this
probability over random directions is 1 − p. For a single angle the result is exact: it is then the
conformance probability of JCGM 106, clause 7.

| rule | pass | else |
|---|---|---|
| `guarded` | p ≤ 2.5 % (guard band w = U; ILAC-G8, 4.2.2) | fail if 1 − p ≤ 2.5 %, else undecided |
| `simple` | p ≤ 50 %: the median of E is within T (ILAC-G8, 4.2.1) | fail |
| `shared` | as `simple`, if U is at most T/3 at all angles (JCGM 106, 8.2) | fail, undecided if U > T/3 |

The ratio of 3 is a choice of this program; with `guarded`, another risk than 2.5 % can be agreed. ILAC-G8's
clauses and its table of guard bands were compared with published copies. JCGM 106 itself was not available:
its clause numbers are unverified.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, Context
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import INLINE, JsonRecord, key
from adis_gonio.base.numbers import format_number, format_percent
from adis_gonio.base.uncertainty import coverage_factor

DecisionRule = Literal["guarded", "simple", "shared"]
RULES: tuple[DecisionRule, ...] = get_args(DecisionRule)
Verdict = Literal["pass", "fail", "undecided"]
GUARDED_RISK = 0.025
"""Largest risk of a wrong pass or fail by the rule `guarded`: U as guard band leaves 2.5 % on one side."""
SIMPLE_RISK = 0.5
LEAST_RATIO = 3.0
"""Least ratio of the tolerance to U, the expanded uncertainty of the error, for the rule `shared`."""
_NOTHING = 1e-9
"""Size of an independent part of the error, relative to the largest part, up to which it is rounding."""


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """Error of the sensor's angle as a function of the angle over one turn: its posterior distribution.

    Attributes
    ----------
    angle_deg : (m,) float
        Angles of the turn.
    error_deg : (m,) float
        Estimated error at each angle: angle shown by the sensor minus true angle.
    root_deg : (m, k) float
        Change of the error by one standard uncertainty of each of k independent causes.
    dof : float
        Degrees of freedom of the standard uncertainties.
    """

    angle_deg: Floats
    error_deg: Floats
    root_deg: Floats
    dof: float = math.inf

    @property
    def u_deg(self) -> Floats:
        """Standard uncertainty (m,) of the error at each angle."""
        return np.asarray(np.sqrt((self.root_deg**2).sum(axis=1)))

    @property
    def U_deg(self) -> Floats:  # noqa: N802 (GUM)
        """Expanded uncertainty (m,) of the error at each angle, for 95 %."""
        return coverage_factor(self.dof) * self.u_deg

    @cached_property
    def _independent(self) -> Floats:
        """Change (m, q) of the error at m angles by one standard deviation of each of q independent causes.

        Causes with an effect on the error below the rounding error are left out.
        """
        left, size, _ = np.linalg.svd(self.root_deg, full_matrices=False)
        kept = size > _NOTHING * size.max(initial=0.0)
        return np.asarray(left[:, kept] * size[kept])

    def exceeds(self, tolerance_deg: float) -> float:
        """Return the probability that the largest |error| of the turn is above a tolerance."""
        from scipy.special import chdtr, fdtr

        causes = self._independent.shape[1]
        outside = np.abs(self.error_deg) > tolerance_deg
        exact = ~self._independent.any(axis=1)
        if (outside & exact).any() or not causes:
            return float((outside & exact).any())
        # Change of the error (n, m) along random directions of z. The opposite ones only change the sign.
        z = np.random.default_rng(0).normal(size=(2048, causes))
        rays = (z / np.linalg.norm(z, axis=1, keepdims=True)) @ self._independent.T
        # Positions along each line of z between which the error at each angle is within the tolerance.
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = 1 / rays
            middle, half = -self.error_deg * slope, tolerance_deg * np.abs(slope)
            low, high = (middle - half)[:, ~exact].max(axis=1), (middle + half)[:, ~exact].min(axis=1)

        def nearer(distance: Floats) -> Floats:
            square = np.clip(distance, 0.0, 1e150) ** 2
            if math.isinf(self.dof):
                return np.asarray(chdtr(causes, square))
            return np.asarray(fdtr(causes, self.dof, square / causes))

        # Both directions of each line.
        within = nearer(high) - nearer(low) + nearer(-low) - nearer(-high)
        return float(1 - 0.5 * np.where(high > low, within, 0.0).mean())

    def bound_deg(self, risk: float) -> float:
        """Return the tolerance that the largest |error| of the turn exceeds with probability `risk`."""
        from scipy.optimize import brentq

        most = float((np.abs(self.error_deg) + self.U_deg).max())
        if most == 0 or not self.root_deg.any():
            return most
        high = most
        while self.exceeds(high) > risk:
            high *= 2
        return float(brentq(lambda t: self.exceeds(t) - risk, 0.0, high, xtol=1e-6 * most))


class Tolerance(JsonRecord):
    """Tolerance of the angle error, with the decision rule that was agreed.

    Attributes
    ----------
    limit_deg : float
        Largest permissible |error| of the angle.
    rule : {"guarded", "simple", "shared"}
        Decision rule (see the module's table).
    risk : float
        Largest risk of a false accept, and of a false reject, by the rule `guarded`.

    Raises
    ------
    UsageError
        A value out of range, or an unknown rule.
    """

    limit_deg: float = field(metadata=key("tolerance_deg"))
    rule: DecisionRule = "guarded"
    risk: float = GUARDED_RISK

    def __post_init__(self) -> None:
        if not 0 < self.limit_deg < 180:
            raise UsageError(f"tolerance is {self.limit_deg:g}°: take an angle above 0°, such as 0.1deg")
        if self.rule not in RULES:
            raise UsageError(f"rule is '{self.rule}': take {', '.join(RULES)}")
        if not 0 < self.risk <= SIMPLE_RISK:
            raise UsageError(f"risk is {100 * self.risk:g} %: take a percentage above 0 %, up to 50 %")

    def __str__(self) -> str:
        rule = {
            "guarded": f"rule guarded, risk at most {format_percent(self.risk)}",
            "simple": "rule simple",
            "shared": f"rule shared, U at most 1/{LEAST_RATIO:g} of the tolerance",
        }[self.rule]
        return f"±{self.limit_deg:g}° at every angle ({rule})"

    @property
    def accepted_risk(self) -> float:
        """Largest probability of a false accept (specific risk) with which the rule still states a pass."""
        return self.risk if self.rule == "guarded" else SIMPLE_RISK

    def verdict(self, curve: ErrorCurve) -> tuple[Verdict, float]:
        """Return pass, fail or undecided for an error curve, and the risk that a pass would be false."""
        risk = curve.exceeds(self.limit_deg)
        vague = LEAST_RATIO * float(curve.U_deg.max()) > self.limit_deg
        open_ = self.risk < risk < 1 - self.risk
        if {"guarded": open_, "simple": False, "shared": vague}[self.rule]:
            return "undecided", risk
        return "pass" if risk <= self.accepted_risk else "fail", risk

    def decide(self, curve: ErrorCurve) -> Conformity:
        """Return the verdict for an error curve with the figures on which it is based (`Conformity`)."""
        verdict, risk = self.verdict(curve)
        at = int((np.abs(curve.error_deg) + curve.U_deg).argmax())
        largest = float(np.abs(curve.error_deg).max())
        bound = curve.bound_deg(self.accepted_risk)
        return Conformity(verdict, risk, 1 - risk, largest, float(curve.angle_deg[at]), bound)


class Conformity(JsonRecord):
    """Statement whether the error of an angle is within a tolerance, with the risks of this statement.

    Attributes
    ----------
    verdict : {"pass", "fail", "undecided"}
        Statement by the decision rule.
    false_accept, false_reject : float
        Specific risks: the probability that the largest |error| is above the tolerance, and that it is not.
    largest_deg : float
        Largest modulus of the estimated error over the turn.
    at_deg : float
        Angle at which the modulus of the estimated error plus U is largest.
    bound_deg : float
        Smallest tolerance with which the rule would state a pass.
    """

    verdict: Verdict
    false_accept: float
    false_reject: float
    largest_deg: float
    at_deg: float
    bound_deg: float

    @property
    def reason(self) -> str:
        """Text of one line: the risk of a wrong statement, and the smallest tolerance that would pass."""
        least = format_number(float(Context(2, ROUND_CEILING).create_decimal(str(self.bound_deg))), 2)
        accept = f"risk of a false accept {format_percent(self.false_accept)}"
        reject = f"risk of a false reject {format_percent(self.false_reject)}"
        risks = {"pass": accept, "fail": reject}.get(self.verdict, f"{accept}, {reject}")
        return f"{risks}; ±{least}° would just pass"


class Statement(JsonRecord):
    """Conformity of a sensor's angle, without and with its calibration.

    Attributes
    ----------
    tolerance : Tolerance
        Tolerance and decision rule of both statements.
    without_calibration : Conformity or None
        None for a sensor of unknown scale, which shows no angle without its calibration.
    with_calibration : Conformity
        Conformity of readings corrected by the calibration.
    """

    tolerance: Tolerance = field(metadata=INLINE)
    without_calibration: Conformity | None
    with_calibration: Conformity

    @property
    def states(self) -> dict[str, Conformity]:
        """Conformity by the state of the sensor, `with calibration` and `without calibration`.

        The entry `without calibration` is missing if the sensor's scale is unknown.
        """
        known = {"with calibration": self.with_calibration, "without calibration": self.without_calibration}
        return {name: one for name, one in known.items() if one is not None}

    @property
    def lines(self) -> list[str]:
        """Text of the statement: a line with tolerance and rule, and a line for each state of the part."""
        found = [f"{name}: {one.verdict.upper()}, {one.reason}" for name, one in self.states.items()]
        return [f"Conformity with {self.tolerance}", *found]


def state_conformity(tolerance: Tolerance, curves: tuple[ErrorCurve | None, ErrorCurve]) -> Statement:
    """State if the sensor's angle conforms without and with its calibration.

    `curves` are the error curves without calibration (None for a sensor of unknown scale) and with it.
    `tolerance` has the limit and the decision rule.
    """
    before, after = curves
    without = None if before is None else tolerance.decide(before)
    return Statement(tolerance, without, tolerance.decide(after))
