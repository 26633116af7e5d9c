"""A simulated world that is like a measured session: its model, its noise, its surroundings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.settings import filter_weights, sample_period_s, smpl_prd_for
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Unit
from adis_gonio.fitting.estimation.spectrum import noise_of_means
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, Parameter
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session
from adis_gonio.sim.noise import Flicker, White
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World


@dataclass(frozen=True)
class SamplesNoise:
    """Noise of single samples, as the chip would have to make it.

    Attributes
    ----------
    smpl_prd, filter_m : int
        Settings of the chip whose output is correlated like the samples.
    white_mg : (axes,) float
        rms before the filter.
    floor_mg : (axes,) float
        Allan deviation of the 1/f noise.
    """

    smpl_prd: int
    filter_m: int
    white_mg: Floats
    floor_mg: Floats


def period_of(dwells: Iterable[Dwell]) -> float:
    """Sample period in s; by the length of dwells, since coarse times may stand still between samples."""
    lengths = [np.ptp(dwell.time_s) / (len(dwell) - 1) for dwell in dwells if len(dwell) > 1]
    period_s = float(np.median(lengths)) if lengths else 0.0
    if not period_s > 0:
        raise DataError("a twin needs times: those of the samples stand still")
    return period_s


def noise_of(session: Session, unit: Unit) -> SamplesNoise:
    """Noise of a session's samples on the axes of its readings, whose unit it has.

    The white noise before the filter has the spectral density that the samples have at zero, which is what
    readings are made of (the filter passes it on unchanged). An archive says how the chip was set. A CSV
    does not: the rate is then the nearest that the chip has, and the filter the one that leaves the samples
    nearest to their variance.
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
    density = np.median(diagonals * counts[:, np.newaxis], axis=0) * period_s
    variance = np.mean([part.var(axis=0, ddof=1) for part in samples], axis=0)
    told = session.facts.get("configuration")
    told = told if isinstance(told, dict) and "smpl_prd" in told else None  # a generic sensor has none
    if told is not None:
        smpl_prd, filter_m = int(told["smpl_prd"]), int(told["filter_m"])
    else:
        slowest, fastest = 1 / sample_period_s(0xFF), 1 / sample_period_s(1)
        smpl_prd = smpl_prd_for(min(max(1 / period_s, slowest), fastest))
        filter_m = 0
    white = np.sqrt(density / sample_period_s(smpl_prd))
    if told is None:
        noisy = (variance > 0) & (white > 0)  # an axis that stands still shows no filter
        wanted = float(np.mean(np.log(variance[noisy] / white[noisy] ** 2))) if noisy.any() else 0.0
        filter_m = min(range(7), key=lambda m: abs(math.log((filter_weights(m) ** 2).sum()) - wanted))
    return SamplesNoise(smpl_prd, filter_m, white, np.sqrt(means.flicker))


@dataclass(frozen=True)
class TermEffect(Effect):
    """A term of a traced model as an effect of the world: named or not, at the values that were fitted.

    Attributes
    ----------
    term : Term
    columns : int
        Axes that the model knows; the others are left alone.
    history : tuple or None
        Measured history of the temperature, which the term sees instead of the world's.
    loads : tuple or None
        The same of what the axes read.
    offset_s : float
        Time of the world at which the session begins.
    variance_mg2 : (d, axes) float or None
        Measured variance of each dwell, which the term sees instead of the world's.
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
        """None: its fields are no choices of a user."""
        return ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Values of the term, without units: they are what the trace fitted."""
        return tuple(
            Parameter(f"value_{k}", "", float(low), float(high), 0.0)
            for k, (low, high) in enumerate(self._bounds())
        )

    def _bounds(self) -> Floats:
        bounds = self.term.bounds()
        return np.zeros((0, 2)) if bounds is None else bounds

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """What the term adds to the angle, (n,) in rad."""
        zeros = np.zeros((len(conditions), self.columns))
        return np.asarray(self.term.added(values, zeros, self._seen(conditions)), np.float64)

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """What the term adds to the readings, (n, axes) in mg."""
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
    """A term that turns the part."""

    enters = Enters.ATTITUDE


class LikeWorld(World):
    """World with the model, the noise and the surroundings of a measured session.

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
        Faults of the gyros, for the offsets with which the session was recorded; None leaves them drawn.
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
            made = kind(
                term=term,
                columns=data.axes,
                history=history,
                loads=data.conditions.load_history,
                offset_s=offset_s,
                variance_mg2=data.conditions.variance_mg2,
            )
            effects.append((made, values))
        part = sensor if sensor in VARIANTS else "adis16354"
        super().__init__(_settings(fit, gyro), part=part, seed=seed, effects=effects)
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
        """Temperature (n,) in °C as it was measured; 25 °C where it was not."""
        history = self._data.conditions.temperature_history
        if history is None:
            return np.full(len(time_s), 25.0)
        return np.interp(time_s - self._offset_s, *history)

    def supply_v(self, time_s: Floats) -> Floats:
        """Supply (n,) in V as it was measured; 5 V where it was not."""
        conditions = self._data.conditions
        if conditions.supply_v is None:
            return np.full(len(time_s), 5.0)
        return np.interp(time_s - self._offset_s, conditions.time_s, conditions.supply_v)


def gyro_settings(gyro: GyroCalibration, accel_bias_mg: Floats) -> dict[str, float]:
    """Settings of a world whose gyros have the faults of a calibration; what it does not know is nominal.

    The world's gyros feel what ideal accelerometers read, those of a calibration what the part's do: the
    accelerometers' bias (3,) goes into the zero rates.
    """
    moved = gyro.with_force_moved(-accel_bias_mg / 1000)
    held = {one.name: one.value for one in moved.parameters}
    pairs = [i + j for i in AXES for j in AXES]
    made: dict[str, float] = {}
    for axis in AXES:
        made |= {
            f"gyro_bias_{axis}_dps": held[f"gyro_bias_{axis}"],
            f"gyro_bias_tempco_{axis}_dps_per_c": held.get(f"gyro_bias_temperature_{axis}", 0.0),
            f"gyro_scale_{axis}": held.get(f"gyro_scale_{axis}", 1.0),
            f"gyro_scale_tempco_{axis}_ppm_per_c": held.get(f"gyro_scale_temperature_{axis}", 0.0),
            f"gyro_supply_{axis}_dps_per_v": held.get(f"gyro_supply_{axis}", 0.0),
        }
    for pair in pairs:
        made[f"gyro_g_sensitivity_{pair}_dps_per_g"] = held.get(f"g_sensitivity_{pair}", 0.0)
        made[f"gyro_g2_sensitivity_{pair}_dps_per_g2"] = held.get(f"g2_sensitivity_{pair}", 0.0)
        if pair[0] != pair[1]:
            made[f"gyro_misalignment_{pair}_deg"] = held.get(f"gyro_misalignment_{pair}", 0.0)
    return made


def _accel_bias_mg(fit: Fit) -> Floats:
    """Biases (3,) that the model has."""
    found = np.zeros(3)
    for term, values in zip(fit.terms, fit.values.terms, strict=True):
        if isinstance(term, NamedTerm) and term.name == "bias":
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
