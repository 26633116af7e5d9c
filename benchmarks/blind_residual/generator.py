"""Blind sessions: a plan, a part, noise and something hidden, written as samples CSV with the truth apart.

Nothing here uses adis_gonio: an error of that package's model would not show in data that it made itself.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .catalogue import NAMES, WITHIN
from .causes import CAUSES, Planted, names_of
from .circumstances import STANDARD_MPS2, Circumstances, Floats, ideal_plane
from .likelihood import Linear, Whitened, linearise, scatter_gain, space_matrix
from .noise import Noise

BINS = ((4.0, 10.0), (10.0, 16.0), (16.0, 30.0), (30.0, 50.0), (50.0, 100.0), (100.0, 400.0))
"""Ladder of the likelihood-ratio gain 2Δ ln L of the true effect."""

FAMILIES = {
    "nothing": 0.12,
    "bias": 0.03,
    "catalogue": 0.25,
    "two": 0.14,
    "within": 0.05,
    "foreign": 0.11,
    "stranger": 0.20,
    "scatter": 0.10,
}
"""Share of each family. Recordings are made apart (recordings.py)."""

LARGEST_MG = 150.0
"""A session in which an effect would have to be larger to gain enough is drawn anew: no bench has it."""


@dataclass
class Truth:
    """What a session hides; never lies where a runner runs.

    Attributes
    ----------
    id, family, kind : str
        Of the session; family as FAMILIES or `recording`; kind the cause's name (two: joined by `+`).
    names : list of str
        Catalogue's names that are right, without the bias.
    covariates : list of list of str
        Groups of words (see causes.py).
    parameters : dict
        Catalogue's amplitudes.
    base : dict
        `delta_k` (1), `delta_phi` (degree), `bias_x`, … (mg).
    target, gain : list of float
        2Δ ln L wanted and realised, of each cause given the other.
    scatter : bool
        Whether no covariate explains what is hidden.
    plane : bool
    fixture_deg, gravity_mg, start_s, samples, rate_hz
        Of the session; start_s (n,) of each dwell.
    noise : list of dict
        Of each axis (noise.Noise).
    circumstances : dict
        The true ones.
    readings_mg : (n, axes) list
        Mean readings as recorded, check dwells too.
    planted : list of dict
        Of each cause what it added: `reading` (n, axes) mg, `angle` (n,) rad; of scatter its covariance.
    since : list of str
        Names that the catalogue has had since for causes that were none of its own: right, not asked for.
    """

    id: str
    family: str
    kind: str
    names: list[str]
    covariates: list[list[str]]
    parameters: dict[str, float]
    base: dict[str, float]
    target: list[float]
    gain: list[float]
    scatter: bool
    plane: bool
    fixture_deg: float
    gravity_mg: float
    start_s: list[float]
    samples: int
    rate_hz: float
    noise: list[dict[str, Any]]
    circumstances: dict[str, Any]
    readings_mg: list[list[float]]
    planted: list[dict[str, Any]] = field(default_factory=list)
    since: list[str] = field(default_factory=list)

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read a truth file."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))

    def save(self, path: Path) -> None:
        """Write it."""
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")

    def problem(self) -> Linear:
        """The session linearised with everything known that the oracle may know."""
        c = circumstances_from(self.circumstances)
        start = np.array(self.start_s)
        noise = _known_covariance(
            c, [Noise(**row) for row in self.noise], start, self.samples, self.rate_hz
        )
        return linearise(
            c, np.array(self.readings_mg), noise, np.radians(self.fixture_deg), self.gravity_mg
        )


def _known_covariance(
    c: Circumstances, noise: list[Noise], start: Floats, m: int, rate_hz: float
) -> list[Floats]:
    """Covariance of the readings of each axis, that of the vibration with it."""
    return [
        x.reading_covariance(start, m, rate_hz) + np.diag(c.variance_mg2[:, i] / m)
        for i, x in enumerate(noise)
    ]


def circumstances_from(plain: dict[str, Any]) -> Circumstances:
    """Circumstances from lists."""
    arrays = {k: np.array(v, dtype=float) for k, v in plain.items() if k not in ("plane", "check")}
    return Circumstances(plane=plain["plane"], check=np.array(plain["check"], dtype=bool), **arrays)


def seed_of(secret: str, number: int) -> int:
    """Seed of a session: SHA-256 of `secret:number`, its first eight bytes."""
    return int.from_bytes(hashlib.sha256(f"{secret}:{number}".encode()).digest()[:8], "big")


def draw(secret: str, number: int, family: str | None = None) -> tuple[str, Truth]:
    """One session.

    Parameters
    ----------
    secret : str
        What all seeds derive from.
    number : int
        Of the session.
    family : str, optional
        One of FAMILIES instead of a draw by their shares.

    Returns
    -------
    csv : str
        Samples CSV with all dwells.
    truth : Truth
    """
    rng = np.random.default_rng(seed_of(secret, number))
    if family is None:
        family = str(
            rng.choice(list(FAMILIES), p=np.array(list(FAMILIES.values())) / sum(FAMILIES.values()))
        )
    for _ in range(200):
        made = _try(rng, family, f"s{number:05d}")
        if made is not None:
            return made
    raise RuntimeError(f"session {number} of {secret!r}: no {family} session came out in 200 draws")


# Plan and surroundings


def _plan_angles(rng: np.random.Generator, n: int, fine: bool) -> Floats:
    style = (
        "random"
        if fine
        else str(rng.choice(["turn", "there_back", "shuffled", "repeated", "turns", "random"]))
    )
    step = 360.0 / max(n if style == "turn" else n // 2, 3)
    if style == "turn":
        angles = np.arange(n) * step
    elif style == "there_back":
        out = np.arange((n + 1) // 2) * 360.0 / max((n + 1) // 2, 3)
        angles = np.concatenate([out, out[::-1]])[:n]
    elif style == "turns":
        angles = np.arange(n) * step
    elif style == "repeated":
        places = rng.choice(24, size=max(6, n // 3), replace=False) * 15.0
        angles = np.resize(places, n)
        if rng.random() < 0.5:
            angles = rng.permutation(angles)
    elif style == "shuffled":
        angles = rng.permutation(np.arange(n) * 360.0 / n)
    else:
        angles = np.round(rng.uniform(0, 360, n), 1)
    return np.radians(angles if style == "turns" else np.mod(angles, 360.0))


def _poses(rng: np.random.Generator, n: int) -> Floats:
    if rng.random() < 0.5:
        vectors = rng.normal(size=(n, 3))
    else:  # faces, edges and corners of a cube, by hand
        grid = np.array(
            [
                (i, j, k)
                for i in (-1, 0, 1)
                for j in (-1, 0, 1)
                for k in (-1, 0, 1)
                if (i, j, k) != (0, 0, 0)
            ]
        )
        order = rng.permutation(len(grid))
        vectors = grid[np.resize(order, n)] + rng.normal(0, 0.05, (n, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def _course(rng: np.random.Generator, time_s: Floats, styles: list[str]) -> Floats:
    """A course between −1 and 1 over the session."""
    u = time_s / time_s[-1]
    style = str(rng.choice(styles))
    if style == "rising":
        x = 1 - np.exp(-u * rng.uniform(0.5, 4))
    elif style == "cycle":
        x = np.sin(2 * np.pi * (u * rng.uniform(0.8, 2.2) + rng.random()))
    elif style == "steps":
        x = rng.uniform(-1, 1, 6)[np.minimum((u * 6).astype(int), 5)] + 0.05 * rng.normal(size=len(u))
    else:
        x = np.cumsum(rng.normal(size=len(u)))
    return (x - x.min()) / max(np.ptp(x), 1e-9) * 2 - 1


def _circumstances(
    rng: np.random.Generator, plane: bool, needs: frozenset[str], length_s: float
) -> tuple[Circumstances, Floats]:
    """What surrounds a session, and when its dwells begin."""
    n = int(rng.integers(12, 49)) if rng.random() < 0.93 else int(rng.integers(49, 73))
    if not plane:
        n = max(n, 20)
    wait = rng.uniform(5, 30) * rng.uniform(0.8, 1.25, n)
    if rng.random() < 0.25:
        wait[rng.integers(1, n)] += rng.uniform(200, 1200)
    start = np.cumsum(wait + length_s)
    start -= start[0]
    time_s = start + length_s / 2 - (start[0] + length_s / 2)
    angle = _plan_angles(rng, n, "fine_angles" in needs) if plane else np.zeros(n)
    temp = supply = np.full(n, np.nan)
    if "temperature" in needs or rng.random() < 0.75:
        temp = (
            25
            + rng.uniform(-3, 6)
            + rng.uniform(1, 8) * _course(rng, time_s, ["rising", "cycle", "steps", "walk"])
        )
    if "supply" in needs or rng.random() < 0.55:
        supply = (
            5
            + rng.uniform(-0.1, 0.1)
            + rng.uniform(0.02, 0.2) * _course(rng, time_s, ["walk", "steps", "cycle"])
        )
    approach = np.zeros(n)
    if plane and ("approach" in needs or rng.random() < 0.7):
        move = np.diff(angle, prepend=angle[0] - 1)
        approach = np.where(move >= 0, 1.0, -1.0)
        if rng.random() < 0.4 or ("approach" in needs and np.ptp(approach) == 0):
            approach = rng.choice([-1.0, 1.0], n)
    elif "approach" in needs:
        approach = rng.choice([-1.0, 1.0], n)
    axes = 2 if plane else 3
    variance = np.zeros((n, axes))
    if "vibration" in needs:
        on = rng.random(n) < 0.5
        variance += np.where(on, rng.uniform(60, 120) ** 2, 0.0)[:, None] * rng.uniform(0.7, 1.3, (n, axes))
    check = np.zeros(n, dtype=bool)
    check[rng.choice(np.arange(1, n - 1), max(2, round(n * 0.2)), replace=False)] = True
    direction = np.zeros((0, 3)) if plane else _poses(rng, n)
    return Circumstances(plane, time_s, angle, temp, supply, approach, variance, check, direction), start


# The hidden cause and its size


def _truth_names(rng: np.random.Generator, family: str, plane: bool) -> list[str]:
    def able(names: list[str]) -> list[str]:
        return [n for n in names if (CAUSES[n].plane if plane else CAUSES[n].space)]

    if family in ("nothing", "bias", "within"):
        return []
    if family == "two":
        return [str(n) for n in rng.choice(able(list(NAMES)), 2, replace=False)]
    return [str(rng.choice(able(names_of(family))))]


def _rows(linear: Linear, planted: Planted) -> Floats:
    return linear.rows(planted.reading[:, :, None], planted.angle[:, None])[:, 0]


def scatter_rows(linear: Linear, planted: Planted) -> Floats:
    """Covariance of the rows that a scatter of size 1 adds, (rows, rows)."""
    n, axes = linear.c.n, linear.c.axes
    stacked = np.zeros((n * axes, n * axes))
    if planted.reading_covariance is not None:
        for i in range(axes):
            here = slice(i * n, (i + 1) * n)
            stacked[here, here] = planted.reading_covariance
    if planted.angle_covariance is not None:
        stacked += linear.tangent @ planted.angle_covariance @ linear.tangent.T
    return linear.to_rows @ stacked @ linear.to_rows.T


def _scatter_size(d: Floats, target: float) -> float:
    """Size A² of a scatter whose expected 2Δ ln L is the target."""
    low, high = 1e-12, 1e12
    for _ in range(200):
        middle = np.sqrt(low * high)
        x = middle * d
        low, high = (middle, high) if np.sum(x - np.log1p(x)) < target else (low, middle)
    return float(low)


def amplitudes(linear: Linear, planted: list[Planted], targets: list[float]) -> list[float] | None:
    """Sizes that give each cause its gain beside the others; None where the session cannot show it."""
    white = Whitened(linear)
    if planted and planted[0].is_scatter:
        d, _ = white.scatter(scatter_rows(linear, planted[0]))
        return [float(np.sqrt(_scatter_size(d, targets[0])))]
    columns = [white.white(_rows(linear, p)[:, None]) for p in planted]
    sizes = []
    for k, column in enumerate(columns):
        others = np.hstack([white.base, *(columns[j] for j in range(len(columns)) if j != k)])
        size = np.linalg.norm(others, axis=0)
        q, s, _ = np.linalg.svd(others / np.where(size > 0, size, 1), full_matrices=False)
        q = q[:, s > 1e-9 * s[0]]
        left = column - q @ (q.T @ column)
        sensitivity = float(np.sum(left**2))
        if sensitivity <= 1e-8 * float(np.sum(column**2)) or not np.isfinite(sensitivity):
            return None
        sizes.append(np.sqrt(targets[k] / sensitivity))
    return sizes


def realised_gains(linear: Linear, planted: list[Planted]) -> list[float]:
    """2Δ ln L of each cause in its true form, beside base model, bias and the other causes."""
    white = Whitened(linear)
    if planted and planted[0].is_scatter:
        d, w2 = white.scatter(scatter_rows(linear, planted[0]))
        return [max(scatter_gain(d, w2, size) for size in np.geomspace(0.05, 20, 61))]
    columns = [_rows(linear, p)[:, None] for p in planted]
    whole = white.gain(np.hstack(columns)) if columns else 0.0
    return [
        whole
        - (white.gain(np.hstack([x for j, x in enumerate(columns) if j != k])) if len(columns) > 1 else 0.0)
        for k in range(len(columns))
    ]


def _draw_noise(rng: np.random.Generator, axes: int) -> tuple[list[Noise], int, float, str]:
    """Noise of the axes, samples a dwell, rate and `accel_unit`."""
    if rng.random() < 0.18:
        u = float(np.round(np.exp(rng.uniform(np.log(0.05), np.log(0.4))), 3))
        return [Noise(0, 1, 0, 0, u) for _ in range(axes)], 1, 1.0, "mg"
    chip = rng.random() < 0.8
    samples = int(rng.integers(100, 321))
    rate = float(rng.choice([819.2, 409.6, 163.84]))
    taps = int(rng.choice([1, 4, 8] if chip else [1]))
    white = 4.7 * rng.uniform(0.6, 1.4) if chip else rng.uniform(0.8, 3)
    flicker = rng.uniform(0.02, 0.10)
    step = 0.4672 if chip else 0.1
    return (
        [Noise(white * rng.uniform(0.9, 1.1), taps, flicker, step) for _ in range(axes)],
        samples,
        rate,
        ("lsb" if chip else "mg"),
    )


def _try(rng: np.random.Generator, family: str, name: str) -> tuple[str, Truth] | None:
    plane = bool(rng.random() < 0.72)
    hidden = _truth_names(rng, family, plane)
    needs = frozenset().union(*(CAUSES[h].needs for h in hidden))
    axes = 2 if plane else 3
    noise, samples, rate, unit = _draw_noise(rng, axes)
    within = ""
    if family == "within" or "vibration" in needs:
        while samples < 2:
            noise, samples, rate, unit = _draw_noise(rng, axes)
        within = str(rng.choice(WITHIN)) if family == "within" else ""
    c, start = _circumstances(rng, plane, needs, samples / rate)
    fixture_deg = float(np.round(np.exp(rng.uniform(np.log(0.002), np.log(0.03))), 4)) if plane else 0.0
    gravity_mps2 = float(np.round(rng.uniform(9.78, 9.83), 5))
    gravity = gravity_mps2 / STANDARD_MPS2 * 1000
    gains = 1 + rng.normal(0, 0.004, axes)
    bias = rng.normal(0, 12, axes)
    if family == "bias":
        bias *= 0
    try:
        ideal, values = _ideal(rng, c, gains, bias)
    except np.linalg.LinAlgError:
        return None
    covariance = _known_covariance(c, noise, start, samples, rate)
    try:
        planted = [CAUSES[h].make(c, ideal, rng) for h in hidden]
    except ValueError:
        return None
    low, high = BINS[rng.integers(len(BINS))]
    targets = [float(np.exp(rng.uniform(np.log(low), np.log(high)))) for _ in hidden] if hidden else []
    clean = _readings(c, ideal, values, gravity, np.zeros(c.n), np.zeros((c.n, axes)))
    exact = linearise(c, clean, covariance, np.radians(fixture_deg), gravity)
    sizes = amplitudes(exact, planted, targets)
    if sizes is None:
        return None
    planted = [_sized(p, s) for p, s in zip(planted, sizes, strict=True)]
    if family == "bias":
        targets, bias, values = _weak_bias(rng, exact, values, low, high)
    turned = np.sum([p.angle for p in planted], axis=0) if planted else np.zeros(c.n)
    added = np.sum([p.reading for p in planted], axis=0) if planted else np.zeros((c.n, axes))
    if np.abs(added).max() > LARGEST_MG or np.abs(turned).max() * 1000 > LARGEST_MG:
        return None
    slack = np.radians(fixture_deg) * rng.normal(size=c.n)
    mean = _readings(c, ideal, values, gravity, turned + slack, added)
    data = mean[:, :, None] + np.stack([x.samples(start, samples, rate, rng) for x in noise], axis=1)
    data += np.sqrt(c.variance_mg2)[:, :, None] * rng.normal(size=data.shape)
    inside: dict[str, float] = {}
    if within:
        data, inside, targets = _within(
            rng, within, data, noise, start, samples, rate, float(rng.uniform(low, high))
        )
        hidden = [within]
    step = noise[0].step_mg
    counts = (
        np.round(data / step)
        if unit == "lsb"
        else np.round(data, 4)
        if step == 0
        else np.round(data / step) * step
    )
    readings = counts.mean(axis=2) * (step if unit == "lsb" else 1.0)
    linear = linearise(c, readings, covariance, np.radians(fixture_deg), gravity)
    gain = (
        list(targets)
        if within
        else [bias_gain(linear)]
        if family == "bias"
        else realised_gains(linear, planted)
    )
    parameters = {k: v for p in planted for k, v in p.parameters.items()} | inside
    catalogued = [h for h in hidden if h in NAMES or h in WITHIN]
    truth = Truth(
        name, family, "+".join(hidden) or family, catalogued,
        [sorted(g) for h in hidden if h in CAUSES for g in CAUSES[h].covariates],
        parameters, _base(c, values, bias), targets, [float(x) for x in gain],
        any(p.is_scatter for p in planted), plane, fixture_deg, gravity, start.tolist(), samples, rate,
        [asdict(x) for x in noise], plain(c), readings.tolist(), [plain_planted(p) for p in planted],
        [CAUSES[h].since for h in hidden if h in CAUSES and CAUSES[h].since],
    )  # fmt: skip
    return _csv(c, counts, start, rate, unit, fixture_deg, gravity_mps2, noise[0].reading_u_mg, rng), truth


def _sized(p: Planted, size: float) -> Planted:
    return Planted(
        p.reading * size,
        p.angle * size,
        {k: v * size for k, v in p.parameters.items()},
        p.detail,
        None if p.reading_covariance is None else p.reading_covariance * size**2,
        None if p.angle_covariance is None else p.angle_covariance * size**2,
    )


def plain_planted(p: Planted) -> dict[str, Any]:
    """What was planted, as lists."""
    return {
        "reading": p.reading.tolist(),
        "angle": p.angle.tolist(),
        "detail": p.detail,
        "reading_covariance": None if p.reading_covariance is None else p.reading_covariance.tolist(),
        "angle_covariance": None if p.angle_covariance is None else p.angle_covariance.tolist(),
    }


def planted_from(plain: dict[str, Any]) -> Planted:
    """What `Truth.planted` holds, as arrays."""
    arrays = {k: None if plain[k] is None else np.array(plain[k]) for k in plain if k != "detail"}
    return Planted(detail=plain["detail"], **arrays)


def plain(c: Circumstances) -> dict[str, Any]:
    """Circumstances as lists."""
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(c).items()}


def _ideal(
    rng: np.random.Generator, c: Circumstances, gains: Floats, bias: Floats
) -> tuple[Floats, Floats]:
    """What the axes should read in g, and the base values in the order of likelihood.py."""
    if c.plane:
        alpha, lean = rng.uniform(-np.pi, np.pi), np.radians(rng.normal(0, 0.25))
        return ideal_plane(alpha - c.angle_rad, lean), np.array([alpha, *gains, lean, *bias])
    return c.direction, np.array([*gains, *np.radians(rng.normal(0, 0.25, 3)), *bias])


def _readings(
    c: Circumstances, ideal: Floats, values: Floats, g: float, turn: Floats, added: Floats
) -> Floats:
    """Mean readings in mg at true angles turned by `turn` (rad), with `added` (mg)."""
    if c.plane:
        alpha, kx, ky, lean, bx, by = values
        return g * ideal_plane(alpha - c.angle_rad + turn, lean) * [kx, ky] + [bx, by] + added
    return g * ideal @ space_matrix(values).T + values[6:] + added


def _base(c: Circumstances, values: Floats, bias: Floats) -> dict[str, float]:
    out = {f"bias_{letter}": float(b) for letter, b in zip("xyz", bias, strict=False)}
    if c.plane:
        out["delta_k"] = float(values[1] / values[2] - 1)
        out["delta_phi"] = float(np.degrees(values[3]))
    return out


def _bias_columns(linear: Linear) -> tuple[np.ndarray, np.ndarray]:
    """Whitened base columns without the bias, and those of the bias."""
    white = Whitened(linear)
    is_bias = np.array([name.startswith("bias") for name in linear.names])
    q = np.linalg.qr(white.base[:, ~is_bias])[0]
    columns = white.base[:, is_bias]
    return q, columns - q @ (q.T @ columns)


def _weak_bias(
    rng: np.random.Generator, linear: Linear, values: Floats, low: float, high: float
) -> tuple[list[float], Floats, Floats]:
    _, left = _bias_columns(linear)
    direction = rng.normal(size=left.shape[1])
    target = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    bias = direction * np.sqrt(target / np.sum((left @ direction) ** 2))
    values = values.copy()
    values[-len(bias) :] = bias
    return [target], bias, values


def bias_gain(linear: Linear) -> float:
    """2Δ ln L of the bias that was fitted."""
    _, left = _bias_columns(linear)
    fitted = linear.values[[name.startswith("bias") for name in linear.names]]
    return float(np.sum((left @ fitted) ** 2))


# Effects within the dwells


def _within(
    rng: np.random.Generator, name: str, data: Floats, noise: list[Noise], start: Floats, m: int, rate:
    float, target: float,
) -> tuple[Floats, dict[str, float], list[float]]:  # fmt: skip
    """Samples (n, axes, m) with an effect that shows within the dwells; its parameters and gain."""
    n = len(data)
    t = np.arange(m) / rate
    letter, i = "xyz"[(j := int(rng.integers(data.shape[1])))], j
    data = data.copy()
    if name == "saturation":
        limit = float(np.quantile(np.abs(data), rng.uniform(0.75, 0.95)))
        return np.clip(data, -limit, limit), {"limit": limit}, [999.0]
    if name == "quantization":
        lsb = float(noise[0].white_mg * rng.uniform(2, 5))
        if noise[0].step_mg:  # a converter that lost its low bits
            lsb = noise[0].step_mg * round(lsb / noise[0].step_mg)
        return np.round(data / lsb) * lsb, {"lsb": lsb}, [999.0]
    covariance = noise[i].sample_covariance(m)
    centre = np.eye(m) - 1 / m
    inverse = centre @ np.linalg.pinv(centre @ covariance @ centre, hermitian=True) @ centre
    if name == "noise_change":
        begin = float(start[0] + (start[-1] - start[0]) * rng.uniform(0.3, 0.7))
        late = int(np.sum(start >= begin))
        d = np.linalg.eigvalsh(inverse)
        d = np.concatenate([np.maximum(d, 0)] * late)
        extra = float(np.sqrt(_scatter_size(d, target)))
        data[start >= begin, i] += rng.normal(0, extra, (late, m))
        return data, {f"extra_{letter}": extra, "start": begin}, [target]
    if name == "tone":
        frequency, phase = rng.uniform(3 / (m / rate), rate / 4), rng.uniform(0, 360)
        shape = np.sin(2 * np.pi * frequency * (start[:, None] + t) + np.radians(phase))
        parameters = {"frequency": frequency, "phase": phase}
    else:
        tau = rng.uniform(0.05, 0.5) * m / rate
        shape = np.tile(np.exp(-t / tau), (n, 1))
        parameters = {"tau": tau}
    size = float(np.sqrt(target / np.einsum("ki,ij,kj->", shape, inverse, shape)))
    data[:, i] += size * shape
    return data, parameters | {f"{name}_{letter}": size}, [target]


# The file


def _csv(
    c: Circumstances, counts: Floats, start: Floats, rate: float, unit: str, fixture_deg: float,
    gravity_mps2: float, reading_u_mg: float, rng: np.random.Generator,
) -> str:  # fmt: skip
    head = [
        f"# sensor: {'adis16354' if unit == 'lsb' else 'generic'}",
        f"# gravity_mps2: {gravity_mps2}",
        f"# plane: {'xy' if c.plane else 'none'}",
        f"# fixture_sigma_deg: {fixture_deg if c.plane else 'free'}",
        f"# accel_unit: {unit}",
    ]
    if reading_u_mg:
        head.append(f"# reading_u_mg: {reading_u_mg}")
    columns = ["time_s", "position", "angle_deg"]
    use = {"approach": bool(np.any(c.approach)), "temp_c": not np.isnan(c.temp_c).any()}
    use["supply_v"] = not np.isnan(c.supply_v).any()
    columns += ["approach"] if use["approach"] else []
    columns += ["ax", "ay", "az"][: c.axes]
    columns += [name for name in ("temp_c", "supply_v") if use[name]]
    columns += ["use"]
    lines = [*head, ",".join(columns)]
    m = counts.shape[2]
    number = "%.0f" if unit == "lsb" else "%.4f"
    for k in range(c.n):
        angle = f"{np.degrees(c.angle_rad[k]):.6g}" if c.plane else ""
        before = [str(k), angle] + ([f"{int(c.approach[k]):+d}"] if use["approach"] else [])
        temps = c.temp_c[k] + 0.02 * rng.normal(size=m) if use["temp_c"] else None
        volts = c.supply_v[k] + 0.0005 * rng.normal(size=m) if use["supply_v"] else None
        for j in range(m):
            row = [f"{start[k] + j / rate:.6f}", *before]
            row += [number % counts[k, i, j] for i in range(c.axes)]
            if temps is not None:
                row.append(f"{temps[j]:.4f}")
            if volts is not None:
                row.append(f"{volts[j]:.4f}")
            row.append("check" if c.check[k] else "fit")
            lines.append(",".join(row))
    return "\n".join(lines) + "\n"
