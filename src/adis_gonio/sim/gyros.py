"""Three gyros with their faults: what they read, and what is true of them.

The convention is that of `settings.GyroSettings`. A gyro's axis is misaligned towards the axes of the
gyros' frame (`gyro_misalignment_…`), and that frame is turned against the accelerometers' (`gyro_triad_…`);
what is stated is the two together, in the accelerometers' frame, as a fit sees it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.variants import Performance
from adis_gonio.model.effects.base import AXES
from adis_gonio.sim.electronics import Electronics
from adis_gonio.sim.inputs import Floats
from adis_gonio.sim.noise import RateWalk
from adis_gonio.sim.settings import WorldSettings

REFERENCE_C = 25.0
REFERENCE_V = 5.0
PAIRS = tuple(a + b for a, b in itertools.product(AXES, repeat=2))


@dataclass(frozen=True)
class Felt:
    """What gyros feel at n times.

    Attributes
    ----------
    rate_dps : (n, 3) float
        Rate of turn in the accelerometers' frame.
    gravity_mg, force_mg : (n, 3) float
        What ideal accelerometers read of gravity, and of gravity and motion together.
    dies_c : (n, 3) float
        Temperature of each gyro.
    supply_v, time_s : (n,) float
    """

    rate_dps: Floats
    gravity_mg: Floats
    force_mg: Floats
    dies_c: Floats
    supply_v: Floats
    time_s: Floats


class GyroTriad:
    """Three gyros.

    Parameters
    ----------
    settings : WorldSettings
    figures : Performance
        Of the variant, for what is not given.
    bias_dps : (3,) float
        Biases at 25 °C.
    walk : Generator
        Draws the rate walk.
    """

    def __init__(
        self, settings: WorldSettings, figures: Performance, bias_dps: Floats, walk: np.random.Generator
    ) -> None:
        self._settings = settings
        self._bias = bias_dps
        self._walk = RateWalk(settings.gyro_rate_walk_dps_per_rt_s, walk)
        self.sensitivity = _sensitivity(settings)
        """Gains and directions (3, 3) in the accelerometers' frame."""
        own_g = _or(settings.gyro_g_dps_per_g, figures.gyro_g_sensitivity_dps_per_g)
        supply = _or(settings.gyro_supply_dps_per_v, figures.gyro_supply_sensitivity_dps_per_v)
        per_g = [_or(self._given(f"gyro_g_sensitivity_{pair}_dps_per_g"), own_g) for pair in PAIRS]
        self.per_g = np.array(per_g).reshape(3, 3)
        """Linear g-sensitivity (3, 3) in °/s/g: the first index is the gyro's."""
        self._per_v = np.array([_or(self._given(f"gyro_supply_{a}_dps_per_v"), supply) for a in AXES])
        per_g2 = [getattr(settings, f"gyro_g2_sensitivity_{pair}_dps_per_g2") for pair in PAIRS]
        self._per_g2 = np.array(per_g2).reshape(3, 3)
        self._tempco = self._by_axis("gyro_bias_tempco_{}_dps_per_c")
        self._scale_tempco = 1e-6 * self._by_axis("gyro_scale_tempco_{}_ppm_per_c")
        self._warm_up = self._by_axis("gyro_warm_up_{}_dps")
        self._asymmetry = self._by_axis("gyro_asymmetry_{}")

    def _given(self, name: str) -> float | None:
        value: float | None = getattr(self._settings, name)
        return value

    def _by_axis(self, name: str) -> Floats:
        return np.array([getattr(self._settings, name.format(axis)) for axis in AXES])

    @property
    def electronics(self) -> Electronics:
        """What the chip that these gyros are built into does about them."""
        given = self._settings
        return Electronics(
            range_gain={150: given.gyro_range_gain_150, 75: given.gyro_range_gain_75},
            gyro_saturation=given.gyro_saturation,
            g_compensation=given.gyro_g_compensation * self.per_g,
            origin_compensation=given.origin_compensation,
            autonull_s=given.autonull_s,
            precision_autonull_s=given.precision_autonull_s,
        )

    def read(self, felt: Felt) -> Floats:
        """Readings (n, 3) in °/s without flicker, white noise and supply."""
        gyro = self._turning(felt) + self._bias
        for k, own in enumerate(np.diagonal(self.per_g)):
            gyro[:, k] += 1e-3 * own * felt.force_mg[:, k]
        for k, j in itertools.permutations(range(3), 2):
            if self.per_g[k, j]:
                gyro[:, k] += 1e-3 * self.per_g[k, j] * felt.force_mg[:, j]
        gyro += self._walk.at(felt.time_s)
        for (k, j), per_g2 in np.ndenumerate(self._per_g2):
            if per_g2:
                gyro[:, k] += per_g2 * (1e-3 * felt.force_mg[:, j]) ** 2
        if self._tempco.any():
            gyro += self._tempco * (felt.dies_c - REFERENCE_C)
        if self._warm_up.any():
            gyro += self._warming(felt.time_s)[:, None] * self._warm_up
        return gyro

    def of_supply(self, supply_v: Floats) -> Floats:
        """What the supply (n,) adds (n, 3)."""
        return np.asarray((supply_v - REFERENCE_V)[:, None] * self._per_v)

    def _turning(self, felt: Felt) -> Floats:
        """What the gyros make of the turn."""
        if np.array_equal(self.sensitivity, np.eye(3)):
            rate = felt.rate_dps
        else:
            rate = np.empty_like(felt.rate_dps)
            for k, row in enumerate(self.sensitivity):
                # Written out: a matrix product may round differently for another number of rows.
                rate[:, k] = (
                    row[0] * felt.rate_dps[:, 0]
                    + row[1] * felt.rate_dps[:, 1]
                    + row[2] * felt.rate_dps[:, 2]
                )
        if self._asymmetry.any():
            rate = rate + self._asymmetry * np.abs(rate)
        if self._scale_tempco.any():
            rate = rate * (1 + self._scale_tempco * (felt.dies_c - REFERENCE_C))
        return rate

    def _warming(self, time_s: Floats) -> Floats:
        """What is left (n,) of what power-on brought."""
        on_s = np.maximum(time_s + self._settings.powered_s, 0.0)
        return np.asarray(np.exp(-on_s / self._settings.gyro_warm_up_tau_s))

    # -- what is true -----------------------------------------------------------------------------

    def truth(self) -> dict[str, float]:
        """Parameters at 25 °C, 5 V, long after power-on, by the names that fits use."""
        gains = np.linalg.norm(self.sensitivity, axis=1)
        misalignment_deg = np.degrees(np.arcsin(self.sensitivity / gains[:, None]))
        left = (1 - self._settings.gyro_g_compensation) * self.per_g
        result: dict[str, float] = {}
        for k, axis in enumerate(AXES):
            result[f"gyro_scale_{axis}"] = float(self.sensitivity[k, k])
            result[f"gyro_bias_{axis}"] = float(self._bias[k])
            for j, other in enumerate(AXES):
                result[f"g_sensitivity_{axis}{other}"] = float(self.per_g[k, j])
        for k, axis in enumerate(AXES):
            result[f"gyro_scale_error_{axis}"] = float(gains[k] - 1)
            result[f"gyro_scale_temperature_{axis}"] = float(self._scale_tempco[k])
            result[f"gyro_bias_temperature_{axis}"] = float(self._tempco[k])
            result[f"gyro_warm_up_{axis}"] = float(self._warm_up[k])
            result[f"gyro_asymmetry_{axis}"] = float(self._asymmetry[k])
            result[f"gyro_supply_{axis}"] = float(self._per_v[k])
            for j, other in enumerate(AXES):
                result[f"g_sensitivity_left_{axis}{other}"] = float(left[k, j])
                result[f"g2_sensitivity_{axis}{other}"] = float(self._per_g2[k, j])
                if j != k:
                    result[f"gyro_misalignment_{axis}{other}"] = float(misalignment_deg[k, j])
        return result | {
            "gyro_warm_up_tau": self._settings.gyro_warm_up_tau_s,
            "gyro_range_gain_150": self._settings.gyro_range_gain_150,
            "gyro_range_gain_75": self._settings.gyro_range_gain_75,
        }

    def truth_at(
        self, time_s: Floats, dies_c: Floats, supply_v: Floats, wander_dps: Floats
    ) -> dict[str, float]:
        """The same in the mean of times (n,): gains and biases are those of then."""
        result = self.truth()
        warm = dies_c.mean(axis=0) - REFERENCE_C
        bias = self._bias + wander_dps + self._per_v * (float(np.mean(supply_v)) - REFERENCE_V)
        bias = bias + self._tempco * warm + self._warm_up * float(np.mean(self._warming(time_s)))
        walked = self._walk.lived(time_s)
        if len(walked):
            bias = bias + walked.mean(axis=0)
        for k, axis in enumerate(AXES):
            warmer = 1 + float(self._scale_tempco[k] * warm[k])
            result[f"gyro_scale_{axis}"] *= warmer
            result[f"gyro_scale_error_{axis}"] = (1 + result[f"gyro_scale_error_{axis}"]) * warmer - 1
            result[f"gyro_bias_{axis}"] = float(bias[k])
        return result


def _sensitivity(settings: WorldSettings) -> Floats:
    gains = np.array([getattr(settings, f"gyro_scale_{axis}") for axis in AXES])
    misalignment = np.zeros((3, 3))
    for k, j in itertools.permutations(range(3), 2):
        misalignment[k, j] = getattr(settings, f"gyro_misalignment_{AXES[k]}{AXES[j]}_deg")
    misalignment = np.sin(np.radians(misalignment))
    beside = (misalignment**2).sum(axis=1)
    if beside.max() >= 1:
        raise UsageError(f"gyro_misalignment_{AXES[int(beside.argmax())]}…: no axis leans so far")
    own = np.sqrt(1 - beside)
    sensitivity = gains[:, None] * (misalignment + np.diag(own))
    turned = np.radians([getattr(settings, f"gyro_triad_{axis}_deg") for axis in AXES])
    return np.asarray(sensitivity @ _rotation(turned).T if turned.any() else sensitivity)


def _rotation(vector_rad: Floats) -> Floats:
    """Matrix (3, 3) of the rotation by a vector: Rodrigues' formula."""
    angle = float(np.linalg.norm(vector_rad))
    x, y, z = vector_rad / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _or(given: float | None, other: float) -> float:
    return other if given is None else given
