"""The digital twin: a simulated session with the model of a measured one, and their comparison.

Residuals and Allan deviations are compared between the measured data and the twin.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.errors import DataError
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, VARIANTS
from adis_gonio.device.sensor.settings import filter_weights, sample_period_s, smpl_prd_for
from adis_gonio.fitting.allan.spectral_likelihood import overlapping
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, Unit, flicker_of, readings_of, stated_flicker
from adis_gonio.fitting.estimation.spectrum import noise_of_means
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, Parameter
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session
from adis_gonio.page.document import Figure, Role, Section, Series, Style, Table, plot
from adis_gonio.sim.bus import SimBus
from adis_gonio.sim.noise import Flicker
from adis_gonio.sim.sampling import Inputs
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World
from adis_gonio.tracing.trace_result import TraceResult

_OPENING_S = 5.0
"""Time of the simulation in s at which the session begins, after the driver has opened the sensor."""


@dataclass(frozen=True)
class SamplesNoise:
    """Settings of the simulated chip that imitate the noise of a session's samples.

    Attributes
    ----------
    smpl_prd, filter_m : int
        Settings of sample rate and filter that correlate the chip's samples as much as the measured ones.
    white_mg : (axes,) float
        Standard deviation of the white noise before the filter.
    floor_mg : (axes,) float
        Floor of the Allan deviation by 1/f noise.
    """

    smpl_prd: int
    filter_m: int
    white_mg: Floats
    floor_mg: Floats


def period_of(dwells: Iterable[Dwell]) -> float:
    """Return the sample period in s, from the lengths of the dwells.

    Differences of neighbouring times are not used, since coarse times may repeat.
    """
    lengths = [np.ptp(dwell.time_s) / (len(dwell) - 1) for dwell in dwells if len(dwell) > 1]
    period_s = float(np.median(lengths)) if lengths else 0.0
    if not period_s > 0:
        raise DataError("a twin needs sample times: all times of a dwell are equal")
    return period_s


def noise_of(session: Session, unit: Unit) -> SamplesNoise:
    """Return settings of the simulated chip that imitate the noise of a session's samples.

    The white noise before the filter has the spectral density of the samples at frequency zero, which the
    filter does not change and which determines the readings. An archive states the settings of the chip. A
    CSV does not; then the sample rate of the chip that is nearest to the rate of the samples is used, and
    the filter that gives the white noise a variance nearest to the variance of the samples. The 1/f noise
    is the one that a fit of the session assumes (`flicker_of`). `unit` is the unit of the samples.
    """
    dwells = [dwell for dwell in session.dwells if len(dwell) > 8]
    if not dwells:
        raise DataError(
            "a twin needs dwells of more than eight samples: averaged readings have no noise to copy"
        )
    samples = [unit.mg(dwell.accel) for dwell in dwells]
    means = noise_of_means(samples)
    period_s = period_of(dwells)
    counts = np.array([len(part) for part in samples], np.float64)
    diagonals = np.diagonal(means.covariance, axis1=1, axis2=2)
    # Spectral density at zero: variance of a mean times its duration.
    density = np.median(diagonals * counts[:, np.newaxis], axis=0) * period_s
    variance = np.mean([part.var(axis=0, ddof=1) for part in samples], axis=0)
    stated = session.facts.get("configuration") or {}
    if "smpl_prd" not in stated:  # a generic sensor has no settings, and a CSV does not state them
        stated = {}
    nearest = smpl_prd_for(1 / min(max(period_s, sample_period_s(1)), sample_period_s(0xFF)))
    smpl_prd = int(stated.get("smpl_prd", nearest))
    # White noise of that density at the sample rate of the chip.
    white = np.sqrt(density / sample_period_s(smpl_prd))
    noisy = (variance > 0) & (white > 0)  # a constant axis shows no filter
    target = float(np.mean(np.log(variance[noisy] / white[noisy] ** 2))) if noisy.any() else 0.0
    nearest = min(range(7), key=lambda m: abs(math.log((filter_weights(m) ** 2).sum()) - target))
    floor = np.sqrt(flicker_of(means, stated_flicker(session)))
    return SamplesNoise(smpl_prd, int(stated.get("filter_m", nearest)), white, floor)


@dataclass(frozen=True)
class TermEffect(Effect):
    """Effect of the simulation made from a named or unnamed term of a traced model.

    Attributes
    ----------
    term : Term
        Term of the traced model.
    data : Readings
        Readings of the session, whose measured history of temperature and loads, and variance of each
        dwell, are used instead of the simulated ones.
    """

    term: Term = field(kw_only=True)
    data: Readings = field(kw_only=True)

    name = "traced"
    cause = "a term that a trace found"
    by_axis = False

    @classmethod
    def choices(cls) -> tuple[str, ...]:
        """Return no choices: a user cannot select a form of this effect."""
        return ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of a named term; none of an unnamed term, whose values have no names."""
        return self.term.effect.parameters if isinstance(self.term, NamedTerm) else ()

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Return the angle in rad (n,) by which the term turns the sensor."""
        zeros = np.zeros((len(conditions), self.data.axes))
        return np.asarray(self.term.added(values, zeros, self._session_conditions(conditions)), np.float64)

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the contribution of the term to the readings, in mg (n, axes)."""
        added = self.term.added(values, ideal[:, : self.data.axes], self._session_conditions(conditions))
        return np.pad(added, ((0, 0), (0, ideal.shape[1] - self.data.axes)))

    def _session_conditions(self, conditions: Conditions) -> Conditions:
        """Return simulated conditions with the session's own time, histories and variances."""
        measured, variance = self.data.conditions, None
        if measured.variance_mg2 is not None and conditions.order is not None:
            variance = np.take(measured.variance_mg2, conditions.order.astype(np.intp), axis=0, mode="clip")
        return replace(
            conditions,
            time_s=conditions.time_s - _OPENING_S,
            temperature_history=measured.temperature_history,
            load_history=measured.load_history,
            variance_mg2=variance,
        )


@dataclass(frozen=True)
class AngleTerm(TermEffect):
    """A term of a traced model that changes the angle of the sensor instead of its readings."""

    enters = Enters.ATTITUDE


class LikeWorld(World):
    """Simulation that imitates a measured session: its model, its noise and its conditions.

    Parameters
    ----------
    fit : Fit
        Fit of the traced model to the readings of the session.
    noise : SamplesNoise
        Settings that imitate the noise of the samples.
    sensor : str
        Variant to simulate. Any other sensor is simulated as an ADIS16354 that measures the distance from
        the mean reading of the dwell, magnified so that its steps are finer than the noise.
    seed : int
        Seed of the noise and of random errors.

    Attributes
    ----------
    zero_mg : (3,) float
        Reading that is subtracted before the magnification.
    magnified : float
        Factor on the readings minus `zero_mg`; 1 for a variant.
    """

    def __init__(self, fit: Fit, noise: SamplesNoise, *, sensor: str, seed: int) -> None:
        data = self._data = fit.data
        effects = []
        for term, values in zip(fit.terms, fit.values.terms, strict=True):
            kind = AngleTerm if term.enters_angle else TermEffect
            effects.append((kind(term=term, data=data), values))
        part = VARIANTS.get(sensor, VARIANTS["adis16354"])
        super().__init__(_settings(fit), part=part, seed=seed, effects=effects)
        # Noise like the simulated part's hides its steps; its range is several times 1000 mg.
        error = np.where(np.isfinite(data.angle_rad), fit.declared_misfit.T, fit.misfit.T)
        size = float(max(noise.white_mg.mean() / part.performance.noise_mg, abs(error).max() / 1000, 0.01))
        self.zero_mg, self.magnified = np.zeros(3), 1.0 if sensor in VARIANTS else 1 / size
        # Axes without samples get the mean noise.
        self._white_sd[:3] = noise.white_mg.mean()
        self._white_sd[: data.axes] = noise.white_mg
        floor = np.pad(noise.floor_mg, (0, 6 - data.axes))
        # The fitted biases contain the noise that is slower than twice the session (`flicker_parts`).
        slowest_hz = 0.5 / max(float(np.ptp(data.conditions.time_s)), 1.0)
        self._white, slow = map(np.random.default_rng, np.random.SeedSequence((seed, 1)).spawn(2))
        self._flicker = Flicker(floor, slow, start_s=-10.0, lowest_hz=slowest_hz)
        self._temperature_offset = np.zeros(3)

    def sample(self, time_s: Floats) -> Inputs:
        """Return the physical inputs of the chip at increasing times (n,) in s."""
        inputs = super().sample(time_s)
        return replace(inputs, accel_mg=(inputs.accel_mg - self.zero_mg) * self.magnified)

    def temperature_c(self, time_s: Floats) -> Floats:
        """Return the temperature (n,) in °C that the session measured; 25 °C if it was not recorded."""
        history = self._data.conditions.temperature_history or (np.zeros(1), np.full(1, 25.0))
        return np.interp(time_s - _OPENING_S, *history)

    def supply_v(self, time_s: Floats) -> Floats:
        """Return the supply voltage (n,) in V that the session measured; 5 V if it was not recorded."""
        known = self._data.conditions
        supply = np.full(len(known), 5.0) if known.supply_v is None else known.supply_v
        return np.interp(time_s - _OPENING_S, known.time_s, supply)


_MOVE_DPS = 1e5
"""Speed of a move in °/s: the simulated stage has no part in the time between two dwells."""


def _settings(fit: Fit) -> WorldSettings:
    data = fit.data
    by_axis = ("bias_{}_mg", "bias_tempco_{}_mg_per_c", "scale_tempco_{}_ppm_per_c")
    absent = ("vibration_mg", "axis_tilt_deg", "backlash_deg", "alpha_deg", "skew_xz_deg", "skew_yz_deg")
    common = dict.fromkeys((*absent, *(name.format(axis) for name in by_axis for axis in AXES)), 0.0)
    common |= {
        "gravity_mps2": data.gravity_mg * STANDARD_GRAVITY_MPS2 / 1000,
        "fixture_sigma_deg": math.degrees(data.fixture_rad) if math.isfinite(data.fixture_rad) else 0.0,
        "scale_z": 1.0,
        "move_speed_dps": _MOVE_DPS,
    }
    own = {
        (f"{p.name}_deg" if p.unit == "deg" else p.name): p.stated(float(value))
        for p, value in zip(data.model.parameters, fit.values.base, strict=True)
    }
    own["delta_k"] = own.pop("scale_x") / own["scale_y"] - 1
    if "skew_xy_deg" in own:
        own["delta_phi_deg"] = own.pop("skew_xy_deg")
    return WorldSettings(**{**common, **own})


_BLOCK_SCANS = 4096
"""Number of scans in a block: a simulated sensor takes long for each block, and no time to fill it."""
_REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


@solvable
def simulate_like(session: Session, traced: Fit, *, seed: int = 0) -> Session:
    """Return a session of accelerometers simulated by a traced model.

    The sensor is read through the driver, frame by frame. If the times of the measured session leave too
    little time for the filter to settle, the later dwells of the simulated session are delayed.

    Parameters
    ----------
    session : Session
        The measured session.
    traced : Fit
        Final model of the session's trace; check dwells have the attitude that fits best.
    seed : int
        Seed of noise and fixture errors.

    Raises
    ------
    DataError
        No dwell has more than eight samples, or the session has one pose only.
    """
    if len(session.dwells) < 2:
        raise DataError("a twin needs a session of several positions")
    data = readings_of(session)
    fit = traced.on(data)
    noise = noise_of(session, data.unit)
    world = LikeWorld(fit, noise, sensor=session.sensor, seed=seed)
    bus = SimBus(world=world)
    begin_s = float(session.dwells[0].time_s[0])
    period_s = sample_period_s(noise.smpl_prd)
    generic = session.sensor not in VARIANTS
    dwells: list[Dwell] = []
    with Adis16354(bus, world.variant, check=False) as sensor:
        sensor.configure(smpl_prd=noise.smpl_prd, filter_m=noise.filter_m, data_ready=True)
        for k, dwell in enumerate(session.dwells):
            if dwell.angle_deg is not None and data.planar:
                bus.stage.move_to(dwell.angle_deg, dwell.approach)
            else:
                # Direction of gravity as an ideal sensor reads it.
                psi = fit.values.base[0] + fit.values.attitude[k]
                gravity = [np.cos(psi), np.sin(psi), 0.0] if data.planar else fit.values.attitude[k]
                bus.stage.orient([float(value) for value in gravity])
            world.zero_mg[: data.axes] = data.mean[k] if generic else 0.0
            start_s = float(dwell.time_s[0]) - begin_s + _OPENING_S
            bus.sleep_s(max(start_s - bus.now_s(), sensor.configuration().settling_s))
            count = max(2, round(float(dwell.time_s[-1] - dwell.time_s[0]) / period_s) + 1)
            block = sensor.read_scans(count, _REGISTERS, block_scans=_BLOCK_SCANS)
            accel = block.values()[:, :3] / world.magnified + world.zero_mg if generic else block.numbers()
            dwells.append(
                replace(
                    dwell,
                    time_s=block.time_s - _OPENING_S + begin_s,
                    accel=accel[:, : dwell.accel.shape[1]].astype(np.float64),
                    gyro=None,
                    temperature_c=block.temperature_c if dwell.temperature_c is not None else None,
                    supply_v=block.supply_v if dwell.supply_v is not None else None,
                )
            )
    return replace(
        session,
        dwells=tuple(dwells),
        accel_unit="mg" if generic else "lsb",
        title=f"twin of {session.title or session.source}",
        source="",
        notes=(),
        facts={"configuration": {"smpl_prd": noise.smpl_prd, "filter_m": noise.filter_m}},
    )


@dataclass(frozen=True)
class TwinComparison:
    """Comparison of a measured session with its digital twin, a simulated session.

    A pair has the values of the measured session first, then the values of the twin.

    Attributes
    ----------
    residual : pair of (r,) float
        Residuals of all readings after a fit of the same model, whitened and so in standard uncertainties.
    p_residual : float
        p-value of the Kolmogorov-Smirnov test that the residuals of session and twin have equal
        distributions.
    p_variance : float
        p-value of the two-sided F test that χ² per degree of freedom is equal for session and twin.
    tau_s : (t,) float
        Averaging times of the Allan deviations.
    allan_mg : pair of (t, axes) float
        Allan deviations of the samples within the dwells.
    """

    residual: tuple[Floats, Floats]
    p_residual: float
    p_variance: float
    tau_s: Floats
    allan_mg: tuple[Floats, Floats]

    @property
    def agrees(self) -> bool:
        """True if the twin's residuals and noise agree with the measured ones.

        The residuals are tested at a level of 1 %; Allan deviations may differ by a factor of 1.5.
        """
        alike = abs(math.log(self.allan_ratio)) < math.log(1.5)
        return alike and min(self.p_residual, self.p_variance) >= 0.01

    @property
    def allan_ratio(self) -> float:
        """Measured Allan deviation divided by the twin's: geometric mean over averaging times and axes."""
        measured, twin = self.allan_mg
        both = (measured > 0) & (twin > 0)
        return float(np.exp(np.mean(np.log(measured[both] / twin[both])))) if both.any() else 1.0


@solvable
def compare(measured: Session, twin: Session, traced: Fit) -> TwinComparison:
    """Fit the traced model to a session and to its twin, and compare their residuals and noise."""
    from scipy.special import fdtr

    sessions = (measured, twin)
    data = [readings_of(session) for session in sessions]
    ours, twins = (Fit.begin(one).with_terms(traced.terms, traced.values.terms).refit() for one in data)
    residual = (_residual(ours), _residual(twins))
    if min(ours.dof, twins.dof) <= 0 or not all(part.size for part in residual):
        raise DataError(
            "there are no more readings than parameters, so that there is no residual to compare"
        )
    # Both curves at the averaging times of the measured one that the twin has too.
    # They are from the samples of all dwells together, one averaging time per octave.
    curves = []
    for session, one in zip(sessions, data, strict=True):
        times, deviation = overlapping([one.unit.mg(dwell.accel) for dwell in session.dwells if len(dwell)])
        curves.append((period_of(session.dwells) * np.array(times, dtype=float), deviation))
    (tau_s, allan), (other_s, other) = curves
    inside = (tau_s >= other_s[0] * 0.999) & (tau_s <= other_s[-1] * 1.001)
    least = 1e-9 * max(float(other.max(initial=0.0)), 1e-99)  # averaging times without any noise
    at, known = np.log(tau_s[inside]), np.log(other_s)
    logs = [np.interp(at, known, np.log(np.maximum(one, least))) for one in other.T]
    ratio = (ours.chi2 / ours.dof) / (twins.chi2 / twins.dof)
    below = float(fdtr(ours.dof, twins.dof, ratio))
    return TwinComparison(
        residual,
        _p_same_distribution(*residual),
        2 * min(below, 1 - below),
        tau_s[inside],
        (allan[inside], np.exp(np.stack(logs, axis=1))),
    )


def _residual(fitted: Fit) -> Floats:
    rows = fitted.residual.ravel()
    # Directions that a free attitude absorbs have no residual.
    return np.asarray(rows[np.abs(rows) > 1e-9], np.float64)


def _p_same_distribution(ours: Floats, twins: Floats) -> float:
    """Return the p-value of the two-sided Kolmogorov-Smirnov test that two samples have one distribution.

    The limiting distribution is used, with the correction for small samples by Stephens (1970). Importing
    the function of `scipy.stats` would take half a second of each report.
    """
    from scipy.special import kolmogorov

    joined = np.concatenate([ours, twins])
    below = [np.searchsorted(np.sort(part), joined, side="right") / len(part) for part in (ours, twins)]
    root = math.sqrt(len(ours) * len(twins) / len(joined))
    return float(kolmogorov((root + 0.12 + 0.11 / root) * np.abs(below[0] - below[1]).max()))


def twin_section(session: Session, traced: TraceResult, *, seed: int = 0) -> Section | None:
    """Return the report section that compares a session with its digital twin, a simulated session.

    None if the trace has no model, such as the trace of a single pose. `seed` is the seed of the simulated
    noise.

    Raises
    ------
    DataError
        Dwells of a single averaged sample have no noise to copy.
    """
    if not traced.fits:
        return None
    twin = simulate_like(session, traced.fits[-1], seed=seed)
    found = compare(session, twin, traced.fits[-1])
    verdict = (
        "Both agree: the model and the noise explain the measured data."
        if found.agrees
        else "Both differ: neither the model nor the noise of the readings explains all of the session."
    )
    rows = (
        ("residuals, standard deviation: measured", f"{np.std(found.residual[0]):.2f}"),
        ("residuals, standard deviation: twin", f"{np.std(found.residual[1]):.2f}"),
        ("same distribution (Kolmogorov-Smirnov), p", f"{found.p_residual:.3f}"),
        ("same variance (F), p", f"{found.p_variance:.3f}"),
        ("Allan deviation, measured over twin", f"{found.allan_ratio:.2f}"),
    )
    return Section(
        title="The digital twin against the measured data",
        words=(f"A simulated sensor with the traced model repeats the positions and times. {verdict}",),
        folded=True,
        figures=tuple(_figures(found)),
        tables=(Table(("figure", "value"), rows, numeric=(1,)),),
    )


def _figures(found: TwinComparison) -> list[Figure]:
    roles: list[tuple[str, Role, Style]] = [("measured", "before", "points"), ("twin", "after", "line")]
    figures = []
    for k in range(found.allan_mg[0].shape[1]):
        series = [
            Series(found.tau_s, allan[:, k], label, role=role, style=style)
            for allan, (label, role, style) in zip(found.allan_mg, roles, strict=True)
        ]
        title = f"Allan deviation of {AXES[k]}"
        labels = ("averaging time / s", "Allan deviation / mg")
        svg = plot(series, *labels, title=title, x_log=True, y_log=True)
        figures.append(Figure(svg, f"{title}, within the dwells."))
    series = [
        Series(np.sort(one), (np.arange(len(one)) + 0.5) / len(one), label, role=role, style="steps")
        for one, (label, role, _) in zip(found.residual, roles, strict=True)
    ]
    title = "Distribution of the residuals"
    svg = plot(series, "residual / its standard uncertainty", "share below", title=title)
    return [*figures, Figure(svg, f"{title} of the readings.")]
