"""A session before it is measured: its bench, and the readings that a plan would give there.

The readings are those of `estimation.readings_of`, without their random parts: what ideal dwells read, and
the covariance that a session's own reduction is expected to find. White noise of σ a sample, filtered or
not, has the spectral density σ² at frequency zero, because the chip's filter passes zero unchanged: a mean
of n samples has the variance σ²/n. To that come the converter's step (`quantized_means`) and the 1/f noise
that dwells have and share (`flicker_parts`), by when each is measured.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.settings import filter_settling_samples, sample_period_s
from adis_gonio.device.sensor.variants import VARIANTS, Variant, variant
from adis_gonio.fitting.estimation.readings import Readings, flicker_parts, from_means, quantized_means
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import PlanarTurn
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.plans import Plan
from adis_gonio.record.settings import TURN_S, Settings, expected_each_s

LARGEST_FIXTURE_DEG = 30.0
"""What a hand and an eye do without a stage; who knows less than that declares no angle."""
LARGEST_NOISE_MG = 10_000.0
LARGEST_START_DEG = 3600.0


@dataclass(frozen=True)
class Bench:
    """Where a plan will be carried out.

    Attributes
    ----------
    fixture_deg : float
        Standard uncertainty of a stage angle.
    sensor : str
        Variant by name; its figures stand where nothing else is stated.
    noise_mg : float or None
        White noise of a sample, rms, as it is without the chip's filter; None: the variant's figure.
    flicker_mg : float or None
        Floor of the Allan deviation (1/f noise); None: the variant's figure.
    start_deg : float
        Angle α of the part at the stage's zero, as far as it is known.
    gravity_mps2 : float
        Local gravity.
    settings : Settings
        Dwell, settling, rate and filter.

    Raises
    ------
    UsageError
        A figure that no bench has.
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
            raise UsageError("noise_mg and flicker_mg are both 0: of no noise nothing is to be predicted")

    @property
    def part(self) -> Variant:
        """The variant's row."""
        return VARIANTS[self.sensor]

    @property
    def white_mg(self) -> float:
        """White noise of an unfiltered sample in mg, rms."""
        return self.part.performance.noise_mg if self.noise_mg is None else self.noise_mg

    @property
    def floor_mg(self) -> float:
        """Floor of the Allan deviation in mg."""
        return self.part.performance.bias_instability_mg if self.flicker_mg is None else self.flicker_mg

    @property
    def samples(self) -> int:
        """Samples of a dwell."""
        return round(self.settings.dwell_s / sample_period_s(self.settings.smpl_prd))

    @property
    def gravity_mg(self) -> float:
        """Local gravity in mg."""
        return 1000.0 * self.gravity_mps2 / STANDARD_GRAVITY_MPS2

    @property
    def settle_s(self) -> float:
        """Wait before a dwell, the filter's settling among it."""
        period_s = sample_period_s(self.settings.smpl_prd)
        return max(self.settings.settle_s, filter_settling_samples(self.settings.filter_m) * period_s)

    @property
    def each_s(self) -> float:
        """Time that a position takes, as a session expects it before it has timed one."""
        return expected_each_s(self.settle_s, self.settings.dwell_s)

    def begins_s(self, plan: Plan) -> Floats:
        """When each dwell begins, (n,) s after the first."""
        waits = np.cumsum([position.wait_s for position in plan.positions])
        return np.asarray(self.each_s * np.arange(len(plan)) + waits - waits[0])

    def seconds(self, plan: Plan) -> float:
        """How long a session by the plan takes."""
        return self.each_s * len(plan) + sum(position.wait_s for position in plan.positions)

    @property
    def mean_mg2(self) -> tuple[float, float]:
        """Variance of a dwell's mean: by noise that averaging lowers, and by what the steps leave."""
        step = self.part.accel_mg_per_lsb
        taps = 2**self.settings.filter_m
        weights = np.convolve(np.full(taps, 1 / taps), np.full(taps, 1 / taps))
        # A sample's own rounding is white as long as noise dithers it, and falls with the mean.
        own = self.white_mg**2 * float(weights @ weights) + step**2 / 12
        left = quantized_means(np.array([[own]]), np.array([step]))
        dithered = step**2 / 12 if not left.any() else 0.0
        return (self.white_mg**2 + dithered) / self.samples, float(left[0, 0])

    def as_dict(self) -> dict[str, Any]:
        """JSON form: figures as they were used, and the time model."""
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


def imagined(plan: Plan, bench: Bench, off_deg: Floats | None = None) -> Readings:
    """Readings of a perfect part in the positions of a plan, with the covariance that they will have.

    Temperature, supply and vibration are none of a plan's business and are not recorded here.

    Parameters
    ----------
    off_deg : (n,) float, optional
        How far the stage stands beyond the declared angles; by default it does not.

    Raises
    ------
    UsageError
        The plan does not turn in a plane.
    """
    if plan.plane != "xy" or any(position.angle_deg is None for position in plan.positions):
        raise UsageError(f"plan '{plan.name}' has attitudes in space: only turns in a plane are predicted")
    angle = np.radians([position.angle_deg or 0.0 for position in plan.positions])
    n = len(angle)
    begin = bench.begins_s(plan)
    end = begin + bench.settings.dwell_s
    mean = perfect_mg(angle if off_deg is None else angle + np.radians(off_deg), bench)
    white, rounding = bench.mean_mg2
    own, slow = flicker_parts(begin, end, np.full(2, bench.floor_mg**2))
    approach = np.array([float(position.approach) for position in plan.positions])
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


def perfect_mg(angle_rad: Floats, bench: Bench) -> Floats:
    """What the axes of a perfect part read (n, 2) at stage angles (n,)."""
    model = PlanarTurn(bench.gravity_mg)
    base = model.nominal
    base[model.index("alpha")] = math.radians(bench.start_deg)
    return model.ideal(base, np.zeros(len(angle_rad)), -angle_rad)
