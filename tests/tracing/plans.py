"""Plans, surroundings and noise of a blind session: everything but what is to be found.

Own physics in numpy, from the conventions of the samples CSV; nothing here imports the product.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
G_MG = 1000.0
LSB_MG = 0.4672
"""One step of the ADIS16354's accelerometer words."""
ZERO_MG = 10.0
"""Standard deviation of the zero of an axis (the initial bias of a real part)."""


@dataclass(frozen=True)
class Rows:
    """Covariates of n rows: the samples of a session, or its dwells (means).

    `history` is (times, temperatures) of all samples, `loads` (m, axes) what the axes should read then, in
    mg.
    """

    time_s: Floats
    angle_rad: Floats
    previous_rad: Floats
    approach: Floats
    order: Floats
    temperature_c: Floats
    supply_v: Floats
    history: tuple[Floats, Floats]
    loads: Floats


@dataclass(frozen=True)
class Bench:
    """A plan as it was carried out, with its noise and the part's hidden parameters.

    Attributes
    ----------
    starts : (d + 1,) int
        First sample of each dwell, and the number of samples.
    check : (d,) bool
        Dwells that are declared `check`.
    u_mg : (2,) float
        Standard uncertainty of a reading from the noise of its samples alone.
    taps : int
        Taps of each of the two averages of the filter that correlates neighbours.
    alpha, gains, dphi, zero_mg : float, (2,) float, float, (2,) float
        Start angle (rad), gains of x and y, misalignment (rad), zeros of x and y.
    """

    samples: Rows
    starts: NDArray[np.int64]
    check: NDArray[np.bool_]
    fixture_deg: float
    u_mg: Floats
    taps: int
    alpha: float
    gains: Floats
    dphi: float
    zero_mg: Floats
    has_surroundings: bool
    has_approach: bool
    in_steps: bool
    setting: str

    @property
    def dwells(self) -> Rows:
        """Means of the dwells."""
        rows, starts = self.samples, self.starts
        count = np.diff(starts)

        def mean(values: Floats) -> Floats:
            return np.add.reduceat(values, starts[:-1]) / count

        return Rows(
            mean(rows.time_s),
            rows.angle_rad[starts[:-1]],
            rows.previous_rad[starts[:-1]],
            rows.approach[starts[:-1]],
            rows.order[starts[:-1]],
            mean(rows.temperature_c),
            mean(rows.supply_v),
            rows.history,
            rows.loads,
        )

    def mean(self, values: Floats) -> Floats:
        """Means by dwell of (…, n, 2) samples."""
        total = np.add.reduceat(values, self.starts[:-1], axis=-2)
        return total / np.diff(self.starts)[:, None]

    def ideal_mg(self, psi: Floats) -> Floats:
        """Readings (n, 2) of the base model at true angles ψ."""
        return G_MG * self.gains * np.stack([np.cos(psi), np.sin(psi + self.dphi)], axis=-1)

    def slope_mg(self, psi: Floats) -> Floats:
        """Derivative of the ideal readings by ψ, (n, 2) in mg per radian."""
        return G_MG * self.gains * np.stack([-np.sin(psi), np.cos(psi + self.dphi)], axis=-1)


def _angles(rng: np.random.Generator) -> tuple[Floats, str]:
    """Declared angles in degrees in the order of recording; 12 to 48 of them."""
    turns = int(rng.integers(1, 4))
    low, high = -(-12 // turns), 48 // turns
    each = int(rng.integers(max(low, 8 if turns > 1 else 12), high + 1))
    grid = np.arange(each) * 360.0 / each
    if rng.random() < 0.25:
        grid = np.round(np.sort(rng.uniform(0, 360, each)), 1)
    shift = np.arange(turns) * (360.0 / each / turns if rng.random() < 0.3 else 0.0)
    order = str(rng.choice(["order", "reverse", "shuffled", "forth and back"]))
    parts = [np.mod(grid + s, 360.0) for s in shift]
    if order == "reverse":
        parts = [part[::-1] for part in parts]
    elif order == "forth and back":
        parts = [part[:: 1 if k % 2 == 0 else -1] for k, part in enumerate(parts)]
    angles = np.concatenate(parts)
    if order == "shuffled":
        rng.shuffle(angles)
    return np.round(angles, 6), f"{order}, {turns} turns"


def course(rng: np.random.Generator, time_s: Floats, kind: str) -> Floats:
    """A course in time of about unit size."""
    x = time_s / time_s[-1]
    if kind == "cycling":
        return np.sin(2 * np.pi * (rng.uniform(0.8, 3.2) * x + rng.random()))
    if kind == "rising":
        fast = rng.uniform(0.3, 3.0)
        return float(rng.choice([-1, 1])) * (1 - np.exp(-fast * x)) / (1 - np.exp(-fast)) * 2 - 1
    if kind == "wandering":
        knots = np.linspace(0, 1, 9)
        return np.interp(x, knots, np.cumsum(rng.normal(0, 0.5, 9)))
    if kind == "switched":
        levels = rng.uniform(-1, 1, 6)
        return levels[np.minimum((6 * x).astype(int), 5)]
    return np.zeros_like(x)


def draw_zero(rng: np.random.Generator, axes: int) -> Floats:
    """Zeros (axes,) of a part in mg; their stream is their own, so that `rng` goes on as without them."""
    return rng.spawn(1)[0].normal(0, ZERO_MG, axes)


def draw_bench(rng: np.random.Generator) -> Bench:
    """One plan with its surroundings, noise and hidden base parameters."""
    angles, order = _angles(rng)
    check = np.zeros(len(angles), bool)
    if rng.random() < 0.5:
        extra = max(6, len(angles) // 4)
        places = np.sort(rng.integers(1, len(angles) + 1, extra))
        angles = np.insert(angles, places, np.round(rng.uniform(0, 360, extra), 1))
        check = np.insert(check, places, True)
    d = len(angles)
    taps = int(rng.choice([1, 2, 4]))
    per_dwell = int(rng.integers(50, 101))
    step = rng.uniform(0.08, 0.35)
    gaps = rng.uniform(3, 20, d) + np.where(rng.random(d) < 0.06, rng.uniform(60, 300, d), 0.0)
    gaps[0] = 0.0
    begin = np.cumsum(gaps) + np.arange(d) * per_dwell * step
    time = (begin[:, None] + np.arange(per_dwell) * step).ravel()
    starts = np.arange(d + 1) * per_dwell
    index = np.repeat(np.arange(d), per_dwell)

    moves = np.mod(np.diff(angles, prepend=angles[0]) + 180, 360) - 180
    approach = np.where(moves == 0, 1.0, np.sign(moves))
    if rng.random() < 0.6:
        approach = rng.choice([-1.0, 1.0], d)
    theta = np.deg2rad(angles)
    previous = np.concatenate([theta[:1], theta[:-1]])

    thermal = str(rng.choice(["cycling", "rising", "wandering", "cycling", "still"]))
    temperature = rng.uniform(18, 34) + rng.uniform(3, 12) * course(rng, time, thermal)
    electric = str(rng.choice(["switched", "wandering", "cycling", "switched", "still"]))
    supply = rng.uniform(4.95, 5.05) + rng.uniform(0.05, 0.2) * course(rng, time, electric)
    samples = Rows(
        np.round(time, 4),
        theta[index],
        previous[index],
        approach[index],
        index.astype(float),
        np.round(temperature, 3),
        np.round(supply, 4),
        (np.round(time, 4), np.round(temperature, 3)),
        np.zeros((len(time), 2)),
    )
    u = rng.uniform(0.05, 0.3) * rng.uniform(0.8, 1.25, 2)
    bench = Bench(
        samples,
        starts,
        check,
        fixture_deg=float(np.round(np.exp(rng.uniform(np.log(0.003), np.log(0.02))), 5)),
        u_mg=u,
        taps=taps,
        alpha=float(rng.uniform(-np.pi, np.pi)),
        gains=1 + rng.normal(0, 0.005) + np.array([rng.normal(0, 0.01), 0.0]),
        dphi=float(np.deg2rad(rng.normal(0, 0.7))),
        zero_mg=draw_zero(rng, 2),
        has_surroundings=bool(rng.random() < 0.9),
        has_approach=bool(rng.random() < 0.9),
        in_steps=bool(rng.random() < 0.25),
        setting=f"{order}, {d - check.sum()} readings, temperature {thermal}, supply {electric}",
    )
    loads = bench.ideal_mg(bench.alpha - samples.angle_rad)
    return replace(bench, samples=replace(samples, loads=loads))


def draw_noise(rng: np.random.Generator, bench: Bench) -> Floats:
    """Noise of all samples (n, 2) in mg, of two cascaded averages (a Bartlett window) of white noise.

    Scaled so that a dwell's mean has exactly the standard deviation `bench.u_mg`.
    """
    d = len(bench.check)
    n = int(bench.starts[1])
    window = np.convolve(np.ones(bench.taps), np.ones(bench.taps)) / bench.taps**2
    weights = np.convolve(np.ones(n), window) / n
    white = rng.normal(size=(d, n + len(window) - 1, 2)) / np.linalg.norm(weights) * bench.u_mg
    spread = np.lib.stride_tricks.sliding_window_view(white, len(window), axis=1)
    return (spread @ window).reshape(-1, 2)
