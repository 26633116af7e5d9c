"""Three gyros with their errors: readings, true parameters, die temperatures.

The convention is defined in `settings.GyroSettings`. The axis of a gyro is misaligned towards the axes of
the gyros' frame (`gyro_misalignment_…`), and that frame is rotated against the frame of the accelerometers
(`gyro_triad_…`). `GyroTriad.truth` has the sum of both rotations, relative to the accelerometers' frame, in
which a fit finds them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adis_gonio.base.arrays import Floats, rotation_matrices, unit_directions
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import Performance
from adis_gonio.model.effects.base import AXES, lagged
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.sim.noise import RateWalk
from adis_gonio.sim.sampling import Electronics
from adis_gonio.sim.settings import PAIRS, WorldSettings


def apply_matrix(matrix: Floats, vectors: Floats) -> Floats:
    """Multiply a matrix (3, 3) by each of the vectors (n, 3); return (n, 3).

    The sums are written out, because a matrix product may round differently for another number of rows.
    """
    x, y, z = vectors.T
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in matrix], axis=1)


def value_or(given: float | None, other: float) -> float:
    """Return `given`, or `other` if `given` is None."""
    return other if given is None else given


class GyroTriad:
    """The three gyros of a simulated sensor with their errors.

    Parameters
    ----------
    settings : WorldSettings
        Given errors of the gyros.
    figures : Performance
        Figures of the variant, for settings that are None.
    bias_dps : (3,) float
        Biases (zero rates) at 25 °C.
    walk : Generator
        Draws the random walk of the biases.
    """

    def __init__(
        self, settings: WorldSettings, figures: Performance, bias_dps: Floats, walk: np.random.Generator
    ) -> None:
        self._settings = settings
        self._bias = bias_dps
        self._walk = RateWalk(settings.gyro_rate_walk_dps_per_rt_s, walk)
        self.sensitivity = _sensitivity(settings)
        """Gains and directions (3, 3) of the gyros.

        An entry is the reading of one gyro per rate of turn about one axis of the accelerometers' frame.
        """
        own_g = value_or(settings.gyro_g_dps_per_g, figures.gyro_g_sensitivity_dps_per_g)
        supply = value_or(settings.gyro_supply_dps_per_v, figures.gyro_supply_sensitivity_dps_per_v)
        self.per_g = settings.by_axis("gyro_g_sensitivity_pair_dps_per_g", own_g).reshape(3, 3)
        """Linear g-sensitivity (3, 3) in °/s/g.

        The first index is the gyro, the second the axis of the force.
        """
        self._per_v = settings.by_axis("gyro_supply_each_dps_per_v", supply)
        self._per_g2 = settings.by_axis("gyro_g2_sensitivity_pair_dps_per_g2").reshape(3, 3)
        self._tempco = settings.by_axis("gyro_bias_tempco_each_dps_per_c")
        self._scale_tempco = 1e-6 * settings.by_axis("gyro_scale_tempco_each_ppm_per_c")
        self._warm_up = settings.by_axis("gyro_warm_up_each_dps")
        self._asymmetry = settings.by_axis("gyro_asymmetry_each")

    @property
    def electronics(self) -> Electronics:
        """Electronics of a chip with these gyros: range gains, saturation, compensations, autonulls."""
        given = self._settings
        return Electronics(
            range_gain={150: given.gyro_range_gain_150, 75: given.gyro_range_gain_75},
            gyro_saturation=given.gyro_saturation,
            g_compensation=given.gyro_g_compensation * self.per_g,
            origin_compensation=given.origin_compensation,
            autonull_s=given.autonull_s,
            precision_autonull_s=given.precision_autonull_s,
        )

    def read(
        self, rate_dps: Floats, force_mg: Floats, dies_c: Floats, supply_v: Floats, time_s: Floats
    ) -> Floats:
        """Return the gyro readings (n, 3) in °/s at n times, without flicker and white noise.

        Parameters
        ----------
        rate_dps : (n, 3) float
            Rate of turn in the accelerometers' frame.
        force_mg : (n, 3) float
            Readings of ideal accelerometers, from gravity and motion.
        dies_c : (n, 3) or (n, 1) float
            Temperature in °C of each gyro's die, or of all dies.
        supply_v, time_s : (n,) float
            Supply voltage in V, and times in s.
        """
        warm, force_g = dies_c - REFERENCE_C, 1e-3 * force_mg
        gyro = apply_matrix(self.sensitivity, rate_dps)
        gyro += self._asymmetry * np.abs(gyro)
        gyro *= 1 + self._scale_tempco * warm
        gyro += self._bias + self._tempco * warm + self._warming(time_s)[:, None] * self._warm_up
        gyro += (supply_v - REFERENCE_V)[:, None] * self._per_v
        for k, j in np.ndindex(3, 3):
            if self.per_g[k, j] or self._per_g2[k, j]:
                gyro[:, k] += self.per_g[k, j] * force_g[:, j] + self._per_g2[k, j] * force_g[:, j] ** 2
        if self._settings.gyro_rate_walk_dps_per_rt_s:
            gyro += self._walk.at(time_s)
        return gyro

    def _warming(self, time_s: Floats) -> Floats:
        """Return the warm-up offset (n,) at n times in s, divided by the warm-up offset at power-on."""
        on_s = np.maximum(time_s + self._settings.powered_s, 0.0)
        return np.asarray(np.exp(-on_s / self._settings.gyro_warm_up_tau_s))

    # -- true parameters ----------------------------------------------------------------------------

    def truth(self) -> dict[str, float]:
        """Return the true gyro parameters by the names that fits use.

        They apply at 25 °C and 5 V, long after power-on.
        """
        gains = np.linalg.norm(self.sensitivity, axis=1)
        # Sines of the misalignments are the components of the unit directions.
        misalignment_deg = np.degrees(np.arcsin(self.sensitivity / gains[:, None]))
        by_axis = {
            "gyro_scale": np.diagonal(self.sensitivity),
            "gyro_bias": self._bias,
            "gyro_scale_error": gains - 1,
            "gyro_scale_temperature": self._scale_tempco,
            "gyro_bias_temperature": self._tempco,
            "gyro_warm_up": self._warm_up,
            "gyro_asymmetry": self._asymmetry,
            "gyro_supply": self._per_v,
        }
        by_pair = {
            "g_sensitivity": self.per_g,
            "g_sensitivity_left": (1 - self._settings.gyro_g_compensation) * self.per_g,
            "g2_sensitivity": self._per_g2,
            "gyro_misalignment": misalignment_deg,
        }
        result: dict[str, float] = {}
        for places, parameters in ((AXES, by_axis), (PAIRS, by_pair)):
            for name, values in parameters.items():
                keys = (f"{name}_{place}" for place in places)
                result |= dict(zip(keys, values.ravel().tolist(), strict=True))
        for axis in AXES:  # the angle between an axis and itself
            del result[f"gyro_misalignment_{axis}{axis}"]
        return result | {
            "gyro_warm_up_tau": self._settings.gyro_warm_up_tau_s,
            "gyro_range_gain_150": self._settings.gyro_range_gain_150,
            "gyro_range_gain_75": self._settings.gyro_range_gain_75,
        }

    def truth_at(
        self, time_s: Floats, dies_c: Floats, supply_v: Floats, wander_dps: Floats
    ) -> dict[str, float]:
        """Return the true gyro parameters, with scale factors and biases averaged over n times.

        Parameters
        ----------
        time_s : (n,) float
            Times, for warm-up and random walk.
        dies_c : (n, 3) float
            Temperatures of the dies in °C.
        supply_v : (n,) float
            Supply voltage in V.
        wander_dps : (3,) float
            Mean flicker of each gyro at these times in °/s.
        """
        result = self.truth()
        warm = dies_c.mean(axis=0) - REFERENCE_C
        bias = self._bias + wander_dps + self._per_v * (float(np.mean(supply_v)) - REFERENCE_V)
        bias = bias + self._tempco * warm + self._warm_up * float(np.mean(self._warming(time_s)))
        walked = self._walk.past_values(time_s)
        if len(walked):
            bias = bias + walked.mean(axis=0)
        for k, axis in enumerate(AXES):
            warmer = 1 + float(self._scale_tempco[k] * warm[k])
            result[f"gyro_scale_{axis}"] *= warmer
            result[f"gyro_scale_error_{axis}"] = (1 + result[f"gyro_scale_error_{axis}"]) * warmer - 1
            result[f"gyro_bias_{axis}"] = float(bias[k])
        return result


def _sensitivity(settings: WorldSettings) -> Floats:
    gains = settings.by_axis("gyro_scale_each")
    misalignment = np.zeros((3, 3))
    misalignment[~np.eye(3, dtype=np.bool_)] = settings.by_axis("gyro_misalignment_other_deg")
    misalignment = np.sin(np.radians(misalignment))
    squares = (misalignment**2).sum(axis=1)
    if squares.max() >= 1:
        raise UsageError(f"gyro_misalignment_{AXES[int(squares.argmax())]}…: no axis is misaligned so much")
    sensitivity = gains[:, None] * unit_directions(misalignment)
    turned = np.radians(settings.by_axis("gyro_triad_each_deg"))
    return np.asarray(sensitivity @ rotation_matrices(turned).T if turned.any() else sensitivity)


_STEP_S = 1.0
_FORGOTTEN = 12.0
"""Number of time constants after which the initial temperature of a die has no more influence."""


class Dies:
    """Temperatures of the three gyro dies: each lags the sensor's temperature and differs from it.

    Parameters
    ----------
    settings : WorldSettings
        Settings of the world; names that begin with `die_`, and `powered_s`, are used.
    """

    def __init__(self, settings: WorldSettings) -> None:
        self._powered_s = settings.powered_s
        self._gradient_c = settings.by_axis("die_gradient_each_c")
        self._gradient_tau_s = settings.die_gradient_tau_s
        self._lag_s = settings.by_axis("die_lag_each_s")
        self._begin_s = -min(settings.powered_s, float(np.ceil(_FORGOTTEN * self._lag_s.max())))

    @property
    def alike(self) -> bool:
        """True if all three dies have the temperature of the sensor, without lag and gradient."""
        return not (self._gradient_c.any() or self._lag_s.any())

    def temperature_c(self, time_s: Floats, part_c: Callable[[Floats], Floats]) -> Floats:
        """Return the die temperatures (n, 3) in °C at times (n,) in s.

        `part_c` is a function that gives the temperature of the sensor in °C at times in s.
        """
        result = np.repeat(part_c(time_s)[:, None], 3, axis=1)
        if self.alike:
            return result
        if self._lag_s.any():
            steps = int(np.ceil((float(time_s.max()) - self._begin_s) / _STEP_S)) + 1
            record_s = self._begin_s + _STEP_S * np.arange(max(steps, 1) + 1, dtype=np.float64)
            record = part_c(record_s)
            for k, tau_s in enumerate(self._lag_s):
                if tau_s:
                    result[:, k] = lagged(record_s, record, time_s, float(tau_s))[0]
        on_s = np.maximum(time_s + self._powered_s, 0.0)
        warmer: Floats = -np.expm1(-on_s / self._gradient_tau_s)[:, None] * self._gradient_c
        return result + warmer
