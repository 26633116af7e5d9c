"""Prediction of a session on a bench: its uncertainties and the effects that it detects.

The expected readings of a plan are readings of an ideal sensor, with the covariance that would be computed
from a real session. White noise of σ per sample has the spectral density σ² at frequency zero, filtered or
not, because the chip's filter passes zero unchanged: a mean of n samples has the variance σ²/n. Two
variances are added to it: by the converter's step (`quantized_means`), and by 1/f noise, which is partly
common to all dwells (`flicker_parts`).

The expected readings go through `fit` itself, so that a predicted uncertainty equals the uncertainty that
the fit of such a session states. With few positions the result depends on the errors of the stage: with
four positions, for example, a misalignment Δφ changes the gains by Δφ²/2, which matters if the declared
angles are very uncertain. Then the prediction is the median over sessions with random errors of the stage.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.conformity import Conformity, ErrorCurve, Tolerance
from adis_gonio.base.errors import FitError, UsageError, suggest
from adis_gonio.base.jsonable import INLINE, JsonRecord
from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.device.sensor.registers import VARIANTS, Variant, variant
from adis_gonio.device.sensor.settings import filter_settling_samples, filter_weights, sample_period_s
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, flicker_parts, from_means, quantized_means
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.fitting.uncertainty import ShownAngle
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import PlanarTurn
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.plans import Plan
from adis_gonio.record.source import TURN_S, Settings, expected_each_s
from adis_gonio.tracing.findings import detectable
from adis_gonio.tracing.linear_problem import linearise, span
from adis_gonio.tracing.model_search import Search, price
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.proposals import LEAST_SEPARATION, widest_terms

LARGEST_FIXTURE_DEG = 30.0
"""Largest standard uncertainty of a declared angle, in degrees: an angle set by hand and eye without a
stage."""
LARGEST_NOISE_MG = 10_000.0
LARGEST_START_DEG = 3600.0
_STAGES = 16
_LARGEST_CHANGE = 0.05
"""Relative change of any uncertainty by errors of the stage up to which these errors are neglected."""
_DEPENDS = (
    "with so few positions the result depends on the errors of the stage: the figures are medians of "
    f"{_STAGES} imagined sessions"
)


@dataclass(frozen=True)
class Bench:
    """The bench on which a plan will be measured.

    Attributes
    ----------
    fixture_deg : float
        Standard uncertainty of a declared angle of the stage.
    sensor : str
        Name of the sensor's variant, which determines the default noise.
    noise_mg : float or None
        White noise (rms) of a sample without the chip's filter; None for the variant's typical value.
    flicker_mg : float or None
        Smallest Allan deviation of an axis (1/f noise); None for the variant's typical value.
    start_deg : float
        Approximate angle α of the sensor at the stage's zero.
    gravity_mps2 : float
        Local gravity.
    settings : Settings
        Dwell time, settling time, sample rate and filter.

    Raises
    ------
    UsageError
        A value that is impossible for a bench.
    """

    fixture_deg: float
    sensor: str = "adis16354"
    noise_mg: float | None = None
    flicker_mg: float | None = None
    start_deg: float = 0.0
    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sensor", variant(self.sensor).name)
        if not 0 <= self.fixture_deg <= LARGEST_FIXTURE_DEG:
            raise UsageError(f"fixture is {self.fixture_deg:g}°: take 0 to {LARGEST_FIXTURE_DEG:g}°")
        for name in ("noise_mg", "flicker_mg"):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= LARGEST_NOISE_MG:
                raise UsageError(f"{name} is {value:g}: take 0 to {LARGEST_NOISE_MG:g} mg")
        if not -LARGEST_START_DEG <= self.start_deg <= LARGEST_START_DEG:
            raise UsageError(
                f"start is {self.start_deg:g}°: take -{LARGEST_START_DEG:g} to {LARGEST_START_DEG:g}°"
            )
        if not (math.isfinite(self.gravity_mps2) and self.gravity_mps2 > 0):
            raise UsageError(f"gravity is {self.gravity_mps2:g} m/s²: take a value above 0")
        if self.white_mg == 0 and self.floor_mg == 0:
            raise UsageError("noise_mg and flicker_mg are 0: without noise there is nothing to predict")

    @property
    def part(self) -> Variant:
        """Properties of the bench's sensor variant."""
        return VARIANTS[self.sensor]

    @property
    def white_mg(self) -> float:
        """White noise of an unfiltered sample in mg (rms): the given value or the variant's."""
        return self.part.performance.noise_mg if self.noise_mg is None else self.noise_mg

    @property
    def floor_mg(self) -> float:
        """Smallest Allan deviation of an axis in mg: the given value or the variant's."""
        return self.part.performance.bias_instability_mg if self.flicker_mg is None else self.flicker_mg

    @property
    def samples(self) -> int:
        """Number of samples in a dwell."""
        return round(self.settings.dwell_s / sample_period_s(self.settings.smpl_prd))

    @property
    def gravity_mg(self) -> float:
        """Local gravity in mg."""
        return 1000.0 * self.gravity_mps2 / STANDARD_GRAVITY_MPS2

    @property
    def settle_s(self) -> float:
        """Waiting time in s before a dwell, at least the settling time of the filter."""
        period_s = sample_period_s(self.settings.smpl_prd)
        return max(self.settings.settle_s, filter_settling_samples(self.settings.filter_m) * period_s)

    @property
    def each_s(self) -> float:
        """Expected time in s for one position, with turning and settling."""
        return expected_each_s(self.settle_s, self.settings.dwell_s)

    def begins_s(self, plan: Plan) -> Floats:
        """Return the start time of each dwell (n,), in s after the start of the first dwell."""
        waits = np.cumsum([position.wait_s for position in plan.positions])
        return np.asarray(self.each_s * np.arange(len(plan)) + waits - waits[0])

    def seconds(self, plan: Plan) -> float:
        """Return the duration in s of a session with this plan."""
        return self.each_s * len(plan) + sum(position.wait_s for position in plan.positions)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the bench: the sensor's properties in use, and the time model."""
        return {
            "sensor": self.sensor,
            "fixture_deg": self.fixture_deg,
            "noise_mg": self.white_mg,
            "flicker_mg": self.floor_mg,
            "start_deg": self.start_deg,
            "gravity_mps2": self.gravity_mps2,
            "dwell_s": self.settings.dwell_s,
            "settle_s": self.settle_s,
            "turn_s": TURN_S,
            "sample_rate_hz": 1 / sample_period_s(self.settings.smpl_prd),
            "filter_m": self.settings.filter_m,
            "samples": self.samples,
            "settings": asdict(self.settings),
        }


def expected_readings(plan: Plan, bench: Bench, off_deg: Floats | None = None) -> Readings:
    """Return the readings of an ideal sensor at a plan's positions, with their expected covariance.

    The readings have no temperature, supply or vibration, because no plan sets them.

    Parameters
    ----------
    off_deg : (n,) float, optional
        True angle of the stage minus the declared angle of each position; by default 0.

    Raises
    ------
    UsageError
        The plan does not turn in a plane.
    """
    if plan.plane != "xy" or any(position.angle_deg is None for position in plan.positions):
        raise UsageError(f"plan '{plan.name}' has attitudes in space: only turns in a plane are predicted")
    angle = np.radians([position.angle_deg or 0.0 for position in plan.positions])
    n = len(angle)
    # Times of the dwells, from the time model of a session.
    begin = bench.begins_s(plan)
    end = begin + bench.settings.dwell_s
    mean = ideal_mg(angle if off_deg is None else angle + np.radians(off_deg), bench)
    # Variance in mg² of a dwell's mean by white noise, and by the rounding of the converter.
    step = bench.part.accel_mg_per_lsb
    weights = filter_weights(bench.settings.filter_m)
    sample = bench.white_mg**2 * float(weights @ weights) + step**2 / 12
    rounding = float(quantized_means(np.array([[sample]]), np.array([step]))[0, 0])
    # If noise dithers the steps, the rounding of a sample is white, and averaging lowers it too.
    dithered = 0.0 if rounding else step**2 / 12
    white = (bench.white_mg**2 + dithered) / bench.samples
    # 1/f noise of each dwell itself, and the part that dwells share.
    own, slow = flicker_parts(begin, end, np.full(2, bench.floor_mg**2))
    approach = np.array([float(position.approach) for position in plan.positions])
    # Begin and end of each dwell in turn, for the history of the load.
    between = np.column_stack([begin, end]).ravel()
    return from_means(
        mean,
        (white + rounding + own)[:, :, None] * np.eye(2),
        Conditions(
            time_s=(begin + end) / 2 - begin[0],
            angle_rad=angle,
            order=np.arange(n, dtype=float),
            approach=approach if approach.any() else None,
            previous_angle_rad=np.concatenate([angle[:1], angle[:-1]]),
            load_history=(between - begin[0], np.repeat(mean, 2, axis=0)),
        ),
        gravity_mg=bench.gravity_mg,
        fixture_rad=math.radians(bench.fixture_deg),
        check=np.array([position.use == "check" for position in plan.positions]),
        samples=np.full(n, bench.samples, dtype=np.intp),
        slow=slow,
        quantization=np.full((n, 2), rounding),
        flicker=own,
        sensor=bench.sensor,
    )


def ideal_mg(angle_rad: Floats, bench: Bench) -> Floats:
    """Return the readings (n, 2) in mg of X and Y of an ideal sensor at stage angles (n,) in rad."""
    model = PlanarTurn(bench.gravity_mg)
    base = model.nominal
    base[model.index("alpha")] = math.radians(bench.start_deg)
    return model.ideal(base, np.zeros(len(angle_rad)), -angle_rad)


# -- uncertainties ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlanUncertainty:
    """Uncertainties after a session with a plan; every value is NaN, because no part was measured.

    Attributes
    ----------
    method : str
        Name of the method of the fit.
    parameters : dict of str to Value
        Parameters that the plan determines.
    angle, angle_worst : Value
        Angle in degrees that the calibrated goniometer shows for a reading as long as a dwell. The u of
        `angle` is the root mean square over the turn, the u of `angle_worst` is the largest. Both u are
        None if the plan does not determine the angle.
    fitted_deg : float
        Part of u of `angle_worst` from the fitted parameters, which a better plan can lower; NaN if the
        angle is not determined.
    roots_deg : (m, k) float or None
        Change of the calibrated angle at m angles around the turn by one standard uncertainty of each of k
        independent causes; None if the angle is not determined.
    undetermined : tuple of str
        Parameters that the plan cannot determine.
    notes : tuple of str
        Warnings of the fit.
    """

    method: str
    parameters: dict[str, Value]
    angle: Value
    angle_worst: Value
    fitted_deg: float
    undetermined: tuple[str, ...]
    notes: tuple[str, ...]
    roots_deg: Floats | None = field(default=None, compare=False)

    def conformity(self, tolerance: Tolerance) -> Conformity | None:
        """Return the conformity of the calibrated angle with a tolerance after a session with the plan.

        Return None if the plan does not determine the angle.
        """
        if self.roots_deg is None:
            return None
        m = len(self.roots_deg)
        return tolerance.decide(ErrorCurve(np.arange(m) * 360.0 / m, np.zeros(m), self.roots_deg))

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the uncertainties, without the values, which are unknown."""
        return {
            "method": self.method,
            "parameters": {name: _without_value(value) for name, value in self.parameters.items()},
            "angle": _without_value(self.angle),
            "angle_worst": _without_value(self.angle_worst),
            "angle_worst_by_parameters_u_deg": self.fitted_deg,
            "undetermined": list(self.undetermined),
            "notes": list(self.notes),
        }


def _without_value(value: Value) -> dict[str, Any]:
    return {name: entry for name, entry in value.as_dict().items() if name != "value"}


class ConfoundedPair(JsonRecord):
    """Two effects that a session with a plan cannot distinguish; an entry of the JSON list `confounded`.

    Attributes
    ----------
    effects : tuple of str
        Names of the two effects.
    separation : float
        Distance in standard uncertainties between one effect at its detectable amplitude and the best
        imitation of it by the other effect; the smaller distance of both directions.
    """

    effects: tuple[str, str]
    separation: float


class Sight(JsonRecord):
    """Effects that a session with a plan detects and distinguishes.

    Attributes
    ----------
    detectable : dict of str to Detectable
        Amplitude of each effect of the catalogue that 90 of 100 sessions would find, by name of the effect.
    confounded : tuple of ConfoundedPair
        Pairs that the plan cannot distinguish, the worst first.
    """

    detectable: dict[str, Detectable]
    confounded: tuple[ConfoundedPair, ...]


class Prediction(JsonRecord):
    """Prediction for a session with a plan on a bench: uncertainties and detectable effects.

    `reach` has the uncertainties, `sight` the detectable effects.
    """

    document_keys = ("positions", "seconds", "bench", "reach", "sight")

    plan: Plan
    bench: Bench
    reach: PlanUncertainty = field(metadata=INLINE)
    sight: Sight = field(metadata=INLINE)

    @property
    def positions(self) -> int:
        """Number of positions of the plan."""
        return len(self.plan)

    @property
    def seconds(self) -> float:
        """Duration of the session in s."""
        return self.bench.seconds(self.plan)


def predict(plan: Plan, bench: Bench) -> Prediction:
    """Predict the uncertainties and the detectable effects of a session with a plan on a bench.

    Raises
    ------
    UsageError
        The plan does not turn in a plane.
    FitError
        The plan has too few positions, or determines neither ΔK nor Δφ.
    """
    sight = predict_sight(expected_readings(plan, bench).training)
    return Prediction(plan, bench, predict_uncertainty(plan, bench), sight)


def predict_uncertainty(plan: Plan, bench: Bench) -> PlanUncertainty:
    """Predict the uncertainties of a calibration by this plan.

    Raises
    ------
    FitError
        The plan has too few positions, or determines neither ΔK nor Δφ.
    """
    offsets = np.random.default_rng(0).normal(0.0, bench.fixture_deg, (_STAGES, len(plan)))
    exact = _reach(fit_readings(expected_readings(plan, bench).training))
    other = _reach_off(plan, bench, offsets[0])
    if other is not None and exact.undetermined == other.undetermined:
        pairs = [(value.u, other.parameters[name].u) for name, value in exact.parameters.items()]
        if all(a is None or b is None or abs(b - a) <= _LARGEST_CHANGE * a for a, b in pairs):
            return exact
    return _median(exact, [other, *(_reach_off(plan, bench, off_deg) for off_deg in offsets[1:])])


def _reach_off(plan: Plan, bench: Bench, off_deg: Floats) -> PlanUncertainty | None:
    """Predict the uncertainties if the stage's angles are wrong by `off_deg` (n,).

    Return None if the fit to such a session fails.
    """
    try:
        return _reach(fit_readings(expected_readings(plan, bench, off_deg).training))
    except FitError:
        return None


def _median(exact: PlanUncertainty, sessions: Sequence[PlanUncertainty | None]) -> PlanUncertainty:
    """Return the median of each uncertainty over simulated sessions.

    `exact` is the prediction without errors of the stage; None in `sessions` is a session without a fit. A
    parameter that fewer than half of the sessions determine has no uncertainty.
    """

    def median(value: Value, u_of: Callable[[PlanUncertainty], float | None]) -> Value:
        found = [None if session is None else u_of(session) for session in sessions]
        # A session that does not determine the value counts as infinitely uncertain.
        u = float(np.median([math.inf if u is None else u for u in found]))
        return replace(value, u=u if math.isfinite(u) else None)

    def u_by_name(name: str) -> Callable[[PlanUncertainty], float | None]:
        return lambda session: session.parameters[name].u if name in session.parameters else None

    known = dict(exact.parameters)
    for session in sessions:
        known |= session.parameters if session else {}
    parameters = {name: median(value, u_by_name(name)) for name, value in known.items()}
    sure = {name: value for name, value in parameters.items() if value.u is not None}
    fitted = median(exact.angle, lambda one: one.fitted_deg if one.angle.u is not None else None)
    # The shape over the turn of the first session that has one, with the size of the median session.
    shapes = [s.roots_deg / s.fitted_deg for s in (exact, *sessions) if s and s.roots_deg is not None]
    return replace(
        exact,
        parameters=sure,
        angle=median(exact.angle, lambda one: one.angle.u),
        angle_worst=median(exact.angle_worst, lambda one: one.angle_worst.u),
        fitted_deg=math.nan if fitted.u is None else fitted.u,
        undetermined=tuple(name for name in (*parameters, *exact.undetermined) if name not in sure),
        notes=(*exact.notes, _DEPENDS),
        roots_deg=None if fitted.u is None else fitted.u * shapes[0],
    )


def _reach(result: FitResult) -> PlanUncertainty:
    origin, sources, angle = result.origin, result.sources, result.shown_angle
    # The noise is known and the part turns in a plane.
    assert origin is not None
    assert sources is not None
    assert angle is not None
    shown = ShownAngle.around(origin.fit)
    whole = float(np.sqrt(sources.by_place(shown.gradient, shown.reading).max()))
    roots = sources.roots(shown.gradient, shown.reading)
    fitted = math.sqrt(float((roots**2).sum(axis=1).max()))
    sure = angle.u is not None
    return PlanUncertainty(
        result.method,
        {name: replace(one, value=math.nan) for name, one in result.parameters.items()},
        angle,
        Value(math.nan, whole if sure else None, "deg"),
        fitted if sure else math.nan,
        result.undetermined,
        result.warnings,
        roots if sure else None,
    )


# -- effects ------------------------------------------------------------------------------------------


def predict_sight(readings: Readings) -> Sight:
    """Predict which effects a session with such readings detects and distinguishes.

    The detectable amplitude is the one that a trace would find in 90 of 100 sessions, in addition to the
    start angle, gains, Δφ and biases. Two effects are not distinguished if one of them, at its detectable
    amplitude, differs by less than `LEAST_SEPARATION` standard uncertainties from the best imitation by the
    other effect.

    Parameters
    ----------
    readings : Readings
        Expected readings without the check dwells.
    """
    fit = Fit.begin(readings).refit()
    terms, missing = named_terms(readings)
    problem = linearise(fit, terms)
    # The bias on all axes is in each model, because every part has one.
    widest = widest_terms(problem.terms)
    bias = tuple(problem.terms.index(term) for term in widest.values() if term.constant)
    seen = detectable(Search(problem, price(problem)), bias, missing)
    basis = span(problem, bias)[0]
    columns = {}
    for name, term in widest.items():
        if not term.constant and seen[name].amplitude is not None:
            # Whitened columns (rows, d) by the term's amplitudes, without their part in the base model.
            index = problem.terms.index(term)
            own = problem.block(index) @ np.linalg.pinv(problem.back_of(index))
            columns[name] = np.asarray(own - basis @ (basis.T @ own))
    found = []
    for one, other in itertools.combinations(columns, 2):
        separation = min(
            _separation(columns[one], columns[other], seen[one]),
            _separation(columns[other], columns[one], seen[other]),
        )
        if separation < LEAST_SEPARATION:
            # Without rounding errors, which would decide the order of pairs that are confounded equally.
            found.append(ConfoundedPair((one, other), round(separation, 9)))
    return Sight(seen, tuple(sorted(found, key=lambda pair: pair.separation)))


def _separation(columns: Floats, others: Floats, limit: Detectable) -> float:
    """Return the distance between an effect and the best imitation of it by another effect.

    `columns` and `others` are the whitened derivatives of the readings by the two effects. The first effect
    has its detectable amplitude `limit`, the other effect any amplitude. The distance is in standard
    uncertainties; if the first effect has several columns, the smallest distance counts.
    """
    size = np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(others / size, full_matrices=False)
    # Orthonormal basis of the span of the others, without directions that are rounding errors.
    inside = u[:, s > 1e-6]
    outside = np.linalg.norm(columns - inside @ (inside.T @ columns), axis=0)
    return float(outside.min()) * float(limit.amplitude or 0.0)


def planned_terms(readings: Readings, names: Sequence[str]) -> tuple[NamedTerm, ...]:
    """Return terms for the named effects, each on all axes, at the expected readings of a plan.

    Raises
    ------
    UsageError
        An unknown effect, or an effect for which single positions cannot be chosen.
    """
    terms, _ = named_terms(replace(readings, check=np.zeros(len(readings), dtype=bool)))
    offered = widest_terms(terms)
    # The model already has some effects, and one exchanged position changes the history of all later ones.
    known = sorted(
        name
        for name, term in offered.items()
        if not term.effect.in_base
        and not any(need.endswith("_history") or need.startswith("previous") for need in term.effect.needs)
    )
    for name in names:
        if name not in known:
            raise UsageError(f"beware: no plan can be made for '{name}'; {suggest(name, known)}")
    return tuple(offered[name] for name in dict.fromkeys(names))
