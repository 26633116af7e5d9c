"""Date of the next calibration, by two methods of ILAC-G24:2022 / OIML D 10:2022 (6.2 and 6.3).

*Staircase* (automatic adjustment): each routine calibration shows the error of the previous one. The
interval is lengthened if that error conforms to 80 % of the tolerance (`adis_gonio.base.conformity`), and
shortened if it fails. All numbers are choices of this program; the first interval and the factors are the
user's, with defaults.

*Control chart*: the drift of the parameters, with its uncertainty, is extrapolated from the last
calibration to the last day on which the error conforms to the tolerance. Sessions within the shortest
interval cannot bound a drift that they do not show, and give no date. The scatter of n sessions about
the line has n − 2 degrees of freedom, and the stated u add two: with the uniform shrinkage prior (Daniels,
Can. J. Stat. 27, 1999, 567) for u²/(u² + τ²), the posterior of u² + τ² is an inverse χ² with n degrees of
freedom, cut off below u². τ is the standard deviation between sessions in excess of u.

Error of an angle ψ that an earlier calibration gives, to first order in the differences δ = later − earlier
of the parameters, with g the local gravity:

    e(ψ) = −½ sin 2ψ δΔK + cos²ψ δΔφ + (cos ψ δb_y − sin ψ δb_x) / g

since an angle depends on the ratio of the gains alone (K_x = K_y (1 + ΔK)) and X is the reference of Δφ.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Mapping
from dataclasses import field, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.conformity import ErrorCurve, Tolerance, Verdict
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import INLINE, JsonRecord, key
from adis_gonio.base.numbers import NAMES, counted, format_uncertain
from adis_gonio.fitting.uncertainty import PLACES, gradient_of_base
from adis_gonio.fleet.sensor_history import LEAST, YEAR_DAYS, Drift, History, date_of, own_u
from adis_gonio.fleet.session_record import SessionRecord
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

PARAMETERS = ("delta_k", "delta_phi", "bias_x", "bias_y")
_TURN = np.linspace(0.0, 360.0, PLACES, endpoint=False)


def slopes_deg(gravity_mps2: float = STANDARD_GRAVITY_MPS2) -> Floats:
    """Return the error of the angle per unit of each calibration parameter, (m, 4).

    The errors are in degrees at m angles over a full turn. The parameters are `PARAMETERS`: ΔK (1), Δφ (°),
    biases of X and Y (mg). `gravity_mps2` is the local gravity.
    """
    gravity_mg = 1000.0 * gravity_mps2 / STANDARD_GRAVITY_MPS2
    perfect = gradient_of_base(np.array([0.0, 1.0, 1.0, 0.0]), zero=False)
    return perfect[:, [1, 3, 4, 5]] * [1.0, math.radians(1.0), 1 / gravity_mg, 1 / gravity_mg]


def curve_of(
    difference: Mapping[str, float], u: Mapping[str, float], gravity_mps2: float, dof: float = math.inf
) -> ErrorCurve:
    """Return the error of the angle over a full turn that an earlier calibration gives.

    Parameters
    ----------
    difference, u : mapping of str to float
        Difference of each of `PARAMETERS`, later minus earlier calibration, and its standard uncertainty; 0
        for a missing parameter. Covariances are neglected.
    gravity_mps2 : float
        Local gravity.
    dof : float
        Degrees of freedom of `u`.
    """
    slopes = slopes_deg(gravity_mps2)  # (m, 4)
    by = np.array([difference.get(name, 0.0) for name in PARAMETERS])
    spread = np.array([u.get(name, 0.0) for name in PARAMETERS])
    return ErrorCurve(_TURN, slopes @ by, slopes * spread, dof)


DEFAULT_TOLERANCE = Tolerance(0.1)
"""Tolerance of the error of an angle if none is given; an assumption.

It is about four LSB of the ADIS16354 at the horizontal (0.027° each), or a change of a bias by 1.7 mg.
"""
WITHIN = 0.8
"""Share of the tolerance to which an error has to conform for the calibration interval to grow."""
ROUTINE = 0.8
"""Share of the calibration interval that must have passed before a calibration can lengthen it."""
LONGER, SHORTER = 1.5, 0.5
"""Factors of the calibration interval after a calibration that was still good, or failed."""
SHORTEST_DAYS, LONGEST_DAYS = 30.0, 5 * YEAR_DAYS


class Rules(JsonRecord):
    """Limits of the rules for the calibration interval, as the user chose them.

    Attributes
    ----------
    tolerance : Tolerance
        Permissible error of the angle, with the decision rule.
    assumed : bool
        True if the tolerance is the default.
    first_days : float
        Calibration interval in days after the first calibration.
    """

    document_keys = ("tolerance", "assumed")

    tolerance: Tolerance = field(default=DEFAULT_TOLERANCE, metadata=INLINE)
    assumed: bool = field(default=True, metadata=key("tolerance_assumed"))
    first_days: float = YEAR_DAYS

    def __post_init__(self) -> None:
        if not self.first_days > 0:
            raise UsageError(f"the first interval is {self.first_days:g} d: take a number above 0")


class Stair(JsonRecord):
    """One change of the calibration interval by the staircase rule.

    A calibration shows the error that angles by the previous calibration had.

    Attributes
    ----------
    when : str
        Date of the calibration.
    elapsed_days, error_deg, interval_days : float
        Time since the previous calibration, largest error of an angle by the previous calibration, and the
        next interval.
    response : str
        `longer`, `kept`, `shorter` or `early` (too early to lengthen the interval).
    verdict : {"pass", "fail", "undecided"}
        Conformity of that error with the tolerance.
    """

    when: str
    elapsed_days: float
    error_deg: float
    interval_days: float
    response: str
    verdict: Verdict


class Rule(JsonRecord):
    """Date of the next calibration by one method, or the reason why the method gives no date.

    `method` is the name of the method, `why` the reason for the date or for its absence (then `date` is
    None), `assumes` a text with the assumptions, empty for none.
    """

    method: str
    date: str | None
    why: str
    assumes: str


class Due(JsonRecord):
    """Date of the next calibration of a sensor, with the dates by each method.

    Attributes
    ----------
    date : str or None
        Earliest date of the methods; None if no session has a date.
    by : str
        Name of the method that gives this date; empty without a date.
    limits : Rules
        Tolerance and first interval that were used.
    rules : tuple of Rule
        Date by each method.
    stairs : tuple of Stair
        Changes of the calibration interval so far, in order of time.
    """

    serial: str
    date: str | None
    by: str
    limits: Rules = field(metadata=INLINE)
    rules: tuple[Rule, ...]
    stairs: tuple[Stair, ...]


def due_of(history: History, limits: Rules | None = None) -> Due:
    """Determine the date of the next calibration of a sensor from its history.

    `limits` are the tolerance and the first interval; None takes the defaults.
    """
    limits = limits or Rules()
    if not len(history.sessions):
        lacking = Rule("staircase", None, "no session has both a date and a result", "")
        return Due(history.serial, None, "", limits, (lacking,), ())
    stairs = tuple(staircase_of(history, limits))
    rules = (_staircase(history, limits, stairs), _control_chart(history, limits))
    date, by = min((rule.date, rule.method) for rule in rules if rule.date is not None)
    return Due(history.serial, date, by, limits, rules, stairs)


def step(
    interval_days: float, elapsed_days: float, error: ErrorCurve, limits: Rules
) -> tuple[float, str, Verdict]:
    """Return the next calibration interval in days, the response and the verdict after one calibration.

    `interval_days` is the present interval, `elapsed_days` the time since the previous calibration, `error`
    the error of the angle by the previous calibration. An error that does not conform to the tolerance
    shortens the interval (or the elapsed time if that is shorter). An error that conforms to the share
    `WITHIN` of the tolerance lengthens the interval, if the share `ROUTINE` of the interval has passed.
    Otherwise the interval is kept. `Stair` explains response and verdict. `limits` has the
    tolerance.
    """
    verdict, _ = limits.tolerance.verdict(error)
    if verdict == "fail":
        return max(min(interval_days, elapsed_days) * SHORTER, SHORTEST_DAYS), "shorter", verdict
    if elapsed_days < ROUTINE * interval_days:
        return interval_days, "early", verdict
    closer = replace(limits.tolerance, limit_deg=WITHIN * limits.tolerance.limit_deg)
    if closer.verdict(error)[0] == "pass":
        return min(interval_days * LONGER, LONGEST_DAYS), "longer", verdict
    return interval_days, "kept", verdict


def _factor(record: SessionRecord, name: str) -> float:
    """Return the factor from the unit of a change of a parameter to the unit of `slopes_deg`.

    It is 1 except for a bias in counts, which the gain of the session converts to mg.
    """
    if record.values[name].unit != "counts":
        return 1.0
    gain = record.values[name.replace("bias", "scale")].value  # counts/(m/s²)
    return 1000.0 / (gain * STANDARD_GRAVITY_MPS2)


def staircase_of(history: History, limits: Rules) -> list[Stair]:
    """List the changes of the calibration interval so far, one for each session from the second on.

    A session that shares no parameter with the last used session gives none. A parameter is shared if both
    sessions have it in one unit. `limits` has the tolerance and the first interval.
    """
    days, sessions = history.days, history.sessions
    interval, stairs = limits.first_days, []
    last = 0
    for n in range(1, len(sessions)):
        pair = [sessions[last], sessions[n]]
        one, other = (record.values for record in pair)
        # Change of each parameter that both sessions determine in one unit, and its standard uncertainty.
        names = [m for m in PARAMETERS if m in one and m in other and one[m].unit == other[m].unit]
        if not names:
            continue
        factor = {name: _factor(pair[0], name) for name in names}
        difference = {name: factor[name] * (other[name].value - one[name].value) for name in names}
        u = {name: factor[name] * float(np.linalg.norm(own_u(pair, name))) for name in names}
        gravity = sessions[n].gravity_mps2 or STANDARD_GRAVITY_MPS2
        error = curve_of(difference, u, gravity)
        elapsed = float(days[n] - days[last])
        interval, response, verdict = step(interval, elapsed, error, limits)
        largest = float(np.abs(error.error_deg).max())
        stairs.append(Stair(date_of(days[n]), elapsed, largest, interval, response, verdict))
        last = n
    return stairs


def _staircase(history: History, limits: Rules, stairs: tuple[Stair, ...]) -> Rule:
    interval = stairs[-1].interval_days if stairs else limits.first_days
    share = f"{100 * WITHIN:.0f} % of the tolerance"
    assumes = (
        f"first interval {limits.first_days:.0f} d, ×{LONGER:g} if the error conforms to {share}, "
        f"×{SHORTER:g} if it fails; every session replaced the calibration in use"
    )
    date = date_of(history.days[-1] + interval)
    if not stairs:
        why = f"only one session: the first interval of {interval:.0f} d; a second session will test it"
        return Rule("staircase", date, why, assumes)
    end = stairs[-1]
    response = {
        "longer": f"conforms to {share}, the interval grew to",
        "kept": f"{end.verdict}, but no pass with {share}: the interval stays",
        "shorter": f"fails the tolerance of {limits.tolerance.limit_deg:g}°, the interval shrank to",
        "early": f"{end.verdict}, but too early to lengthen the interval of",
    }[end.response]
    off = f"after {end.elapsed_days:.0f} d the previous calibration was off by up to {end.error_deg:.3g}°"
    return Rule("staircase", date, f"{off}: {response} {interval:.0f} d", assumes)


def drifted_curve(history: History, drifts: Mapping[str, Drift], days: float) -> ErrorCurve:
    """Return the error of the angle some days after the last session of a history.

    `drifts` are the straight lines of the parameters by name, from the tracks of the history.
    """
    change, u = {}, {}
    for name, drift in drifts.items():
        track, u_slope = history.tracks[name], (drift.slope.u or 0.0) / YEAR_DAYS
        own = float(np.hypot(track.u[-1], drift.between))
        factor = _factor(history.sessions[track.sessions[-1]], name)
        change[name] = factor * drift.slope.value / YEAR_DAYS * days
        # The error of the last session is part of the error of the slope too: covariance of both.
        since = float(track.day[-1]) - drift.reference_day
        u[name] = factor * math.sqrt(own**2 + u_slope**2 * (days**2 + 2 * days * since))
    gravity = history.sessions[-1].gravity_mps2 or STANDARD_GRAVITY_MPS2
    return curve_of(change, u, gravity, 2 + min(drift.slope.dof for drift in drifts.values()))


def _control_chart(history: History, limits: Rules) -> Rule:
    """Return the last day on which the error by drift conforms to the tolerance, with the reason.

    The day is None if no parameter has a known drift. It is the day of the last session if the error does
    not conform even then.
    """
    method = "control chart"
    drifts = {n: t.drift for n, t in history.tracks.items() if n in PARAMETERS and t.drift is not None}
    there = counted(len(history.sessions), "session")
    if not drifts:
        why = f"a drift needs {LEAST} sessions at different times that determine it, here: {there}"
        return Rule(method, None, why, "")
    limit = f"{limits.tolerance.limit_deg:g}°"

    def passes(days: int) -> bool:
        return limits.tolerance.verdict(drifted_curve(history, drifts, days))[0] == "pass"

    missing = [name for name in PARAMETERS if name not in drifts]
    assumes = (
        "drift continues as a straight line; errors of sessions are independent; the last session is in use"
        + (f"; {', '.join(missing)} not known to drift" if missing else "")
    )
    last = float(history.days[-1])
    if not passes(0):
        bound = drifted_curve(history, drifts, 0).bound_deg(limits.tolerance.accepted_risk)
        why = (
            f"a calibration with its scatter between {there} needs a tolerance of "
            f"{bound:.4g}° already, not {limit}: add sessions, calibrate with more dwells, or raise the "
            "tolerance"
        )
        return Rule(method, date_of(last), why, assumes)
    span = float(np.ptp(history.days))
    if span < SHORTEST_DAYS and not any(history.tracks[name].drifts for name in drifts):
        why = f"{there} within {span:.0f} d show no drift, but do not bound it: repeat one later"
        return Rule(method, None, why, "")
    # The error grows with time: the last day with a pass, by bisection.
    days = range(1, round(LONGEST_DAYS) + 1)
    good = bisect(days, False, key=lambda day: not passes(day))
    if good == len(days):
        why = f"the error conforms to {limit} for {LONGEST_DAYS / YEAR_DAYS:g} years, the longest interval"
        return Rule(method, date_of(last + LONGEST_DAYS), why, assumes)
    drifts_text = ", ".join(
        f"{NAMES.get(m, m)} {format_uncertain(one.slope.value, one.slope.U, one.slope.unit, sign=True)}"
        for m, one in drifts.items()
    )
    why = f"the error conforms to {limit} until {good} d after the last calibration, by {drifts_text}"
    return Rule(method, date_of(last + good), why, assumes)
