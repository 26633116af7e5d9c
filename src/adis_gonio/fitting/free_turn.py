"""One slow continuous turn without declared angles: angle and calibration from gyro and gravity.

`fit` of such a recording returns a `FitResult`. The checks here state the conditions of the estimate, and a
message says what to do if the turn does not meet them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import DataError, FitError
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import Value, effective_dof, factor_over
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.readings import mg_per_unit
from adis_gonio.fitting.fit_result import Estimate, FitResult
from adis_gonio.fitting.free_turn_estimate import (
    NAMES,
    LeastSquaresProblem,
    Solution,
    TurnRecording,
    Windows,
    solve,
)
from adis_gonio.fitting.method_comparison import MethodComparison, Recommendation, Score
from adis_gonio.fitting.uncertainty import BudgetRow, gradient_of_base
from adis_gonio.model.records import MG_PER_MPS2, Session, Sweeps
from adis_gonio.record.provenance import provenance_of

__all__ = ["METHOD", "FreeTurnResult", "fit_free_turn"]

LEAST_S = 10.0
"""A shorter recording contains no slow turn."""
FASTEST_DPS = 90.0
"""At a higher rate a window covers more than an eighth of a turn, and a lever arm of 0.1 m adds 25 mg."""
LEAST_TURN_DEG = 180.0
"""In less than half a turn a bias and a gain are nearly equivalent."""
WOBBLE_DEG = 0.5
"""Tilt (rms) out of the plane that shortens gravity's part in it by 0.04 mg, the resolution of a
session."""
LEANING_DEG = 10.0
MOST_LOST = 0.2
"""Largest allowed share of the recording without samples."""
REST_DPS = 0.5
"""Mean rate in a window, in °/s, below which the sensor counts as at rest."""

_AGAIN = "turn once more"


def require_recording(series: TurnRecording) -> None:
    """Raise `FitError` if a recording is too short or has too many missing samples."""
    if series.length_s < LEAST_S:
        raise FitError(
            f"the recording has {series.length_s:.1f} s: a free turn takes {LEAST_S:.0f} s or more,"
            " 60 s is good"
        )
    steps = np.diff(series.time_s)
    lost_s = float(steps[steps > 5 * series.period_s].sum())
    if lost_s > MOST_LOST * series.length_s:
        raise FitError(
            f"the recording was interrupted: {lost_s:.1f} of {series.length_s:.1f} s have no samples;"
            f" mend the link and {_AGAIN}"
        )


def require_slow(series: TurnRecording, windows: Windows, range_dps: float | None) -> None:
    """Raise `FitError` if the turn was faster than the model can describe or the gyro can measure."""
    rate = np.degrees(np.abs(windows.mean(series.rate[:, 2])))
    fastest = float(rate.max())
    limit = FASTEST_DPS if range_dps is None else min(FASTEST_DPS, 0.9 * range_dps)
    if fastest > limit:
        raise FitError(
            f"the turn was too fast: {fastest:.0f} °/s at {windows.centre_s[rate.argmax()]:.1f} s, at most"
            f" {limit:.0f} °/s can be modelled; {_AGAIN}, a turn in about a minute (6 °/s)"
        )


def require_axis(series: TurnRecording, windows: Windows) -> None:
    """Raise `FitError` if the gyros show that the chip turned about another axis than Z."""
    rates = windows.mean(series.rate)
    # Without the zero rates; the largest of X and Y against Z.
    rates = rates - np.median(rates, axis=0)
    size = np.sqrt((rates**2).mean(axis=0))
    other = int(np.argmax(size[:2]))
    if size[other] > 0.5 * size[2]:
        raise FitError(
            f"the part turned about its {'XY'[other]} axis too ({math.degrees(size[other]):.1f} °/s rms,"
            f" about Z {math.degrees(size[2]):.1f}): lay Z level along the axis of the turn and {_AGAIN}"
        )


def sweeps_of(psi_rad: Floats) -> Sweeps:
    """Count the full turns of a recording, from its unwrapped angle ψ (m,) in rad at each window.

    The returned `Sweeps` also gives the range of the angle; turning back counts like turning on.
    """
    found = Sweeps()
    for angle_deg in np.degrees(psi_rad - psi_rad[0]).tolist():
        found.see(angle_deg)
    return found


def require_turn(psi_rad: Floats) -> None:
    """Raise `FitError` if the turned angles (m,) in rad cover a range too small to fit."""
    turned = sweeps_of(psi_rad).span_deg
    if turned < LEAST_TURN_DEG:
        raise FitError(
            f"the turn is too short: it went {turned:.0f}°, at least {LEAST_TURN_DEG:.0f}° separate biases"
            f" from gains, and 360° are best; {_AGAIN}, all around"
        )


def require_plane(series: TurnRecording, windows: Windows, psi_rad: Floats, gravity_mg: float) -> list[str]:
    """Check that the turn stayed in one vertical plane; return a warning if there is no Z accelerometer.

    Raises
    ------
    FitError
        The turn left its plane by more than the model allows.
    """
    if series.accel_mg.shape[1] < 3:
        return ["no Z accelerometer: whether the turn stayed in one plane is not known"]
    z = windows.mean(series.accel_mg[:, 2])
    # A skew of Z, and a tilt that turns with the part, are one cycle in Z; a bias is a constant.
    design = np.column_stack([np.ones(len(z)), np.cos(psi_rad), np.sin(psi_rad)])
    found = np.linalg.lstsq(design, z, rcond=None)[0]
    # Robust noise by second differences (six times its variance).
    noise = float(np.median(np.abs(np.diff(z, n=2)))) / 0.6745 / math.sqrt(6)
    left = math.sqrt(max(float(((z - design @ found) ** 2).mean()) - noise**2, 0.0))
    wobble = math.degrees(left / gravity_mg)
    leaning = math.degrees(math.asin(min(abs(float(found[0])) / gravity_mg, 1.0)))
    swing = math.degrees(math.hypot(found[1], found[2]) / gravity_mg)
    if wobble > WOBBLE_DEG or swing > LEANING_DEG or leaning > LEANING_DEG:
        _, worst = max(
            (wobble / WOBBLE_DEG, f"swayed by {wobble:.1f}° rms"),
            (swing / LEANING_DEG, f"tilted by {swing:.1f}° with the turn"),
            (leaning / LEANING_DEG, f"leaned by {leaning:.1f}°"),
        )
        raise FitError(
            f"the turn was not in one vertical plane: the part {worst}; hold it in a bearing or on a stage"
            f" with a level axis and {_AGAIN}"
        )
    return []


def remarks(
    series: TurnRecording, windows: Windows, psi_rad: Floats, u_phi_deg: float, wanted: int = 0
) -> list[str]:
    """Remarks for the user on a valid turn, such as missing rests or samples; often none.

    `wanted` is the number of full turns in the plan.
    """
    notes = []
    sweeps = sweeps_of(psi_rad)
    if not sweeps.full:
        notes.append(
            f"the turn went {sweeps.span_deg:.0f}°, no full turn: u(Δφ) is {u_phi_deg:.2g}°;"
            " all around would determine it better"
        )
    elif sweeps.full < wanted:
        notes.append(
            f"{sweeps.full} of {counted(wanted, 'turn')} seen: u(Δφ) is {u_phi_deg:.2g}°; each angle seen"
            " again, on or back, would make it smaller"
        )
    rate = np.degrees(np.abs(np.diff(psi_rad) / np.diff(windows.centre_s)))
    for where, part in (("start", rate[:4]), ("end", rate[-4:])):
        if len(part) and float(np.median(part)) > REST_DPS:
            notes.append(f"no rest at the {where}: a lever arm is separated less well from a bias")
    if (windows.gap_s > 0).any():
        lost = float(windows.gap_s.sum())
        notes.append(f"{lost:.2g} s of samples are missing: across them the gyro is not used")
    return notes


METHOD = "free-turn"

WHY = "a free turn without declared angles: gravity and gyro together are all that it has"
UNSEEN = (
    "the angle is counted from the start, the angle alpha; a zero of the stage was not declared",
    "scale_x and scale_y hold for the stated gravity and a level axis: a turn separates neither from them",
)
"""Limits of every free turn."""

SOURCES = ("noise of the accelerometers", "noise of the gyro", "drift of the biases", "stated before")
"""Causes of the uncertainty, in the order of `Solution.parts`."""


class FreeTurnResult(FitResult):
    """Calibration and angle from one continuous turn without declared angles.

    Attributes
    ----------
    shares : tuple of ((p, p) float, float)
        Contribution of each cause to the covariance of the parameters, and its degrees of freedom.
    turned_deg, length_s : float
        Total rotation, forward and back, and duration.
    """

    shares: tuple[tuple[Floats, float], ...] = ()
    turned_deg: float = 0.0
    length_s: float = 0.0

    @cached_property
    def comparison(self) -> MethodComparison:
        """Comparison that lists only the method `free-turn`; no other method fits such a recording."""
        own = replace(self, warnings=self.warnings)
        return MethodComparison(
            (own,), {}, {}, {METHOD: Score(None, None, None, None, 0)}, Recommendation(METHOD, WHY)
        )

    @cached_property
    def _shown(self) -> Floats:
        """Derivative (m, p) of the calibrated angle by the p parameters, in degrees.

        The m angles are spread over a full turn.
        """
        at = {one.name: k for k, one in enumerate(self.parameters)}
        k_x, k_y = self["scale_x"].value, self["scale_y"].value
        base = np.array([0.0, k_x, k_y, math.radians(self["delta_phi"].value)])
        natural = gradient_of_base(base, zero=False)
        mg = 1000.0 if self.provenance is None else MG_PER_MPS2 * self.provenance.gravity_mps2
        # From natural units to the units of the result.
        found = np.zeros((len(natural), len(at)))
        for column, (name, factor) in enumerate(
            [("scale_x", 1.0), ("scale_y", 1.0), ("delta_phi", math.pi / 180), ("bias_x", 1 / mg),
             ("bias_y", 1 / mg)], start=1,
        ):  # fmt: skip
            found[:, at[name]] = natural[:, column] * factor
        return found

    @cached_property
    def shown_angle(self) -> Value:
        """Uncertainty (rms over a turn) of the angle from gravity to X after calibration; its value is NaN.

        It comes from the parameters of the calibration and excludes the noise of a single reading.
        """
        each = self._variances(self._shown)
        variances = np.sum([part for part, _ in each], axis=0)
        dof = effective_dof([(float(part.mean()), dof) for part, dof in each])
        return Value(math.nan, math.sqrt(float(variances.mean())), "deg", dof, factor_over(variances, dof))

    @property
    def angle(self) -> Value:
        """Like `shown_angle`: without declared angles, the angle from gravity to X is the only angle."""
        return self.shown_angle

    def _variances(self, gradient: Floats) -> list[tuple[Floats, float]]:
        """For each cause of uncertainty, the variance (m,) of m quantities and the degrees of freedom.

        `gradient` (m, p) is the derivative of the quantities by the parameters.
        """
        return [(np.einsum("mp,pq,mq->m", gradient, share, gradient), dof) for share, dof in self.shares]

    @cached_property
    def budget(self) -> dict[str, tuple[BudgetRow, ...]]:
        """Uncertainty budget of `delta_k`, `delta_phi` and `angle`: one row for each cause."""
        names = [one.name for one in self.parameters]
        gradients = {name: np.eye(len(names))[[names.index(name)]] for name in ("delta_k", "delta_phi")}
        gradients["angle"] = self._shown
        return {name: self._rows(gradient) for name, gradient in gradients.items()}

    def _rows(self, gradient: Floats) -> tuple[BudgetRow, ...]:
        parts = [(float(part.mean()), dof) for part, dof in self._variances(gradient)]
        total = sum(part for part, _ in parts)
        return tuple(
            BudgetRow(name, "B" if name == SOURCES[3] else "A", "normal", None, "1", None,
                      math.sqrt(max(part, 0.0)), dof, part / total)
            for name, (part, dof) in zip(SOURCES, parts, strict=True)
        )  # fmt: skip


def fit_free_turn(session: Session) -> FreeTurnResult:
    """Fit the calibration and the angles of one continuous turn.

    Parameters
    ----------
    session : Session
        With a `recording`.

    Raises
    ------
    FitError
        No recording with gyros, or a turn that is too short, too fast, broken or not in one plane; the
        message says what to do.
    SingularError
        The recording does not determine the parameters.
    """
    try:
        return _fitted(session)
    except FitError as error:
        if not session.source:
            raise
        raise type(error)(f"{session.source}: {error}") from error


def _fitted(session: Session) -> FreeTurnResult:
    series = series_of(session)
    require_recording(series)
    windows = Windows(series)
    range_dps = (session.facts.get("configuration") or {}).get("gyro_range_dps")
    require_slow(series, windows, None if range_dps is None else float(range_dps))
    require_axis(series, windows)
    variant = VARIANTS.get(session.sensor)
    floor = 0.0 if variant is None else variant.performance.bias_instability_mg
    problem = LeastSquaresProblem(series, windows, session.gravity_mg, floor)
    require_turn(problem.begin()[-len(windows) :])
    solution = solve(problem)
    require_turn(solution.psi_rad)
    notes = require_plane(series, windows, solution.psi_rad, session.gravity_mg)
    names, values, gradient, units = _outputs(solution, windows)
    covariance = gradient @ solution.covariance @ gradient.T
    shares = tuple((gradient @ share @ gradient.T, dof) for share, dof in solution.parts)
    parameters = tuple(
        Estimate(
            name, value, math.sqrt(float(covariance[k, k])), unit,
            effective_dof([(float(share[k, k]), dof) for share, dof in shares]),
        )
        for k, (name, value, unit) in enumerate(zip(names, values, units, strict=True))
    )  # fmt: skip
    u_phi = next(one.u or 0.0 for one in parameters if one.name == "delta_phi")
    wanted = int(session.facts.get("plan", {}).get("turns", 0))
    notes += remarks(series, windows, solution.psi_rad, u_phi, wanted)
    accel = solution.residual_mg
    return FreeTurnResult(
        METHOD,
        parameters,
        covariance,
        float((accel**2 / solution.variances.accel_mg2[:, None]).sum()),
        int(solution.variances.accel_dof),
        accel,
        (0,),
        warnings=(*session.notes, *notes, *UNSEEN),
        fixture_sigma_deg=None,
        provenance=provenance_of(session),
        overrides=session.facts.get("overrides", {}),
        session_notes=session.notes,
        shares=shares,
        turned_deg=sweeps_of(solution.psi_rad).travelled_deg,
        length_s=series.length_s,
    )


def series_of(session: Session) -> TurnRecording:
    """Return the recording of a session, converted to mg and rad/s.

    Raises
    ------
    FitError
        It has none, or no gyros, or unknown units.
    DataError
        Samples that are not finite.
    """
    whole = session.recording
    if whole is None:
        raise FitError(
            "method free-turn needs one continuous recording: record one by calibrate --plan free-turn, or"
            " give a samples CSV without the column 'position'"
        )
    if whole.gyro is None or session.gyro_unit == "counts" or session.accel_unit == "counts":
        raise FitError("method free-turn needs gyros (gx, gy, gz) and accelerometers in known units")
    rate = whole.gyro if session.gyro_unit == "radps" else np.radians(whole.gyro)
    accel = whole.accel * mg_per_unit(session)
    if not (np.isfinite(accel).all() and np.isfinite(rate).all()):
        raise DataError(f"{session.source or 'session'}: the recording holds NaN or infinity")
    # Root of the second moment of the chip's Bartlett window, if the file states its setting.
    taps = 2 ** int((session.facts.get("configuration") or {}).get("filter_m", 0))
    smear_s = math.sqrt((taps**2 - 1) / 6) * float(np.median(np.diff(whole.time_s)))
    return TurnRecording(whole.time_s - whole.time_s[0], accel, rate, whole.temperature_c, smear_s)


def _outputs(solution: Solution, windows: Windows) -> tuple[list[str], list[float], Floats, list[str]]:
    """Names, values, gradients (p, 12 + m) and units of the p reported parameters.

    The names are those that a planar session has. The gradients are by the 12 common parameters and m
    angles of the solution.
    """
    size = len(solution.covariance)
    common = dict(zip(NAMES, np.eye(size), strict=False))
    value = dict(zip(NAMES, solution.values, strict=True))
    degrees = 180 / math.pi
    k_x, k_y = value["scale_x"], value["scale_y"]
    start = _first_rest(solution.psi_rad, windows)
    alpha = np.zeros(size)
    # The start angle is the mean over the windows at rest.
    alpha[len(NAMES) : len(NAMES) + start] = 1 / start
    at_start = float(np.degrees(solution.psi_rad[:start].mean()))
    gain = value["gyro_gain_z"]
    rows: list[tuple[str, float, Floats, str]] = [
        ("delta_k", k_x / k_y - 1, common["scale_x"] / k_y - common["scale_y"] * k_x / k_y**2, "1"),
        ("delta_phi", value["delta_phi"] * degrees, common["delta_phi"] * degrees, "deg"),
        ("alpha", wrap_degrees(at_start), alpha * degrees, "deg"),
        *((name, value[name], common[name], unit) for name, unit in _PLAIN),
        ("gyro_scale_z", 1 / gain, -common["gyro_gain_z"] / gain**2, "1"),
        *(
            (name, value[name] * degrees / gain, common[name] * degrees / gain, unit)
            for name, unit in _RATES
        ),
    ]
    names, values, gradients, units = zip(*rows, strict=True)
    return list(names), list(values), np.array(gradients), list(units)


_PLAIN = (("scale_x", "1"), ("scale_y", "1"), ("bias_x", "mg"), ("bias_y", "mg"), ("lever_x", "mm"),
          ("lever_y", "mm"), ("gyro_latency", "s"))  # fmt: skip
_RATES = (("gyro_bias_z", "deg/s"), ("g_sensitivity_zx", "deg/s/g"), ("g_sensitivity_zy", "deg/s/g"))


def _first_rest(psi_rad: Floats, windows: Windows) -> int:
    """Number of windows at the beginning of the recording in which the chip is at rest, at least one."""
    rate = np.abs(np.diff(psi_rad) / np.diff(windows.centre_s))
    moving = np.flatnonzero(np.degrees(rate) > REST_DPS)
    return max(int(moving[0]), 1) if moving.size else 1
