"""The kinds of disturbances: each a physical story, its shape, its causes and the fair names for it.

A shape is a function of the bench, of a random generator and of the axis. It returns one number per dwell.
Its size is arbitrary, because the session scales it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .bench import Array, Bench

Shape = Callable[[Bench, np.random.Generator, int], Array]
FAMILIES = ("smooth", "product", "broken")
ENTRIES = ("zero", "zeros", "gain", "misalignment", "attitude")


@dataclass(frozen=True)
class Kind:
    """One kind of disturbance.

    Attributes
    ----------
    name, family, origin
        A word, one of `FAMILIES`, and the physical story.
    enters
        One of `ENTRIES`: the zero of one axis, of both axes, the gain of an axis, the angle between the
        axes, or the attitude of the part.
    causes
        Covariates that truly cause it: of temperature, temperature_rate, supply, time, order, angle,
        previous_angle, approach. A cause in the time makes the order right too, and the reverse.
    fair
        Names of the catalogue that describe it fairly; empty if none does. In a product the name of one
        factor is fair.
    shape
        Shape per dwell; its third argument is the axis, 0 for x and 1 for y.
    """

    name: str
    family: str
    origin: str
    enters: str
    causes: frozenset[str]
    fair: frozenset[str]
    shape: Shape


ONCE_A_TURN = "stage_periodic stage_eccentricity stage_ellipticity"
"""Fair names of an error of the true angle that repeats once a turn and is no sinusoid."""
KINDS: dict[str, Kind] = {}


def _kind(family: str, enters: str, causes: str, fair: str = "") -> Callable[[Shape], Shape]:
    """Register a shape; its docstring is the physical origin."""

    def register(shape: Shape) -> Shape:
        name = getattr(shape, "__name__", "").lstrip("_")
        origin = (shape.__doc__ or "").strip()
        KINDS[name] = Kind(
            name, family, origin, enters, frozenset(causes.split()), frozenset(fair.split()), shape
        )
        return shape

    return register


def _middle(values: Array, rng: np.random.Generator) -> float:
    """Draw a value well within the range of the covariate."""
    return float(np.quantile(values, rng.uniform(0.25, 0.75)))


def _span(values: Array) -> float:
    """Range of the covariate, never zero."""
    return max(float(np.ptp(values)), 1e-9)


def _unit(values: Array) -> Array:
    """Covariate on the scale from 0 to 1."""
    return np.asarray((values - values.min()) / _span(values))


def _phase(rng: np.random.Generator) -> float:
    return float(rng.uniform(0, 2 * np.pi))


def _event(bench: Bench, rng: np.random.Generator) -> float:
    """Draw a moment between two dwells in the middle part of the session."""
    n = len(bench.time_s)
    after = int(rng.integers(n // 4, 3 * n // 4))
    return float((bench.time_s[after] + bench.time_s[after - 1]) / 2)


def _soft_knee(values: Array, at: float, width: float) -> Array:
    """Smooth knee: zero below `at`, slope one above it."""
    return width * np.logaddexp(0, (values - at) / width)


# Smooth functions of one covariate


@_kind("smooth", "zero", "temperature", "bias_temperature")
def glue_softening(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The adhesive under the die softens around its glass transition and releases its stress."""
    temp = bench.temp_c
    return np.tanh((temp - _middle(temp, rng)) / (rng.uniform(0.05, 0.2) * _span(temp)))


@_kind("smooth", "zero", "temperature", "bias_temperature")
def leakage_doubling(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Leakage into the charge amplifier doubles every few degrees."""
    return 2 ** ((bench.temp_c - bench.temp_c.max()) / rng.uniform(1.5, 4))


@_kind("smooth", "gain", "temperature", "scale_temperature")
def activity_dip(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The crystal of the demodulator loses amplitude at the temperature of a spurious resonance."""
    temp = bench.temp_c
    return -1 / (1 + ((temp - _middle(temp, rng)) / (rng.uniform(0.08, 0.2) * _span(temp))) ** 2)


@_kind("smooth", "zero", "temperature", "bias_temperature")
def clock_beat(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Two oscillators of different tempco beat, and the zero moves periodically with temperature."""
    return np.sin(2 * np.pi * rng.uniform(1.2, 3) * _unit(bench.temp_c) + _phase(rng))


@_kind("smooth", "zero", "supply", "supply_bias")
def regulator_headroom(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The regulator loses its loop gain softly when the supply comes near its drop-out."""
    supply = -bench.supply_v
    return _soft_knee(supply, _middle(supply, rng), rng.uniform(0.03, 0.1) * _span(supply))


@_kind("smooth", "gain", "supply", "supply_scale")
def reference_ceiling(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A reference follows the supply until a clamp holds it."""
    supply = bench.supply_v
    return np.tanh((supply - _middle(supply, rng)) / (rng.uniform(0.08, 0.25) * _span(supply)))


@_kind("smooth", "zero", "supply", "supply_bias")
def switcher_beat(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The frequency of a switching regulator follows the supply and beats with the sampling clock."""
    return np.cos(2 * np.pi * rng.uniform(1.2, 3) * _unit(bench.supply_v) + _phase(rng))


@_kind("smooth", "zero", "time order", "warm_up bias_drift")
def outgassing(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The package gives off moisture; stress relaxes as a stretched exponential."""
    return np.exp(-((bench.time_s / (rng.uniform(0.1, 0.4) * bench.time_s[-1])) ** rng.uniform(0.35, 0.6)))


@_kind("smooth", "attitude", "time order")
def swaying_building(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The floor tilts to and fro with the cycles of the air conditioning."""
    return np.sin(2 * np.pi * rng.uniform(1.3, 4) * bench.time_s / bench.time_s[-1] + _phase(rng))


@_kind("smooth", "zero", "time order", "warm_up bias_drift")
def dielectric_charging(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Charge creeps into the oxide of the electrodes: logarithm of the time since power-on."""
    return np.log1p(bench.time_s / (rng.uniform(0.01, 0.1) * bench.time_s[-1]))


@_kind("smooth", "attitude", "time order")
def passing_load(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A crane stops near the bench for some minutes and bends the floor."""
    return np.exp(
        -0.5 * ((bench.time_s - _event(bench, rng)) / (rng.uniform(0.06, 0.15) * bench.time_s[-1])) ** 2
    )


@_kind("smooth", "zero", "time order")
def ringing_oven(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A badly tuned heater at the far side of the part rings down; the thermometer does not see it."""
    share = bench.time_s / bench.time_s[-1]
    return np.exp(-rng.uniform(1, 3) * share) * np.cos(2 * np.pi * rng.uniform(2, 4) * share + _phase(rng))


@_kind("smooth", "gain", "time order", "scale_drift")
def ageing_reference(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A fresh buried reference settles with a small power of the time."""
    return (bench.time_s / bench.time_s[-1]) ** rng.uniform(0.15, 0.4)


@_kind("smooth", "attitude", "angle", "stage_periodic")
def two_gears(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Two gears of the drive have eccentric teeth: two whole numbers of cycles a turn."""
    first, second = rng.choice([3, 4, 5, 6, 7], 2, replace=False)
    return np.sin(first * bench.theta + _phase(rng)) + rng.uniform(0.4, 1) * np.sin(
        second * bench.theta + _phase(rng)
    )


@_kind("smooth", "attitude", "angle", ONCE_A_TURN)
def tight_bearing(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The bearing binds over a part of the turn and winds the shaft there."""
    return np.exp(rng.uniform(3, 12) * (np.cos(bench.theta - _phase(rng)) - 1))


@_kind("smooth", "zero", "angle")
def finger_pitch(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The field of the comb fingers is periodic in the deflection of the proof mass."""
    return np.sin(2 * np.pi * bench.forces()[:, axis] / rng.uniform(0.35, 0.7) + _phase(rng))


@_kind("smooth", "zero", "angle", "cubic")
def electrostatic_softening(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The electrostatic spring softens steeply when the gap closes."""
    force = bench.forces()[:, axis]
    return force / (1 - (force / rng.uniform(1.05, 1.25)) ** 2)


@_kind("smooth", "zero", "angle", "cubic")
def root_law(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A particle under the spring stiffens it for small deflections: a root of the force."""
    force = bench.forces()[:, axis]
    return np.sign(force) * np.abs(force) ** rng.uniform(0.3, 0.6)


@_kind("smooth", "attitude", "order time")
def tired_operator(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The person at the dial reads the vernier more and more from one side."""
    share = np.arange(len(bench.time_s)) / len(bench.time_s)
    return np.expm1(rng.uniform(3, 7) * share)


# Products and surfaces of two covariates


@_kind("product", "zero", "temperature angle", "scale_temperature")
def hot_spring(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The stiffening of the spring at large force depends on temperature."""
    force = bench.forces()[:, axis]
    return force**3 * np.tanh((bench.temp_c - _middle(bench.temp_c, rng)) / (0.4 * _span(bench.temp_c)))


@_kind("product", "attitude", "temperature angle", "stage_eccentricity")
def sagging_bracket(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A plastic bracket sags under gravity, the more the warmer it is."""
    soft = 2 ** ((bench.temp_c - bench.temp_c.max()) / rng.uniform(2, 6))
    return soft * np.sin(bench.theta - _phase(rng))


@_kind("product", "zero", "supply temperature", "supply_bias bias_temperature")
def hot_dropout(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The drop-out of the regulator grows with temperature."""
    need = -bench.supply_v + rng.uniform(0.4, 0.8) * _span(bench.supply_v) * (_unit(bench.temp_c) - 0.5)
    return _soft_knee(need, _middle(need, rng), 0.05 * _span(need))


@_kind("product", "gain", "supply temperature", "supply_scale scale_temperature")
def ratiometric_reference(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The reference is ratiometric, and its divider has a tempco."""
    heat = bench.temp_c - _middle(bench.temp_c, rng)
    return (bench.supply_v - _middle(bench.supply_v, rng)) * heat


@_kind("product", "attitude", "temperature angle", "stage_eccentricity")
def stiff_cable(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A cable of PVC pulls the part towards the wall, and is stiff while it is cold."""
    cold = 1 - np.tanh((bench.temp_c - _middle(bench.temp_c, rng)) / (0.2 * _span(bench.temp_c)))
    return cold * np.cos(bench.theta - _phase(rng))


@_kind("product", "zero", "time order angle", "creep scale_drift")
def creep_of_load(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The mount yields under the weight of the part, in one direction, while the session lasts."""
    slow = 1 - np.exp(-bench.time_s / (rng.uniform(0.2, 0.7) * bench.time_s[-1]))
    return slow * np.cos(bench.theta - _phase(rng))


@_kind("product", "attitude", "approach time order", "backlash")
def wearing_play(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The play of a dry worm grows while it runs."""
    return bench.approach * (bench.time_s / bench.time_s[-1]) ** rng.uniform(0.7, 2)


@_kind("product", "attitude", "approach angle", "backlash")
def worn_sector(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The wheel is worn over the sector that everybody uses, so the play depends on the angle."""
    return bench.approach * np.exp(rng.uniform(1, 4) * (np.cos(bench.theta - _phase(rng)) - 1))


@_kind("product", "zero", "approach temperature", "hysteresis")
def cold_grease(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Stress of the last move stays in the mount while its damping compound is cold."""
    return bench.approach * np.exp(
        -(bench.temp_c - bench.temp_c.min()) / (rng.uniform(0.2, 0.6) * _span(bench.temp_c))
    )


@_kind("product", "zero", "supply angle", "supply_bias")
def slip_ring(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The resistance of a slip ring varies round the turn, and the current with the supply."""
    drop = bench.supply_v - bench.supply_v.min() + 0.2 * _span(bench.supply_v)
    return drop * np.sin(rng.integers(3, 6) * bench.theta + _phase(rng))


@_kind("product", "gain", "time temperature order", "scale_drift scale_temperature")
def hot_ageing(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The gain ages with a rate that doubles every few degrees: an integral over its course."""
    course = bench.course
    done = np.cumsum(2 ** ((course.temp_c - course.temp_c.max()) / rng.uniform(1, 3)))
    return np.interp(bench.time_s, course.time_s, done)


@_kind("product", "zero", "temperature angle")
def convection_cell(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Warm gas in the package rises along the die; the cell has two lobes."""
    heat = bench.temp_c - _middle(bench.temp_c, rng)
    return heat * np.cos(2 * bench.theta - _phase(rng))


@_kind("product", "zeros", "supply time order", "supply_bias warm_up")
def dissipation(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A linear regulator near the die heats it with the square of the overvoltage and with a lag."""
    over = bench.supply_v - bench.supply_v.min() + 0.3 * _span(bench.supply_v)
    return over**2 * (1 - np.exp(-bench.time_s / (rng.uniform(0.1, 0.4) * bench.time_s[-1])))


@_kind("product", "attitude", "temperature time order")
def thermal_ratchet(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The clamp expands against a screw that yields: heat times the time."""
    return (bench.temp_c - _middle(bench.temp_c, rng)) * (bench.time_s / bench.time_s[-1]) ** rng.uniform(
        0.5, 1.5
    )


@_kind("product", "zero", "time order angle", "vibration_rectification")
def fan_at_work(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A fan runs up; its shaking in one direction of the room is rectified by an axis along it."""
    shake = 1 / (1 + np.exp(-(bench.time_s - _event(bench, rng)) / (0.08 * bench.time_s[-1])))
    return shake * np.cos(bench.theta - _phase(rng)) ** 2


@_kind("product", "zero", "temperature angle", "cross_axis")
def warm_cross_talk(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Cross-talk between the axes by a stress that comes with heat."""
    heat = bench.temp_c - _middle(bench.temp_c, rng)
    return heat * bench.forces().prod(axis=1)


@_kind("product", "misalignment", "temperature time order", "misalignment_temperature")
def twisting_board(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The board twists with heat between the two dies until its screws have settled."""
    settle = np.exp(-bench.time_s / (rng.uniform(0.3, 1) * bench.time_s[-1]))
    return (bench.temp_c - _middle(bench.temp_c, rng)) * settle


# Broken courses


@_kind("broken", "zero", "supply", "supply_bias")
def regulator_dropout(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Below its drop-out the regulator lets the supply through."""
    return np.maximum(0, _middle(bench.supply_v, rng) - bench.supply_v)


@_kind("broken", "zero", "temperature", "bias_temperature")
def lifted_corner(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Above one temperature a corner of the package lifts from the board and the stress grows."""
    return np.maximum(0, bench.temp_c - _middle(bench.temp_c, rng))


@_kind("broken", "zero", "angle")
def sticking_mass(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The proof mass sticks to a stop for small forces: a dead zone."""
    return -np.clip(bench.forces()[:, axis], -(zone := rng.uniform(0.1, 0.5)), zone)


@_kind("broken", "attitude", "approach angle", "backlash")
def hanging_play(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The weight of the part takes up the play over half of the turn; in the other half the drive does."""
    return np.where(np.sin(bench.theta - _phase(rng)) > 0, bench.approach, 1.0)


@_kind("broken", "zero", "temperature temperature_rate", "bias_temperature thermal_lag")
def solder_loop(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Solder yields when the strain turns: a loop of play over temperature."""
    width = rng.uniform(0.1, 0.3) * _span(bench.temp_c)
    state = bench.course.temp_c.copy()
    for step in range(1, len(state)):
        temp = bench.course.temp_c[step]
        state[step] = min(max(state[step - 1], temp - width), temp + width)
    return np.interp(bench.time_s, bench.course.time_s, state) - rng.uniform(0, 1) * bench.temp_c


@_kind("broken", "zero", "temperature temperature_rate", "thermal_lag")
def buried_die(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Two thermal resistances in series lie between the thermometer and the die."""
    state = bench.course.temp_c
    for tau in rng.uniform(0.03, 0.15, 2) * bench.time_s[-1]:
        lagged = state.copy()
        for step in range(1, len(state)):
            lagged[step] = lagged[step - 1] + (state[step] - lagged[step - 1]) / max(tau, 1.0)
        state = lagged
    return np.interp(bench.time_s, bench.course.time_s, state - bench.course.temp_c)


@_kind("broken", "attitude", "time order", "position_slip")
def slipped_clamp(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The part slips in its clamp once."""
    return (bench.time_s > _event(bench, rng)).astype(float)


@_kind("broken", "zero", "time order")
def knocked_part(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A knock against the bench shifts the zero for good."""
    return (bench.time_s > _event(bench, rng)).astype(float)


@_kind("broken", "zero", "time order")
def popcorn(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A defect of the crystal switches the zero between two levels."""
    changes = rng.random(len(bench.time_s)) < rng.uniform(0.12, 0.3)
    return np.where(np.cumsum(changes) % 2 == 0, 1.0, -1.0)


@_kind("broken", "attitude", "angle previous_angle approach time order")
def stick_slip(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Each move winds the shaft; at a limit it slips back."""
    limit = rng.uniform(250, 900)
    return (np.cumsum(np.abs(np.diff(bench.travel_deg, prepend=0))) % limit) / limit


@_kind("broken", "attitude", "angle", ONCE_A_TURN)
def taut_cable(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The cable hangs loose until it is taut, and pulls on both sides of its anchor."""
    off = (bench.angle_deg - rng.uniform(0, 360) + 180) % 360 - 180
    return np.sign(off) * np.maximum(0, np.abs(off) - rng.uniform(60, 140))


@_kind("broken", "attitude", "angle previous_angle time order approach")
def cage_of_balls(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The cage of the bearing turns at two fifths of the shaft: an error not periodic in the angle."""
    return np.sin(rng.uniform(0.38, 0.44) * np.radians(bench.travel_deg) + _phase(rng))


@_kind("broken", "zeros", "time order", "outlier_dwell")
def burst(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A lift starts: two to four dwells swing and calm down."""
    first = int(rng.integers(3, len(bench.time_s) - 6))
    shape = np.zeros(len(bench.time_s))
    length = int(rng.integers(2, 5))
    shape[first : first + length] = np.cos(2.2 * np.arange(length)) * np.exp(-0.4 * np.arange(length))
    return shape


@_kind("broken", "zero", "time order")
def aliased_hum(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Hum of the mains is aliased to a period of a few dwells."""
    pause = float(np.median(np.diff(bench.time_s)))
    return np.sin(2 * np.pi * bench.time_s / (rng.uniform(2.3, 6) * pause) + _phase(rng))


@_kind("broken", "zero", "time order")
def shock_relaxation(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A shock shifts the zero, and it comes back exponentially."""
    since = bench.time_s - _event(bench, rng)
    return np.where(
        since > 0, np.exp(-np.maximum(since, 0) / (rng.uniform(0.1, 0.3) * bench.time_s[-1])), 0.0
    )


@_kind("broken", "attitude", "angle", "backlash " + ONCE_A_TURN)
def turned_flank(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The weight of an unbalanced part presses against one flank of the tooth, then against the other."""
    return np.sign(np.sin(bench.theta - _phase(rng)))


@_kind("broken", "zero", "time order angle")
def clamped_again(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Between two passes the part was clamped again and leans: the change follows the angle."""
    return np.where(bench.time_s > _event(bench, rng), np.cos(bench.theta - _phase(rng)), 0.0)


@_kind("broken", "zero", "approach angle previous_angle", "hysteresis")
def comparator(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The zero depends on whether the force on this axis last rose or fell."""
    return np.sign(np.diff(bench.forces()[:, axis], prepend=-2))


@_kind("broken", "zero", "angle previous_angle time order approach", "hysteresis creep settling")
def memory_of_load(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The spring remembers the load of the dwell before, and forgets it exponentially."""
    gaps = np.diff(bench.time_s, prepend=bench.time_s[0] - 60)
    force = bench.forces()[:, axis]
    return np.diff(force, prepend=force[0]) * np.exp(-gaps / rng.uniform(20, 200))


@_kind("broken", "zeros", "time order")
def thermostat(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """A heater behind the part switches on and off; the thermometer sits elsewhere."""
    return (bench.time_s * rng.uniform(2.5, 6) / bench.time_s[-1] + rng.uniform()) % 1.0


@_kind("broken", "zero", "angle")
def missing_code(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """The converter jumps at one major carry of its code."""
    return (bench.forces()[:, axis] > rng.uniform(-0.7, 0.7)).astype(float)


@_kind("broken", "attitude", "angle order time")
def ratchet_at_top(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Each time the heavy side passes the top, the part moves on in its clamp by one notch."""
    return np.floor(np.cumsum(np.abs(np.diff(bench.travel_deg, prepend=0))) / 360 + rng.uniform())


@_kind("broken", "zero", "supply time order", "supply_bias")
def latched_brownout(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """Once the supply has dipped below a level, a register keeps its wrong value."""
    lowest = np.interp(bench.time_s, bench.course.time_s, np.minimum.accumulate(bench.course.supply_v))
    return (lowest < _middle(lowest, rng)).astype(float)


@_kind("broken", "misalignment", "angle")
def loose_screw(bench: Bench, rng: np.random.Generator, axis: int) -> Array:
    """One die tips over on its loose screw when gravity changes sides."""
    return np.sign(np.cos(bench.theta - _phase(rng)))
