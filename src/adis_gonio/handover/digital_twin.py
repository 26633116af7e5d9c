"""The digital twin: a simulated session with the model of a measured one, and their comparison.

Residuals, Allan deviations and spectra of the measured data are compared with those of the twin.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.errors import AdisGonioError, DataError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, GYRO_OUT, VARIANTS
from adis_gonio.device.sensor.settings import filter_weights, sample_period_s, smpl_prd_for
from adis_gonio.fitting.allan.spectral_likelihood import overlapping
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, Unit, readings_of
from adis_gonio.fitting.estimation.spectrum import noise_of_means
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, Parameter
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session
from adis_gonio.page.document import Figure, Role, Section, Series, Table, plot
from adis_gonio.sim.bus import SimBus
from adis_gonio.sim.noise import Flicker, White
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World
from adis_gonio.tracing.trace_calibrations import gyros_as_recorded
from adis_gonio.tracing.trace_result import TraceResult


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
    filter does not change and which determines the readings. An archive states the settings of the chip.
    For a CSV the rate is the nearest one of the chip, and the filter is the one with the variance nearest
    to the variance of the samples. `unit` is the unit of the samples.
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
    stated = session.facts.get("configuration")
    stated = (
        stated if isinstance(stated, dict) and "smpl_prd" in stated else None
    )  # a generic sensor has no settings
    if stated is not None:
        smpl_prd, filter_m = int(stated["smpl_prd"]), int(stated["filter_m"])
    else:
        slowest, fastest = 1 / sample_period_s(0xFF), 1 / sample_period_s(1)
        smpl_prd = smpl_prd_for(min(max(1 / period_s, slowest), fastest))
        filter_m = 0
    # White noise of that density at the sample rate of the chip.
    white = np.sqrt(density / sample_period_s(smpl_prd))
    if stated is None:
        noisy = (variance > 0) & (white > 0)  # a constant axis shows no filter
        target = float(np.mean(np.log(variance[noisy] / white[noisy] ** 2))) if noisy.any() else 0.0
        filter_m = min(range(7), key=lambda m: abs(math.log((filter_weights(m) ** 2).sum()) - target))
    return SamplesNoise(smpl_prd, filter_m, white, np.sqrt(means.flicker))


@dataclass(frozen=True)
class TermEffect(Effect):
    """Effect of the simulation made from a named or unnamed term of a traced model.

    Attributes
    ----------
    term : Term
        Term of the traced model.
    columns : int
        Number of axes of the model; other axes stay unchanged.
    history : tuple or None
        Measured history of the temperature, used instead of the simulated temperature; None without one.
    loads : tuple or None
        Measured history of the readings, used instead of the simulated readings; None without one.
    offset_s : float
        Time of the simulation at which the session begins.
    variance_mg2 : (d, axes) float or None
        Measured variance of each dwell, used instead of the simulated variance; None to use the latter.
    """

    term: Term = field(kw_only=True)
    columns: int = field(kw_only=True)
    history: tuple[Floats, Floats] | None = field(kw_only=True)
    loads: tuple[Floats, Floats] | None = field(kw_only=True)
    offset_s: float = field(kw_only=True)
    variance_mg2: Floats | None = field(kw_only=True, default=None)

    name = "traced"
    cause = "a term that a trace found"
    formula = "as fitted"
    separated_by = ""
    by_axis = False

    @classmethod
    def choices(cls) -> tuple[str, ...]:
        """Return no choices: a user cannot select a form of this effect."""
        return ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the term with their bounds.

        They have no units, since the values are used as the fit gave them.
        """
        return tuple(
            Parameter(f"value_{k}", "", float(low), float(high), 0.0)
            for k, (low, high) in enumerate(self._bounds())
        )

    def _bounds(self) -> Floats:
        bounds = self.term.bounds()
        return np.zeros((0, 2)) if bounds is None else bounds

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Return the angle in rad (n,) by which the term turns the sensor."""
        zeros = np.zeros((len(conditions), self.columns))
        return np.asarray(self.term.added(values, zeros, self._seen(conditions)), np.float64)

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the contribution of the term to the readings, in mg (n, axes)."""
        added = np.zeros_like(ideal)
        known = ideal[:, : self.columns]
        added[:, : self.columns] = self.term.added(values, known, self._seen(conditions))
        return added

    def _seen(self, conditions: Conditions) -> Conditions:
        variance = None
        if self.variance_mg2 is not None and conditions.order is not None:
            row = np.minimum(conditions.order.astype(np.intp), len(self.variance_mg2) - 1)
            variance = self.variance_mg2[row]
        return replace(
            conditions,
            time_s=conditions.time_s - self.offset_s,
            temperature_history=self.history,
            load_history=self.loads,
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
        Variant to simulate; any other sensor is simulated as an ADIS16354.
    seed : int
        Seed of the noise and of random errors.
    offset_s : float
        Time of the simulation at which the session begins.
    gyro : GyroCalibration or None
        Calibration of the gyros for the offset registers of the session; None for gyros with random errors.
    """

    def __init__(
        self,
        fit: Fit,
        noise: SamplesNoise,
        *,
        sensor: str,
        seed: int,
        offset_s: float,
        gyro: GyroCalibration | None = None,
    ) -> None:
        data = self._data = fit.data
        self._offset_s = offset_s
        history = data.conditions.temperature_history
        effects = []
        for term, values in zip(fit.terms, fit.values.terms, strict=True):
            kind = AngleTerm if term.enters_angle else TermEffect
            settings = kind(
                term=term,
                columns=data.axes,
                history=history,
                loads=data.conditions.load_history,
                offset_s=offset_s,
                variance_mg2=data.conditions.variance_mg2,
            )
            effects.append((settings, values))
        part = sensor if sensor in VARIANTS else "adis16354"
        super().__init__(_settings(fit, gyro), part=part, seed=seed, effects=effects)
        # Axes without samples get the mean noise.
        white = np.full(3, float(noise.white_mg.mean()))
        white[: data.axes] = noise.white_mg
        floor = np.zeros(3)
        floor[: data.axes] = noise.floor_mg
        own = np.random.SeedSequence((seed, 1)).spawn(2)
        surroundings = [self.settings.temperature_noise_c] * 3 + [self.settings.supply_noise_v]
        noisy = self.variant.performance.gyro_noise_dps
        self._white = White(
            np.array([*white, noisy, noisy, noisy, *surroundings]), np.random.default_rng(own[0])
        )
        self._flicker = Flicker(
            np.array([*floor, 0.0, 0.0, 0.0]), np.random.default_rng(own[1]), start_s=-10.0
        )
        self._temperature_offset = np.zeros(3)

    def temperature_c(self, time_s: Floats) -> Floats:
        """Return the temperature (n,) in °C that the session measured; 25 °C if it was not recorded."""
        history = self._data.conditions.temperature_history
        if history is None:
            return np.full(len(time_s), 25.0)
        return np.interp(time_s - self._offset_s, *history)

    def supply_v(self, time_s: Floats) -> Floats:
        """Return the supply voltage (n,) in V that the session measured; 5 V if it was not recorded."""
        conditions = self._data.conditions
        if conditions.supply_v is None:
            return np.full(len(time_s), 5.0)
        return np.interp(time_s - self._offset_s, conditions.time_s, conditions.supply_v)


def gyro_settings(gyro: GyroCalibration, accel_bias_mg: Floats) -> dict[str, float]:
    """Return settings of a simulation for the gyro errors of a calibration; unknown errors are nominal.

    The gyros of the simulation respond to ideal readings of acceleration, the gyros of a calibration to the
    part's readings. The zero rates therefore include the effect of the accelerometers' bias (3,).
    """
    moved = gyro.with_force_moved(-accel_bias_mg / 1000)
    known = {one.name: one.value for one in moved.parameters}
    pairs = [i + j for i in AXES for j in AXES]
    settings: dict[str, float] = {}
    for axis in AXES:
        settings |= {
            f"gyro_bias_{axis}_dps": known[f"gyro_bias_{axis}"],
            f"gyro_bias_tempco_{axis}_dps_per_c": known.get(f"gyro_bias_temperature_{axis}", 0.0),
            f"gyro_scale_{axis}": known.get(f"gyro_scale_{axis}", 1.0),
            f"gyro_scale_tempco_{axis}_ppm_per_c": known.get(f"gyro_scale_temperature_{axis}", 0.0),
            f"gyro_supply_{axis}_dps_per_v": known.get(f"gyro_supply_{axis}", 0.0),
        }
    for pair in pairs:
        settings[f"gyro_g_sensitivity_{pair}_dps_per_g"] = known.get(f"g_sensitivity_{pair}", 0.0)
        settings[f"gyro_g2_sensitivity_{pair}_dps_per_g2"] = known.get(f"g2_sensitivity_{pair}", 0.0)
        if pair[0] != pair[1]:
            settings[f"gyro_misalignment_{pair}_deg"] = known.get(f"gyro_misalignment_{pair}", 0.0)
    return settings


def _accel_bias_mg(fit: Fit) -> Floats:
    """Return the biases (3,) of the accelerometers in mg by the traced model."""
    found = np.zeros(3)
    for term, values in zip(fit.terms, fit.values.terms, strict=True):
        if isinstance(term, NamedTerm) and term.constant:
            for one, value in zip(term.effect.parameters, values, strict=True):
                found[AXES.index(one.name[-1])] += value
    return found


def _settings(fit: Fit, gyro: GyroCalibration | None = None) -> WorldSettings:
    data = fit.data
    common = {
        "gravity_mps2": data.gravity_mg * STANDARD_GRAVITY_MPS2 / 1000,
        "fixture_sigma_deg": math.degrees(data.fixture_rad) if math.isfinite(data.fixture_rad) else 0.0,
        "vibration_mg": 0.0,
        "axis_tilt_deg": 0.0,
        "backlash_deg": 0.0,
        "alpha_deg": 0.0,
        "skew_xz_deg": 0.0,
        "skew_yz_deg": 0.0,
        "scale_z": 1.0,
    }
    for axis in "xyz":
        common |= {
            f"bias_{axis}_mg": 0.0,
            f"bias_tempco_{axis}_mg_per_c": 0.0,
            f"scale_tempco_{axis}_ppm_per_c": 0.0,
        }
    own = {
        (f"{p.name}_deg" if p.unit == "deg" else p.name): p.stated(float(value))
        for p, value in zip(data.model.parameters, fit.values.base, strict=True)
    }
    own["delta_k"] = own.pop("scale_x") / own["scale_y"] - 1
    if "skew_xy_deg" in own:
        own["delta_phi_deg"] = own.pop("skew_xy_deg")
    gyros = {} if gyro is None else gyro_settings(gyro, _accel_bias_mg(fit))
    return WorldSettings(**{**common, **own, **gyros})


_OPENING_S = 5.0
"""Time of the simulation in s at which the session begins, after the driver has opened the sensor."""
_BLOCK_SCANS = 4096
"""Number of scans in a block: a simulated sensor takes long for each block, and no time to fill it."""
_REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


@solvable
def simulate_like(session: Session, traced: Fit, *, seed: int = 0) -> Session:
    """Return a simulated session of the traced model, with its gyros if they are calibrated.

    The sensor is read through the driver, frame by frame. If the session leaves too little time for a
    move, the twin is later by the duration of the move.

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
        A dwell is too short to show noise, or the session has one pose only.
    """
    if len(session.dwells) < 2:
        raise DataError("a twin needs a session of several positions")
    data = readings_of(session)
    fit = traced.on(data)
    noise = noise_of(session, data.unit)
    gyro = _gyros_of(session)
    names = _REGISTERS if gyro is None else (*_REGISTERS, *GYRO_OUT)
    world = LikeWorld(fit, noise, sensor=session.sensor, seed=seed, offset_s=_OPENING_S, gyro=gyro)
    bus = SimBus(world=world, stream=True)
    begin_s = float(session.dwells[0].time_s[0])
    period_s = sample_period_s(noise.smpl_prd)
    dwells: list[Dwell] = []
    with Adis16354(bus, world.variant, check=False) as sensor:
        sensor.configure(smpl_prd=noise.smpl_prd, filter_m=noise.filter_m, data_ready=True)
        for k, dwell in enumerate(session.dwells):
            if dwell.angle_deg is not None and data.planar:
                bus.stage.move_to(dwell.angle_deg, dwell.approach)
            else:
                bus.stage.orient(_attitude(fit, k))
            start_s = float(dwell.time_s[0]) - begin_s + _OPENING_S
            settle_s = sensor.configuration().settling_s
            bus.sleep_s(max(start_s - bus.now_s(), settle_s, 0.5))
            length_s = float(dwell.time_s[-1] - dwell.time_s[0])
            count = max(2, round(length_s / period_s) + 1)
            block = sensor.read_scans(count, names, block_scans=_BLOCK_SCANS)
            dwells.append(
                replace(
                    dwell,
                    time_s=block.time_s - _OPENING_S + begin_s,
                    accel=block.numbers()[:, : dwell.accel.shape[1]].astype(np.float64),
                    gyro=None if gyro is None else block.gyro_dps,
                    temperature_c=block.temperature_c if dwell.temperature_c is not None else None,
                    supply_v=block.supply_v if dwell.supply_v is not None else None,
                    first_row=None,
                )
            )
    return replace(
        session,
        dwells=tuple(dwells),
        sensor=world.variant.name,
        accel_unit="lsb",
        gyro_unit="dps",
        title=f"twin of {session.title or session.source}",
        source="",
        notes=(),
        facts={"configuration": {"smpl_prd": noise.smpl_prd, "filter_m": noise.filter_m}},
    )


def _gyros_of(session: Session) -> GyroCalibration | None:
    """Return the calibration of the session's gyros; None if the session does not determine one."""
    try:
        return gyros_as_recorded(session)
    except AdisGonioError:
        return None


def _attitude(fit: Fit, k: int) -> list[float]:
    """Return the direction of gravity (3,) in dwell k of the traced model, as an ideal sensor reads it."""
    if fit.data.planar:
        psi = float(fit.values.base[0] + fit.values.attitude[k])
        return [float(np.cos(psi)), float(np.sin(psi)), 0.0]
    return [float(value) for value in fit.values.attitude[k]]


class TwinComparison(JsonRecord):
    """Comparison of a measured session with its digital twin: residuals, Allan deviation, spectrum.

    Attributes
    ----------
    residual_measured, residual_twin : (r,) float
        Whitened residuals of the readings under one model, in their standard uncertainty.
    p_residual : float
        p-value of the Kolmogorov-Smirnov test that the residuals of both have equal distributions.
    p_variance : float
        p-value of the two-sided F test that χ² per degree of freedom is equal for both.
    tau_s : (t,) float
        Averaging times of the Allan deviations.
    allan_measured_mg, allan_twin_mg : (t, axes) float
        Allan deviations of the samples within the dwells.
    frequency_hz : (f,) float
        Frequencies of the densities.
    density_measured, density_twin : (f, axes) float
        One-sided amplitude densities of the samples within the dwells, in mg/√Hz.
    """

    document_keys = (
        *("agrees", "residual_sd_measured", "residual_sd_twin", "p_residual", "p_variance"),
        *("allan_ratio", "density_ratio"),
    )

    residual_measured: Floats
    residual_twin: Floats
    p_residual: float
    p_variance: float
    tau_s: Floats
    allan_measured_mg: Floats
    allan_twin_mg: Floats
    frequency_hz: Floats
    density_measured: Floats
    density_twin: Floats

    @property
    def agrees(self) -> bool:
        """True if the twin's residuals and noise agree with the measured ones.

        The residuals are tested at a level of 1 %; Allan deviations and densities may differ by a factor of
        1.5.
        """
        return min(self.p_residual, self.p_variance) >= 0.01 and all(
            abs(np.log(ratio)) < np.log(1.5) for ratio in (self.allan_ratio, self.density_ratio)
        )

    @property
    def allan_ratio(self) -> float:
        """Measured Allan deviation divided by the twin's: geometric mean over averaging times and axes."""
        return _ratio(self.allan_measured_mg, self.allan_twin_mg)

    @property
    def density_ratio(self) -> float:
        """Measured noise density divided by the twin's: geometric mean over frequencies and axes."""
        return _ratio(self.density_measured, self.density_twin)

    @property
    def residual_sd_measured(self) -> float:
        """Standard deviation of the measured session's whitened residuals, in standard uncertainties."""
        return float(np.std(self.residual_measured))

    @property
    def residual_sd_twin(self) -> float:
        """Standard deviation of the twin's whitened residuals, in standard uncertainties."""
        return float(np.std(self.residual_twin))


@solvable
def compare(measured: Session, twin: Session, traced: Fit) -> TwinComparison:
    """Fit the traced model to a session and to its twin, and compare their residuals and noise."""
    ours, theirs = readings_of(measured), readings_of(twin)
    fits = [
        Fit.begin(data).with_terms(traced.terms, traced.values.terms).refit() for data in (ours, theirs)
    ]
    residual = [_residual(fitted) for fitted in fits]
    if not all(part.size for part in residual):
        raise DataError(
            "there are no more readings than parameters, so that there is no residual to compare"
        )
    samples = [_samples(session, data) for session, data in ((measured, ours), (twin, theirs))]
    periods = [period_of(session.dwells) for session in (measured, twin)]
    # Both curves at the averaging times and frequencies of the measured one.
    tau_s, allan = _common([_allan(part, period) for part, period in zip(samples, periods, strict=True)])
    frequency_hz, density = _common(
        [_density(part, period) for part, period in zip(samples, periods, strict=True)]
    )
    return TwinComparison(
        residual_measured=residual[0],
        residual_twin=residual[1],
        p_residual=_p_same(*residual),
        p_variance=_p_variance(*fits),
        tau_s=tau_s,
        allan_measured_mg=allan[0],
        allan_twin_mg=allan[1],
        frequency_hz=frequency_hz,
        density_measured=density[0],
        density_twin=density[1],
    )


def _residual(fitted: Fit) -> Floats:
    rows = fitted.residual.ravel()
    # Directions that a free attitude absorbs have no residual.
    return np.asarray(rows[np.abs(rows) > 1e-9], np.float64)


def _p_same(ours: Floats, theirs: Floats) -> float:
    """Return the exact p-value of the two-sided Kolmogorov-Smirnov test that two samples are alike.

    It counts the orders of the joined samples in which the distribution functions stay closer than in the
    data (Kim and Jennrich, in Selected Tables in Mathematical Statistics 1, 1973). `ours` and `theirs` are
    these samples.
    """
    m, n = len(ours), len(theirs)
    joined = np.concatenate([ours, theirs])
    below = [np.searchsorted(np.sort(part), joined, side="right") / len(part) for part in (ours, theirs)]
    seen = (0.5 + np.floor(np.abs(below[0] - below[1]).max() * m * n - 1e-7)) / (m * n)
    of_theirs = np.arange(n + 1) / n
    share = (of_theirs <= seen).astype(np.float64)
    for i in range(1, m + 1):
        inside = np.abs(i / m - of_theirs) <= seen
        # A path reaches (i, j) from (i − 1, j) or from (i, j − 1).
        share = np.where(inside, np.cumsum(np.where(inside, i / (i + n) * share, 0.0)), 0.0)
    return float(min(max(1 - share[-1], 0.0), 1.0))


def _p_variance(ours: Fit, theirs: Fit) -> float:
    from scipy.special import fdtr

    if ours.dof <= 0 or theirs.dof <= 0:
        return 1.0
    ratio = (ours.chi2 / ours.dof) / max(theirs.chi2 / theirs.dof, 1e-300)
    # Two-sided probability of the F distribution.
    below = float(fdtr(ours.dof, theirs.dof, ratio))
    return 2 * min(below, 1 - below)


def _samples(session: Session, data: Readings) -> list[Floats]:
    """Return the samples (n, axes) of each dwell minus their mean, in mg."""
    parts = [data.unit.mg(dwell.accel) for dwell in session.dwells if len(dwell)]
    return [part - part.mean(axis=0) for part in parts]


def _allan(samples: Sequence[Floats], period_s: float) -> tuple[Floats, Floats]:
    """Return averaging times in s, one per octave, and the overlapping Allan deviations of all dwells.

    `samples` (n, axes) are the samples of each dwell. `period_s` is the sample period.
    """
    times, deviation = overlapping(samples)
    return period_s * np.array(times, dtype=float), deviation


def _density(samples: Sequence[Floats], period_s: float) -> tuple[Floats, Floats]:
    """Return frequencies in Hz and amplitude densities by Welch's method, averaged over all dwells.

    The densities are averaged over bands of a third of an octave. `period_s` is the sample period;
    `samples` (n, axes) are the samples of each dwell.
    """
    length = int(min(1024, np.median([len(part) for part in samples])))
    parts = [part for part in samples if len(part) >= length]
    taper = np.hanning(length + 1)[:-1, None]
    frequency = np.fft.rfftfreq(length, period_s)[1:]
    power = np.zeros((len(frequency), parts[0].shape[1]))
    for part in parts:
        # Segments that overlap by half, each without its mean.
        starts = range(0, len(part) - length + 1, length - length // 2)
        cut = np.stack([part[start : start + length] for start in starts])
        lines = np.fft.rfft((cut - cut.mean(axis=1, keepdims=True)) * taper, axis=1)[:, 1:]
        power += (np.abs(lines) ** 2).mean(axis=0) / len(parts)
    power *= 2 * period_s / float((taper**2).sum())
    power[-1] /= 1 if length % 2 else 2  # the highest frequency of an even length occurs once
    # Mean power in bands of a third of an octave.
    edges = frequency[0] * 2.0 ** (np.arange(0, 40) / 3)
    band = np.searchsorted(edges, frequency, side="right")
    kept = np.unique(band)
    return (
        np.array([frequency[band == b].mean() for b in kept]),
        np.sqrt(np.array([power[band == b].mean(axis=0) for b in kept])),
    )


def _common(curves: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, list[Floats]]:
    """Interpolate the second of two curves at the abscissas of the first, over their common range.

    The interpolation is logarithmic in both axes. Returns the abscissas and both curves.
    """
    (place, ours), (other, theirs) = curves
    inside = (place >= other[0] * 0.999) & (place <= other[-1] * 1.001)
    at = np.log(place[inside])
    least = 1e-9 * max(float(theirs.max(initial=0.0)), 1e-99)  # bands without any noise
    logs = [np.interp(at, np.log(other), np.log(np.maximum(column, least))) for column in theirs.T]
    moved = np.stack([np.exp(column) for column in logs], axis=1)
    return place[inside], [ours[inside], moved]


def _ratio(measured: Floats, twin: Floats) -> float:
    both = (measured > 0) & (twin > 0)  # a spectrum of quantization alone has empty bands
    return float(np.exp(np.mean(np.log(measured[both] / twin[both])))) if both.any() else 1.0


_AXES = "xyz"


def twin_section(session: Session, traced: TraceResult, *, seed: int = 0) -> Section | None:
    """Return the report section that compares a session with its digital twin; None without a model.

    `seed` is the seed of the simulated noise. A trace of a single pose has no model.

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
        "They agree: the model and the noise explain the measured data."
        if found.agrees
        else "They differ: neither the model nor the noise of the readings explains all of the session."
    )
    return Section(
        title="The digital twin against the measured data",
        words=(
            "The traced model was the world of a simulated sensor, which was measured in the positions and"
            " at the times of the session. " + verdict,
        ),
        folded=True,
        figures=tuple(_figures(found)),
        tables=(_table(found),),
    )


def _figures(found: TwinComparison) -> list[Figure]:
    allan = found.allan_measured_mg, found.allan_twin_mg
    density = found.density_measured, found.density_twin
    pairs = (
        (found.tau_s, *allan, "averaging time / s", "Allan deviation / mg"),
        (found.frequency_hz, *density, "frequency / Hz", "spectral density / mg/√Hz"),
    )
    figures = []
    for x, ours, theirs, x_label, y_label in pairs:
        for k in range(ours.shape[1]):
            series = [
                Series(x, ours[:, k], "measured", role="before"),
                Series(x, theirs[:, k], "twin", role="after", style="line"),
            ]
            title = f"{y_label.split(' /')[0].capitalize()} of {_AXES[k]}"
            svg = plot(series, x_label, y_label, title=title, x_log=True, y_log=True)
            figures.append(Figure(svg, f"{title}, within the dwells."))
    series = [
        _share_below(found.residual_measured, "measured", "before"),
        _share_below(found.residual_twin, "twin", "after"),
    ]
    title = "Distribution of the residuals"
    svg = plot(series, "residual / its standard uncertainty", "share below", title=title)
    return [*figures, Figure(svg, f"{title} of the readings.")]


def _share_below(values: Floats, label: str, role: Role) -> Series:
    share = (np.arange(len(values)) + 0.5) / len(values)
    return Series(np.sort(values), share, label, role=role, style="steps")


def _table(found: TwinComparison) -> Table:
    rows = (
        ("residuals, standard deviation: measured", f"{found.residual_sd_measured:.2f}"),
        ("residuals, standard deviation: twin", f"{found.residual_sd_twin:.2f}"),
        ("same distribution (Kolmogorov-Smirnov), p", f"{found.p_residual:.3f}"),
        ("same variance (F), p", f"{found.p_variance:.3f}"),
        ("Allan deviation, measured over twin", f"{found.allan_ratio:.2f}"),
        ("spectral density, measured over twin", f"{found.density_ratio:.2f}"),
    )
    return Table(("figure", "value"), rows, numeric=(1,))
