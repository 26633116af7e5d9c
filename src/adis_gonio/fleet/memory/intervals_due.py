"""When to calibrate next, by two methods of ILAC-G24:2022 / OIML D 10:2022 (6.2 and 6.3; 2007: 1 and 2).

*Staircase* (automatic adjustment): each routine calibration shows by how much the one before was off
meanwhile. The interval is made longer where that is within 80 % of the permissible error, shorter where it
is outside. All numbers are choices of this program; the first interval and the factors are the user's, here
with defaults.

*Control chart*: the drift of the parameters, with its uncertainty, is extrapolated from the last
calibration to the day on which error and U together reach the permissible error.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import INLINE, JsonRecord, key
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import coverage_factor
from adis_gonio.fleet.memory.as_found import PARAMETERS, worst_deg
from adis_gonio.fleet.memory.drift import LEAST, YEAR_DAYS
from adis_gonio.fleet.memory.history import History, date_of
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

DEFAULT_LIMIT_DEG = 0.1
"""Permissible error of the angle where none is given: an assumption, nobody's tolerance. Some four LSB of
the ADIS16354 at the horizontal (0.027° each), or a change of a bias by 1.7 mg."""
WITHIN = 0.8
"""Share of the permissible error within which an interval grows."""
ROUTINE = 0.8
"""Share of the interval that must have passed, for a calibration to speak for a longer one."""
SHORTEST_DAYS, LONGEST_DAYS = 30.0, 5 * YEAR_DAYS


@dataclass(frozen=True)
class Rules(JsonRecord):
    """What the user decides.

    Attributes
    ----------
    limit_deg : float
        Permissible error of the angle.
    assumed : bool
        True where nobody gave it.
    first_days : float
        Interval before anything is known of the sensor.
    longer, shorter : float
        Factors of the staircase.
    """

    document_keys = ("limit_deg", "assumed")

    limit_deg: float = DEFAULT_LIMIT_DEG
    assumed: bool = field(default=True, metadata=key("limit_assumed"))
    first_days: float = YEAR_DAYS
    longer: float = 1.5
    shorter: float = 0.5

    def __post_init__(self) -> None:
        if not (self.limit_deg > 0 and self.first_days > 0 and self.longer >= 1 and 0 < self.shorter <= 1):
            raise UsageError(
                "due needs a limit and a first interval above 0, longer ≥ 1 and 0 < shorter ≤ 1"
            )


@dataclass(frozen=True)
class Stair(JsonRecord):
    """One step of the staircase: what a calibration found of the one before.

    Attributes
    ----------
    when : str
        Date.
    elapsed_days, error_deg, interval_days : float
        Since the calibration before; its largest error of an angle by now; the interval from here on.
    response : str
        `longer`, `kept`, `shorter` or `early` (too soon to speak for a longer interval).
    """

    when: str
    elapsed_days: float
    error_deg: float
    interval_days: float
    response: str


@dataclass(frozen=True)
class Rule(JsonRecord):
    """A date by one method, or what is lacking for one."""

    method: str
    date: str | None
    why: str
    assumes: str


@dataclass(frozen=True)
class Due(JsonRecord):
    """When to calibrate next.

    Attributes
    ----------
    date : str or None
        The earlier one of the methods' dates; None where no session has a date.
    by : str
        The method that gave it.
    rules : tuple of Rule
    stairs : tuple of Stair
    """

    serial: str
    date: str | None
    by: str
    limits: Rules = field(metadata=INLINE)
    rules: tuple[Rule, ...]
    stairs: tuple[Stair, ...]


def due_of(history: History, limits: Rules | None = None) -> Due:
    """Next calibration of a sensor."""
    limits = limits or Rules()
    if not len(history.sessions):
        lacking = Rule("staircase", None, "lacks a session with a date and a result", "")
        return Due(history.serial, None, "", limits, (lacking,), ())
    stairs = tuple(staircase_of(history, limits))
    rules = (_staircase(history, limits, stairs), _control_chart(history, limits))
    date, by = min((rule.date, rule.method) for rule in rules if rule.date is not None)
    return Due(history.serial, date, by, limits, rules, stairs)


def step(interval_days: float, elapsed_days: float, error_deg: float, limits: Rules) -> tuple[float, str]:
    """Next interval and the response to one calibration.

    Outside of the limit it is shortened, from what had passed where that is less; within `WITHIN` of it
    lengthened, if the calibration was a routine one (`ROUTINE`); kept between.
    """
    if error_deg > limits.limit_deg:
        return max(min(interval_days, elapsed_days) * limits.shorter, SHORTEST_DAYS), "shorter"
    if elapsed_days < ROUTINE * interval_days:
        return interval_days, "early"
    if error_deg <= WITHIN * limits.limit_deg:
        return min(interval_days * limits.longer, LONGEST_DAYS), "longer"
    return interval_days, "kept"


def staircase_of(history: History, limits: Rules) -> list[Stair]:
    """The steps so far, one a session from the second on."""
    days, sessions = history.days, history.sessions
    interval, stairs = limits.first_days, []
    last = 0
    for n in range(1, len(sessions)):
        difference, _ = _difference(history, last, n)
        if not difference:
            continue
        gravity = sessions[n].gravity_mps2 or STANDARD_GRAVITY_MPS2
        error, _ = worst_deg(difference, {}, 0.0, gravity)
        elapsed = float(days[n] - days[last])
        interval, response = step(interval, elapsed, error, limits)
        stairs.append(Stair(date_of(days[n]), elapsed, error, interval, response))
        last = n
    return stairs


def _difference(history: History, before: int, after: int) -> tuple[dict[str, float], dict[str, float]]:
    """Change of each parameter that both sessions determine, and its u."""
    one, other = history.sessions[before].values, history.sessions[after].values
    names = [name for name in PARAMETERS if name in one and name in other]
    change = {name: other[name].value - one[name].value for name in names}
    u = {name: float(np.hypot(one[name].u or 0.0, other[name].u or 0.0)) for name in names}
    return change, u


def _staircase(history: History, limits: Rules, stairs: tuple[Stair, ...]) -> Rule:
    interval = stairs[-1].interval_days if stairs else limits.first_days
    assumes = (
        f"first interval {limits.first_days:.0f} d, "
        f"×{limits.longer:g} within {100 * WITHIN:.0f} % of the limit, "
        f"×{limits.shorter:g} outside; every session renewed the calibration in use"
    )
    date = date_of(history.days[-1] + interval)
    if not stairs:
        why = f"one session only: the first interval of {interval:.0f} d; a second one shows how it holds"
        return Rule("staircase", date, why, assumes)
    end = stairs[-1]
    said = {
        "longer": f"within {100 * WITHIN:.0f} % of the limit, the interval grew to",
        "kept": f"within the limit but not within {100 * WITHIN:.0f} % of it, the interval stays",
        "shorter": f"outside the limit of {limits.limit_deg:g}°, the interval shrank to",
        "early": "within the limit, but too early to lengthen the interval of",
    }[end.response]
    off = f"after {end.elapsed_days:.0f} d the calibration before was off by up to {end.error_deg:.3g}°"
    why = f"{off}: {said} {interval:.0f} d"
    return Rule("staircase", date, why, assumes)


def _control_chart(history: History, limits: Rules) -> Rule:
    method = "control chart"
    drifts = {n: t.drift for n, t in history.tracks.items() if n in PARAMETERS and t.drift is not None}
    if not drifts:
        there = counted(len(history.sessions), "session")
        why = f"lacks sessions: a drift needs {LEAST} at different times that determine it, here: {there}"
        return Rule(method, None, why, "")
    slope = {name: drift.slope.value / YEAR_DAYS for name, drift in drifts.items()}
    u_slope = {name: (drift.slope.u or 0.0) / YEAR_DAYS for name, drift in drifts.items()}
    own = {
        name: float(np.hypot(history.tracks[name].u[-1], drift.between)) for name, drift in drifts.items()
    }
    gravity = history.sessions[-1].gravity_mps2 or STANDARD_GRAVITY_MPS2
    k = coverage_factor(min(drift.slope.dof for drift in drifts.values()))

    def reached(days: float) -> float:
        change = {name: one * days for name, one in slope.items()}
        u = {name: float(np.hypot(own[name], u_slope[name] * days)) for name in slope}
        return worst_deg(change, u, k, gravity)[1]

    missing = [name for name in PARAMETERS if name not in drifts]
    assumes = (
        "drift goes on as a straight line; errors of sessions are independent; the last one is in use"
        + (f"; {', '.join(missing)} not known to drift" if missing else "")
    )
    last = float(history.days[-1])
    if reached(0.0) >= limits.limit_deg:
        why = (
            f"U of a calibration and of its scatter between sessions is {reached(0.0):.3g}° already, "
            f"no less than the limit of {limits.limit_deg:g}°: calibrate with more dwells, or allow more"
        )
        return Rule(method, date_of(last), why, assumes)
    if reached(LONGEST_DAYS) <= limits.limit_deg:
        years = f"{LONGEST_DAYS / YEAR_DAYS:.0f} years, the longest interval"
        why = f"error and U stay within {limits.limit_deg:g}° for {years}"
        return Rule(method, date_of(last + LONGEST_DAYS), why, assumes)
    from scipy.optimize import brentq

    days = float(brentq(lambda t: reached(t) - limits.limit_deg, 0.0, LONGEST_DAYS))
    told = ", ".join(
        f"{name} {drift.slope.value:+.2g} ± {drift.slope.U:.2g} {drift.slope.unit}"
        for name, drift in drifts.items()
    )
    by = f"{days:.0f} d after the last calibration, by {told}"
    why = f"error and U (k = {k:.2f}) reach {limits.limit_deg:g}° {by}"
    return Rule(method, date_of(last + days), why, assumes)
