"""What a session may hide: causes of the catalogue, foreign ones, strangers and pure scatter.

A cause makes something `Planted` of a session's circumstances: what one unit of its amplitude adds to
the readings and to the true angle, or how large a scatter it is. Strangers are invented from physics,
without regard to what any tool can express; each says in one sentence what it is. `covariates` are
groups of words: whoever names one word of each group has seen what the residual depends on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .catalogue import NAMES, terms
from .circumstances import Circumstances, Floats, lagged

TIME = frozenset({"time", "order"})
ANGLE = frozenset({"angle"})
READING = frozenset({"reading", "magnitude", "angle"})
"""In the plane what depends on the reading depends on the angle."""
TEMPERATURE = frozenset({"temperature"})
SUPPLY = frozenset({"supply"})
APPROACH = frozenset({"approach"})
HISTORY = frozenset({"previous", "previous_angle", "move", "travel", "approach", "order"})
TRAVEL = frozenset({"travel", "order", "time", "angle"})
PAUSE = frozenset({"pause"})


@dataclass
class Planted:
    """What a cause adds for one unit of its amplitude.

    Attributes
    ----------
    reading : (n, axes) float
        mg; of scatter one draw of it.
    angle : (n,) float
        rad; of scatter one draw of it.
    parameters : dict
        Catalogue's parameters by name for one unit; empty for strangers.
    detail : str
        Which way it acts.
    reading_covariance : (n, n) float or None
        Of scatter: of each axis, mg².
    angle_covariance : (n, n) float or None
        Of scatter: of the true angle, rad².
    """

    reading: Floats
    angle: Floats
    parameters: dict[str, float] = field(default_factory=dict)
    detail: str = ""
    reading_covariance: Floats | None = None
    angle_covariance: Floats | None = None

    @property
    def is_scatter(self) -> bool:
        """Whether no covariate explains it."""
        return self.reading_covariance is not None or self.angle_covariance is not None


Maker = Callable[[Circumstances, Floats, np.random.Generator], Planted]


@dataclass(frozen=True)
class Cause:
    """A cause.

    Attributes
    ----------
    name : str
        Of the catalogue, or the stranger's own.
    family : str
        `catalogue`, `foreign`, `stranger` or `scatter`.
    what : str
        One sentence.
    covariates : tuple of frozenset
        Groups of words; empty for the catalogue. Of scatter that is correlated: what may be said without
        fabricating (a walk is smooth in time).
    plane, space : bool
        Where it can occur.
    since : str
        Name that the catalogue has had for it since the causes were written down, if any.
    needs : frozenset
        Of `temperature`, `supply`, `approach`, `vibration`, `fine_angles`: what the session must have.
    make : callable
    """

    name: str
    family: str
    what: str
    covariates: tuple[frozenset[str], ...]
    plane: bool
    space: bool
    needs: frozenset[str]
    make: Maker
    since: str = ""


CAUSES: dict[str, Cause] = {}


def _cause(
    family: str,
    *covariates: frozenset[str],
    plane: bool = True,
    space: bool = True,
    needs: str = "",
    since: str = "",
) -> Callable[[Maker], Maker]:
    def register(make: Maker) -> Maker:
        name = make.__name__.strip("_")
        what = (make.__doc__ or "").strip()
        required = frozenset(needs.split())
        CAUSES[name] = Cause(name, family, what, covariates, plane, space, required, make, since)
        return make

    return register


# The catalogue


_NEEDS = {
    "bias_temperature": "temperature",
    "scale_temperature": "temperature",
    "thermal_lag": "temperature",
    "supply_bias": "supply",
    "vibration_rectification": "vibration",
    "hysteresis": "approach",
    "backlash": "approach",
}
_STAGE = {"backlash", "stage_eccentricity", "stage_ellipticity", "position_slip"}


def _catalogued(name: str) -> Maker:
    def make(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
        ways = terms(name, c, a)
        if not ways:
            raise ValueError(f"{name}: this session cannot show it")
        # One of the axes as often as all of them.
        sizes = np.array([len(t.parameters) for t in ways])
        weight = np.where(
            sizes == sizes.max(), 1 / np.sum(sizes == sizes.max()), 1 / max(np.sum(sizes < sizes.max()), 1)
        )
        term = ways[rng.choice(len(ways), p=weight / weight.sum())]
        size = rng.uniform(0.4, 1.0, len(term.parameters)) * rng.choice([-1, 1], len(term.parameters))
        parameters = dict(zip(term.parameters, size.tolist(), strict=True))
        return Planted(term.reading @ size, term.angle @ size, parameters, term.label)

    return make


for _name in NAMES:
    CAUSES[_name] = Cause(
        _name, "catalogue", "See docs/effects.md.", (), True, _name not in _STAGE,
        frozenset(_NEEDS.get(_name, "").split()), _catalogued(_name),
    )  # fmt: skip


# Help for what follows


def _axes(c: Circumstances, rng: np.random.Generator) -> Floats:
    """Weights of the axes: one alone as often as all."""
    weight = rng.uniform(0.4, 1, c.axes) * rng.choice([-1, 1], c.axes)
    if rng.random() < 0.5:
        weight *= np.arange(c.axes) == rng.integers(c.axes)
    return weight


def _bias(c: Circumstances, rng: np.random.Generator, shape: Floats) -> Planted:
    return Planted(np.outer(shape, _axes(c, rng)), np.zeros(c.n))


def _gain(c: Circumstances, a: Floats, rng: np.random.Generator, shape: Floats) -> Planted:
    return Planted(shape[:, None] * a * _axes(c, rng), np.zeros(c.n))


def _reading(c: Circumstances, rng: np.random.Generator, value: Floats) -> Planted:
    return Planted(value * _axes(c, rng), np.zeros(c.n))


def _turned(c: Circumstances, shape: Floats) -> Planted:
    return Planted(np.zeros((c.n, c.axes)), np.radians(shape))


def _phase(rng: np.random.Generator) -> float:
    return rng.uniform(0, 2 * np.pi)


def _unit(x: Floats) -> Floats:
    """From −1 to 1."""
    return (x - x.min()) / max(np.ptp(x), 1e-12) * 2 - 1


def _travel(c: Circumstances) -> Floats:
    return np.cumsum(np.abs(c.move_rad)) / (2 * np.pi)


# Foreign: a form that the catalogue has, with a covariate or in a place where it does not have it


@_cause("foreign", TIME, since="scale_drift")
def gain_time(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The gain drifts evenly with time."""
    return _gain(c, a, rng, c.minutes)


@_cause("foreign", SUPPLY, needs="supply", since="supply_scale")
def gain_supply(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The gain follows the supply."""
    return _gain(c, a, rng, c.supply_v - 5)


@_cause("foreign", APPROACH, needs="approach")
def gain_approach(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The gain depends on the direction of approach."""
    return _gain(c, a, rng, c.approach)


@_cause("foreign", TEMPERATURE, plane=True, space=False, needs="temperature")
def angle_temperature(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The mount turns with the temperature."""
    return _turned(c, c.temp_c - 25)


@_cause("foreign", TIME, space=False)
def angle_time(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The mount turns evenly with time."""
    return _turned(c, c.minutes)


@_cause("foreign", ANGLE, space=False, since="stage_periodic")
def angle_third(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A stage's error of three cycles a turn."""
    return _turned(c, np.sin(3 * c.angle_rad + _phase(rng)))


@_cause("foreign", ANGLE, space=False, since="stage_periodic")
def angle_fourth(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A stage's error of four cycles a turn."""
    return _turned(c, np.sin(4 * c.angle_rad + _phase(rng)))


@_cause("foreign", TEMPERATURE, needs="temperature", since="misalignment_temperature")
def misalignment_temperature(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """An axis leans towards another with the temperature."""
    value = np.zeros((c.n, c.axes))
    i, p = rng.choice(c.axes, 2, replace=False)
    value[:, i] = (c.temp_c - 25) * a[:, p]
    return Planted(value, np.zeros(c.n))


@_cause("foreign", TEMPERATURE, needs="temperature")
def quadratic_temperature(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The curvature of the response grows with the temperature."""
    return _reading(c, rng, (c.temp_c - 25)[:, None] * a**2)


@_cause("foreign", SUPPLY, space=False, needs="supply")
def angle_supply(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A motor that holds its angle by current: the angle follows the supply."""
    return _turned(c, c.supply_v - 5)


@_cause("foreign", TEMPERATURE, needs="temperature")
def bias_temperature_square(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The zero follows the square of the temperature's distance from a turning point."""
    return _bias(c, rng, (c.temp_c - rng.uniform(c.temp_c.min(), c.temp_c.max())) ** 2)


@_cause("foreign", TIME, APPROACH, space=False, needs="approach")
def backlash_grows(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The stage's play grows with time."""
    return _turned(c, c.approach * (1 + c.order) / 2)


@_cause("foreign", PAUSE)
def bias_pause(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The zero recovers in the pause before a dwell."""
    return _bias(c, rng, _unit(c.pause_s))


# Strangers: neither form nor place is the catalogue's


@_cause("stranger", HISTORY)
def two_move_memory(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The mount remembers the last two moves."""
    last = c.move_rad if c.plane else np.concatenate([[0], np.diff(a[:, 0])])
    before = np.concatenate([[0.0], last[:-1]])
    return _bias(c, rng, 0.6 * np.tanh(2 * last) + 0.4 * np.tanh(2 * before))


@_cause("stranger", HISTORY | READING)
def preisach(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Ferromagnetic hysteresis: relays with thresholds of their own follow what the axis reads."""
    up = rng.uniform(-0.9, 0.9, 40)
    down = up - rng.uniform(0.1, 1.2, 40)
    value = np.zeros((c.n, c.axes))
    for i in range(c.axes):
        state = np.where(a[0, i] > (up + down) / 2, 1.0, -1.0)
        for k in range(c.n):
            state = np.where(a[k, i] > up, 1.0, np.where(a[k, i] < down, -1.0, state))
            value[k, i] = state.mean()
    return _reading(c, rng, value)


@_cause("stranger", TIME)
def gain_log_time(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The gain grows with the logarithm of time, as polymers creep."""
    return _gain(c, a, rng, np.log1p(c.time_s / 30))


@_cause("stranger", READING)
def soft_clip(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """An amplifier gives way beyond 0.85 g."""
    return _reading(c, rng, -np.sign(a) * np.maximum(np.abs(a) - 0.85, 0) * 10)


@_cause("stranger", READING, needs="vibration")
def vibration_clip(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Peaks of the vibration are clipped at 1.2 g, so that the mean sinks near 1 g."""
    spread = np.sqrt(np.maximum(c.variance_mg2, 1e-9)) / 1000
    room = (1.2 - np.abs(a)) / spread
    lost = spread * (np.exp(-(room**2) / 2) / np.sqrt(2 * np.pi) - room * _tail(room))
    return Planted(-np.sign(a) * lost * 1000, np.zeros(c.n))


def _tail(x: Floats) -> Floats:
    """Upper tail of the normal distribution (Abramowitz and Stegun 26.2.17), for any x."""
    t = 1 / (1 + 0.2316419 * np.abs(x))
    poly = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi) * poly
    return np.where(x >= 0, tail, 1 - tail)


@_cause("stranger", ANGLE, TIME, space=False)
def eccentricity_grows(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A bearing wears: the eccentricity of the stage grows with time."""
    return _turned(c, (1 + c.order) / 2 * np.sin(c.angle_rad + _phase(rng)))


@_cause("stranger", ANGLE, TEMPERATURE, space=False, needs="temperature")
def eccentricity_warms(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The stage warms late, and its eccentricity follows."""
    late = lagged(c.time_s, c.temp_c, 200.0)
    return _turned(c, (late - late[0]) * np.cos(c.angle_rad + _phase(rng)))


@_cause("stranger", ANGLE, space=False, needs="fine_angles", since="stage_periodic")
def worm_gear(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A worm gear of 36 teeth: 36 cycles a turn."""
    return _turned(c, np.sin(36 * c.angle_rad + _phase(rng)))


@_cause("stranger", ANGLE, space=False, needs="fine_angles")
def detents(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A ratchet of 24 teeth pulls the stage along a sawtooth."""
    return _turned(c, 2 * np.mod(c.angle_rad * 24 / (2 * np.pi) + rng.random(), 1) - 1)


@_cause("stranger", TRAVEL, space=False)
def stick_slip(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Stress builds up with travel and lets go: a sawtooth of the cumulative travel."""
    return _turned(c, 2 * np.mod(_travel(c) * rng.uniform(2.2, 3.7) + rng.random(), 1) - 1)


@_cause("stranger", HISTORY | READING | TIME, since="creep")
def creep_after_loading(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The spring creeps towards its load with a time constant of minutes."""
    tau = rng.uniform(60, 240)
    late = np.column_stack([lagged(c.time_s, a[:, i], tau) for i in range(c.axes)])
    return _reading(c, rng, late - a)


@_cause("stranger", TEMPERATURE | SUPPLY, needs="temperature supply")
def supply_droop(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The reference droops above a temperature, the more the lower the supply."""
    warm = np.maximum(c.temp_c - np.median(c.temp_c), 0)
    return _gain(c, a, rng, warm * (5.3 - c.supply_v))


@_cause("stranger", TRAVEL, space=False)
def cable_drag(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A cable winds up with the net turns and drags at the part, stiffer as it tightens."""
    wound = np.cumsum(c.move_rad) / (2 * np.pi)
    return _turned(c, wound + 0.5 * wound**3)


@_cause("stranger", TEMPERATURE, needs="temperature")
def temperature_knee(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The glue softens: the zero follows the temperature above a point only."""
    knee = np.quantile(c.temp_c, rng.uniform(0.4, 0.7))
    return _bias(c, rng, np.maximum(c.temp_c - knee, 0))


@_cause("stranger", TEMPERATURE | TIME, needs="temperature")
def condensation(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Dew comes below one temperature and stays until a higher one is reached."""
    low, high = np.quantile(c.temp_c, [0.35, 0.7])
    wet, value = False, np.zeros(c.n)
    for k, t in enumerate(c.temp_c):
        wet = (wet and t < high) or t < low
        value[k] = wet
    return _bias(c, rng, value)


@_cause("stranger", TIME)
def air_conditioning(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The room breathes: the zero swings with a period of minutes."""
    period = (c.time_s[-1] + 1) / rng.uniform(2.2, 5.5)
    return _bias(c, rng, np.sin(2 * np.pi * c.time_s / period + _phase(rng)))


@_cause("stranger", TIME, space=False)
def floor_tilt(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The building leans to and fro while a lift moves slowly with the working day."""
    period = (c.time_s[-1] + 1) / rng.uniform(1.3, 3.5)
    return _turned(c, np.sin(2 * np.pi * c.time_s / period + _phase(rng)))


@_cause("stranger", TIME)
def jump(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A shock between two dwells leaves the zero elsewhere."""
    return _bias(c, rng, (c.order > rng.uniform(-0.5, 0.5)).astype(float))


@_cause("stranger", TIME, space=False)
def nudge(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Somebody pushes the stage between two dwells: the angle stays turned."""
    return _turned(c, (c.order > rng.uniform(-0.5, 0.5)).astype(float))


@_cause("stranger", ANGLE, space=False)
def stage_sag(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """An overhung load sags against a spring that hardens: sin θ |sin θ|."""
    s = np.sin(c.angle_rad + _phase(rng))
    return _turned(c, s * np.abs(s))


@_cause("stranger", READING)
def signed_cross(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A stop touches on one side: the reading takes part of the other axis where both are positive."""
    value = np.zeros((c.n, c.axes))
    i, p = rng.choice(c.axes, 2, replace=False)
    value[:, i] = np.maximum(a[:, i], 0) * np.maximum(a[:, p], 0)
    return Planted(value, np.zeros(c.n))


@_cause("stranger", READING)
def dead_band(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Friction near zero: small readings come out too small."""
    return _reading(c, rng, -a * np.exp(-((a / 0.25) ** 2)) * 4)


@_cause("stranger", READING)
def quintic(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A hinge of fifth order."""
    return _reading(c, rng, a**5 * 2)


@_cause("stranger", TIME)
def sunbeam(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The sun shines on the part for a while: a bump of the zero in time."""
    return _bias(c, rng, np.exp(-(((c.order - rng.uniform(-0.5, 0.5)) / rng.uniform(0.15, 0.35)) ** 2)))


@_cause("stranger", HISTORY | READING | TIME)
def convection(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Warm air moves with the attitude: the zero follows one axis's gravity with a lag of minutes."""
    i, p = rng.choice(c.axes, 2, replace=False)
    value = np.zeros((c.n, c.axes))
    value[:, i] = lagged(c.time_s, a[:, p], rng.uniform(90, 400))
    return Planted(value, np.zeros(c.n))


@_cause("stranger", SUPPLY, needs="supply")
def drop_out(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A regulator drops out below a voltage."""
    return _bias(c, rng, np.maximum(np.median(c.supply_v) - c.supply_v, 0) * 10)


@_cause("stranger", APPROACH, ANGLE, space=False, needs="approach")
def loaded_backlash(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Play that the load takes up on one half of the turn."""
    return _turned(c, c.approach * np.cos(c.angle_rad + _phase(rng)))


@_cause("stranger", TRAVEL | READING)
def wear(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The zero moves with the root of all travel."""
    return _bias(c, rng, np.sqrt(_travel(c)))


@_cause("stranger", frozenset({"order"}))
def two_hands(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Two people take turns, and lean on the table differently."""
    return _bias(c, rng, np.where(np.arange(c.n) % 2, 1.0, -1.0))


@_cause("stranger", TEMPERATURE | frozenset({"temperature_rate"}), needs="temperature")
def temperature_rate(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A gradient across the part: the zero follows how fast the temperature changes, within a limit."""
    rate = np.gradient(c.temp_c, c.time_s)
    return _bias(c, rng, np.tanh(1.5 * rate / max(np.std(rate), 1e-9)))


@_cause("stranger", READING | ANGLE | HISTORY)
def magnet(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """An iron part of the table pulls one axis where it comes near: a narrow bump in attitude."""
    near = a[rng.integers(c.n)]
    distance = np.sum((a - near) ** 2, axis=1)
    return _bias(c, rng, 2 * np.exp(-distance / 0.3))


@_cause("stranger", TIME)
def leaking_charge(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A charge leaks by a stretched exponential and takes the gain with it."""
    return _gain(c, a, rng, np.exp(-np.sqrt(c.time_s / rng.uniform(60, 300))) * 3)


@_cause("stranger", HISTORY)
def impact(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Large moves end with a knock that shifts the zero for this dwell."""
    size = np.abs(c.move_rad)
    return _bias(c, rng, np.maximum(size - np.quantile(size, 0.6), 0))


# Pure scatter: no covariate explains it


def _scatter_reading(
    c: Circumstances, rng: np.random.Generator, covariance: Floats, draw: Floats
) -> Planted:
    return Planted(draw, np.zeros(c.n), reading_covariance=covariance)


@_cause("scatter")
def seat(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The part sits differently in its seat from dwell to dwell: every axis scatters."""
    return _scatter_reading(c, rng, np.eye(c.n), rng.normal(size=(c.n, c.axes)))


@_cause("scatter", space=False)
def fixture(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The fixture's angles scatter several times more than declared."""
    draw = np.radians(rng.normal(size=c.n))
    return Planted(np.zeros((c.n, c.axes)), draw, angle_covariance=np.eye(c.n) * np.radians(1) ** 2)


@_cause("scatter")
def heavy_tails(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Readings scatter with heavy tails (Student, three degrees of freedom)."""
    return _scatter_reading(c, rng, np.eye(c.n), rng.standard_t(3, (c.n, c.axes)) / np.sqrt(3))


@_cause("scatter", TIME)
def telegraph(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Telegraph noise: the zero jumps between two values at random times."""
    hold = (c.time_s[-1] + 1) / rng.uniform(6, 20)
    draw = np.empty((c.n, c.axes))
    for i in range(c.axes):
        flips = rng.poisson(np.diff(c.time_s, prepend=0) / hold)
        draw[:, i] = rng.choice([-1, 1]) * np.cumprod(np.where(flips % 2, -1.0, 1.0))
    gap = np.abs(c.time_s[:, None] - c.time_s)
    return _scatter_reading(c, rng, np.exp(-2 * gap / hold), draw)


def _correlated(c: Circumstances, rng: np.random.Generator, covariance: Floats) -> Planted:
    root = np.linalg.cholesky(covariance + 1e-9 * np.trace(covariance) / c.n * np.eye(c.n))
    return _scatter_reading(c, rng, covariance, root @ rng.normal(size=(c.n, c.axes)))


@_cause("scatter", TIME)
def random_walk(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The zero walks at random."""
    t = (c.time_s + c.pause_s[0]) / c.time_s[-1]
    return _correlated(c, rng, np.minimum(t[:, None], t))


@_cause("scatter", TIME)
def flicker_excess(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Flicker noise well above the part's own."""
    gap = np.abs(c.time_s[:, None] - c.time_s)
    taus = 10.0 ** np.arange(0, 5)
    return _correlated(c, rng, sum(np.exp(-gap / tau) for tau in taus) / len(taus))


@_cause("scatter", TIME)
def shifts(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Several people: each block of five dwells has an offset of its own."""
    block = np.arange(c.n) // 5
    return _correlated(c, rng, (block[:, None] == block).astype(float) + 1e-9 * np.eye(c.n))


@_cause("scatter")
def loosening(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """A screw loosens: the scatter grows through the session."""
    size = np.exp(1.2 * c.order)
    return _scatter_reading(c, rng, np.diag(size**2), size[:, None] * rng.normal(size=(c.n, c.axes)))


@_cause("scatter", TIME, space=False)
def loose_clamp(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """The clamp creeps at random: the angle walks."""
    t = (c.time_s + c.pause_s[0]) / c.time_s[-1]
    covariance = np.minimum(t[:, None], t) * np.radians(1) ** 2
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(c.n))
    return Planted(np.zeros((c.n, c.axes)), root @ rng.normal(size=c.n), angle_covariance=covariance)


@_cause("scatter")
def bumps(c: Circumstances, a: Floats, rng: np.random.Generator) -> Planted:
    """Doors slam: a fifth of the dwells are disturbed, the others are not."""
    hit = rng.random((c.n, 1)) < 0.2
    return _scatter_reading(c, rng, np.eye(c.n), hit * rng.normal(0, np.sqrt(5), (c.n, c.axes)))


def names_of(family: str) -> list[str]:
    """Names of a family's causes."""
    return [name for name, cause in CAUSES.items() if cause.family == family]
