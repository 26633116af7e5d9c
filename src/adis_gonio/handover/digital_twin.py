"""The digital twin: a simulated world with the model of a session, measured like the session."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats, solvable
from adis_gonio.base.errors import AdisGonioError, DataError
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, GYRO_OUT
from adis_gonio.device.sensor.settings import filter_weights, sample_period_s, smpl_prd_for
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Unit, readings_of
from adis_gonio.fitting.estimation.spectrum import noise_of_means
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, Parameter
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session
from adis_gonio.sim.bus import SimBus
from adis_gonio.sim.noise import Flicker, White
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World
from adis_gonio.tracing.trace_calibrations import gyros_as_recorded


@dataclass(frozen=True)
class SamplesNoise:
    """Noise of single samples, as settings of the simulated chip that imitate it.

    Attributes
    ----------
    smpl_prd, filter_m : int
        Settings of rate and filter with which the chip's samples are correlated like the measured ones.
    white_mg : (axes,) float
        White noise before the filter, rms.
    floor_mg : (axes,) float
        Allan deviation of the 1/f noise.
    """

    smpl_prd: int
    filter_m: int
    white_mg: Floats
    floor_mg: Floats


def period_of(dwells: Iterable[Dwell]) -> float:
    """Sample period in s, by the lengths of the dwells.

    Differences of neighbouring times are not used, since coarse times may repeat.
    """
    lengths = [np.ptp(dwell.time_s) / (len(dwell) - 1) for dwell in dwells if len(dwell) > 1]
    period_s = float(np.median(lengths)) if lengths else 0.0
    if not period_s > 0:
        raise DataError("a twin needs sample times: all times of a dwell are equal")
    return period_s


def noise_of(session: Session, unit: Unit) -> SamplesNoise:
    """Determine the noise of a session's samples, as settings of the simulated chip.

    The white noise before the filter has the spectral density of the samples at frequency zero, which the
    filter does not change and which determines the readings. An archive states the settings of the chip.
    For a CSV the rate is the nearest one of the chip, and the filter is the one with the variance nearest
    to the variance of the samples.
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
    """A named or unnamed term of a traced model as an effect of the simulation, with its fitted values.

    Attributes
    ----------
    term : Term
    columns : int
        Number of axes of the model; other axes stay unchanged.
    history : tuple or None
        Measured history of the temperature, used instead of the world's temperature.
    loads : tuple or None
        Measured history of the readings, used instead of the world's readings.
    offset_s : float
        Time of the world at which the session begins.
    variance_mg2 : (d, axes) float or None
        Measured variance of each dwell, used instead of the world's variance.
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
        """Return no choices: a user cannot select variants of this effect."""
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
        """Angle in rad (n,) by which the term turns the sensor."""
        zeros = np.zeros((len(conditions), self.columns))
        return np.asarray(self.term.added(values, zeros, self._seen(conditions)), np.float64)

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Readings in mg (n, axes) that the term adds."""
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
    """A simulated world that imitates a measured session: its model, its noise and its conditions.

    Parameters
    ----------
    fit : Fit
        The traced model on the readings of the session.
    noise : SamplesNoise
    sensor : str
        Variant to simulate; another sensor is simulated as an ADIS16354.
    seed : int
    offset_s : float
        Time of the world at which the session begins.
    gyro : GyroCalibration or None
        Errors of the gyros with the offsets of the session; None for random errors.
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
        """Temperature (n,) in °C as the session measured it; 25 °C if it was not measured."""
        history = self._data.conditions.temperature_history
        if history is None:
            return np.full(len(time_s), 25.0)
        return np.interp(time_s - self._offset_s, *history)

    def supply_v(self, time_s: Floats) -> Floats:
        """Supply voltage (n,) in V as the session measured it; 5 V if it was not measured."""
        conditions = self._data.conditions
        if conditions.supply_v is None:
            return np.full(len(time_s), 5.0)
        return np.interp(time_s - self._offset_s, conditions.time_s, conditions.supply_v)


def gyro_settings(gyro: GyroCalibration, accel_bias_mg: Floats) -> dict[str, float]:
    """Settings of a simulated world for the gyro errors of a calibration; unknown ones are nominal.

    The gyros of the world respond to ideal readings of acceleration, the gyros of a calibration to the
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
    """Biases (3,) of the accelerometers in mg, by the traced model."""
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
"""Time of the world at which the session begins, after the driver has opened the sensor."""
_BLOCK_SCANS = 4096
"""Scans in a block: a simulated sensor takes long for each block, and none to fill it."""
_REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


@solvable
def simulate_like(session: Session, traced: Fit, *, seed: int = 0) -> Session:
    """Simulate a session whose world is a traced model, with its gyros if they are calibrated.

    The sensor is read through the driver, frame by frame. If the session has no time for a move, the twin
    is later by the duration of the move.

    Parameters
    ----------
    session : Session
        The measured session.
    traced : Fit
        Final model of its trace; check dwells have the attitude that fits best.
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
    """Calibration of the session's gyros; None if the session does not determine one."""
    try:
        return gyros_as_recorded(session)
    except AdisGonioError:
        return None


def _attitude(fit: Fit, k: int) -> list[float]:
    """Direction of gravity (3,) in dwell k of the traced model, as an ideal sensor would read it."""
    if fit.data.planar:
        psi = float(fit.values.base[0] + fit.values.attitude[k])
        return [float(np.cos(psi)), float(np.sin(psi)), 0.0]
    return [float(value) for value in fit.values.attitude[k]]
