"""Blind sessions of three gyros: what they hide, the samples, and whether a trace says it.

The physics is written here from the convention (docs/gyros.md), not taken from the package: dwells of hand-
placed attitudes in space, and on a table dwells with whole turns about the vertical between them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
KINDS = ("none", "one", "two", "uncatalogued")
RATE_HZ = 100.0
MARK_DEG = 0.1
"""Standard deviation of the place to which the part is set back after a whole turn."""
TELLABLE = 9.0
"""Noncentrality below which two causes are the same to a session: three standard uncertainties."""
SIZE_U = (4.0, 12.0)
"""What a cause adds, rms over the rows that it touches beside the zero rates, in u of a reading."""


@dataclass(frozen=True)
class Rows:
    """What surrounds n rows: samples, or the intervals of a session."""

    time_s: Floats
    number: Floats
    temperature_c: Floats
    supply_v: Floats
    force_g: Floats
    rate_dps: Floats
    turn: NDArray[np.bool_]
    middle: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the session: medians of its times, temperatures and supplies."""


Basis = Callable[[Rows, int], Floats]
"""Columns (n, q) that a cause has on a gyro."""


def _column(get: Callable[[Rows, int], Floats]) -> Basis:
    return lambda rows, gyro: get(rows, gyro)[:, None]


def _leans(rows: Rows, gyro: int) -> Floats:
    return np.radians(rows.rate_dps[:, [k for k in range(3) if k != gyro]])


NAMED: dict[str, tuple[Basis, bool]] = {
    "g_sensitivity": (lambda rows, gyro: rows.force_g, False),
    "g2_sensitivity": (_column(lambda rows, gyro: rows.force_g[:, 2] ** 2), False),
    "gyro_bias_temperature": (_column(lambda rows, gyro: rows.temperature_c - 25), False),
    "gyro_drift": (_column(lambda rows, gyro: rows.time_s / 60), False),
    "gyro_warm_up": (_column(lambda rows, gyro: np.exp(-rows.time_s / 200)), False),
    "gyro_supply": (_column(lambda rows, gyro: rows.supply_v - 5), False),
    "outlier_dwell": (_column(lambda rows, gyro: (rows.number == 7) * 1.0), False),
    "gyro_scale": (_column(lambda rows, gyro: rows.rate_dps[:, gyro]), True),
    "gyro_misalignment": (_leans, True),
    "gyro_asymmetry": (_column(lambda rows, gyro: np.abs(rows.rate_dps[:, gyro])), True),
    "gyro_scale_temperature": (
        _column(lambda rows, gyro: 1e-6 * (rows.temperature_c - 25) * rows.rate_dps[:, gyro]),
        True,
    ),
}
"""Causes of the catalogue, and whether only turns show them."""
PARAMETERS = {
    "g_sensitivity": ("g_sensitivity_{}x", "g_sensitivity_{}y", "g_sensitivity_{}z"),
    "g2_sensitivity": ("g2_sensitivity_{}z",),
    "gyro_bias_temperature": ("gyro_bias_temperature_{}",),
    "gyro_drift": ("gyro_drift_{}",),
    "gyro_warm_up": ("gyro_warm_up_{}",),
    "gyro_supply": ("gyro_supply_{}",),
    "outlier_dwell": ("offset_{}",),
    "gyro_scale": ("gyro_scale_error_{}",),
    "gyro_misalignment": ("gyro_misalignment_{}{}", "gyro_misalignment_{}{}"),
    "gyro_asymmetry": ("gyro_asymmetry_{}",),
    "gyro_scale_temperature": ("gyro_scale_temperature_{}",),
}
NAMELESS: dict[str, tuple[Basis, tuple[str, ...]]] = {
    "a step in time": (_column(lambda rows, gyro: (rows.time_s > rows.middle[0]) * 1.0), ("time",)),
    "an oscillation in time": (
        _column(lambda rows, gyro: np.sin(np.pi * 1.7 * rows.time_s / rows.middle[0])), ("time",)
    ),
    "a product of forces": (
        _column(lambda rows, gyro: rows.force_g[:, 0] * rows.force_g[:, 1]), ("force",)
    ),
    "the modulus of a force": (_column(lambda rows, gyro: np.abs(rows.force_g[:, 1])), ("force",)),
    "the cube of a force": (_column(lambda rows, gyro: rows.force_g[:, 0] ** 3), ("force",)),
    "a knee in temperature": (
        _column(lambda rows, gyro: np.maximum(rows.temperature_c - rows.middle[1], 0.0)),
        ("temperature",),
    ),
    "a step in the supply": (
        _column(lambda rows, gyro: (rows.supply_v > rows.middle[2]) * 1.0), ("supply",)
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """Something hidden: its name, the gyros that have it, and amplitudes (gyros, q)."""

    name: str
    basis: Basis
    gyros: tuple[int, ...]
    amplitudes: Floats
    covariates: tuple[str, ...] = ()

    def added(self, rows: Rows) -> Floats:
        """What it adds (n, 3) in °/s."""
        out = np.zeros((len(rows.time_s), 3))
        for gyro, own in zip(self.gyros, self.amplitudes, strict=True):
            out[:, gyro] = self.basis(rows, gyro) @ own
        return out


@dataclass(frozen=True)
class Blind:
    """A session with what it hides."""

    kind: str
    causes: tuple[Cause, ...]
    zero_dps: Floats
    rows: Rows
    u_dps: Floats
    check: NDArray[np.bool_]
    session: Any = field(repr=False)

    @property
    def names(self) -> set[str]:
        """Names of the catalogue that were put in."""
        return {cause.name for cause in self.causes if cause.name in NAMED}


def draw(kind: str, seed: int, index: int) -> Blind:
    """A session of a kind: `none`, `one`, `two` or `uncatalogued`."""
    rng = np.random.default_rng([seed, KINDS.index(kind), index])
    table = bool(index % 2)
    rows, lengths = _bench(rng, table)
    noise = float(rng.uniform(0.1, 0.4))
    counts = np.round(lengths * RATE_HZ)
    u = noise / np.sqrt(counts)
    mark = np.where(rows.turn, MARK_DEG * np.sqrt(2) / lengths, 0.0)
    reading_u = np.hypot(u, mark)
    causes = _causes(rng, kind, rows, reading_u, table)
    zero = rng.normal(0, 1.0, 3)
    check = np.zeros(len(counts), dtype=bool)
    if not table:
        check[rng.choice(np.arange(8, len(counts)), len(counts) // 5, replace=False)] = True
    session = _session(rng, rows, lengths, noise, zero, causes, check)
    return Blind(kind, causes, zero, rows, reading_u, check, session)


def _bench(rng: np.random.Generator, table: bool) -> tuple[Rows, Floats]:
    """Rows of the intervals and their lengths in s."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])[rng.permutation(6)]
    if table:
        # Edges besides: six faces alone do not show the skews of the accelerometers.
        edges = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1]]) / np.sqrt(2)
        faces = np.concatenate([faces, edges])[rng.permutation(9)]
        up = np.repeat(faces, 3, axis=0)
        turn = np.tile([False, True, False], 9)
        sense = np.where(turn, np.repeat(rng.choice([-1.0, 1.0], 9), 3), 0.0)
        length = np.where(turn, rng.uniform(5, 9, len(turn)), rng.uniform(8, 15))
    else:
        more = rng.normal(size=(int(rng.integers(9, 25)), 3))
        up = np.concatenate([faces, more])[rng.permutation(6 + len(more))]
        turn, sense = np.zeros(len(up), dtype=bool), np.zeros(len(up))
        length = np.full(len(up), rng.uniform(8, 20))
    lean = rng.normal(0, 0.03, (9 if table else len(up), 3))
    up = up + (np.repeat(lean, 3, axis=0) if table else lean)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    length = np.round(length * RATE_HZ) / RATE_HZ
    last = np.arange(len(up)) % 3 == 2 if table else np.ones(len(up), dtype=bool)
    gap = np.where(last, rng.uniform(3, 20, len(up)), 0.0)
    start = np.concatenate([[0.0], np.cumsum(length + gap)[:-1]])
    time = start + length / 2
    time -= time[0]  # as the trace counts it: from the middle of the first interval
    number = np.cumsum(~turn) - 1.0
    span = time[-1]
    temperature = 30 + 6 * np.sin(2 * np.pi * rng.uniform(0.8, 1.6) * time / span + rng.uniform(0, 6))
    temperature += rng.normal(0, 0.5, len(time))
    supply = 5 + 0.1 * rng.normal(size=len(time))
    rate = np.where(turn, sense * 360 / length, 0.0)[:, None] * up
    middle = (float(np.median(time)), float(np.median(temperature)), float(np.median(supply)))
    return Rows(time, np.where(turn, -1.0, number), temperature, supply, -up, rate, turn, middle), length


def _causes(rng: np.random.Generator, kind: str, rows: Rows, u: Floats, table: bool) -> tuple[Cause, ...]:
    if kind == "uncatalogued":
        name = str(rng.choice(list(NAMELESS)))
        basis, covariates = NAMELESS[name]
        return (_sized(rng, name, basis, rows, u, covariates),)
    count = {"none": 0, "one": 1, "two": 2}[kind]
    possible = [name for name, (_, turned) in NAMED.items() if table or not turned]
    chosen = rng.choice(possible, count, replace=False)
    return tuple(_sized(rng, str(name), NAMED[str(name)][0], rows, u) for name in chosen)


def _sized(
    rng: np.random.Generator,
    name: str,
    basis: Basis,
    rows: Rows,
    u: Floats,
    covariates: tuple[str, ...] = (),
) -> Cause:
    """Amplitudes at which a gyro shows the cause, beside its zero rate, by `SIZE_U`."""
    gyros = tuple(sorted(rng.choice(3, int(rng.integers(1, 4)), replace=False).tolist()))
    amplitudes = []
    for gyro in gyros:
        columns = basis(rows, gyro)
        size = np.linalg.norm(beside_constant(columns, u), axis=0)
        touched = max((np.abs(columns).max(axis=1) > 0).sum(), 1)
        alone = name == "outlier_dwell"
        wanted = rng.uniform(*SIZE_U) * np.sqrt(4.0 if alone else touched)
        direction = rng.normal(size=columns.shape[1])
        direction /= np.linalg.norm(direction)
        amplitudes.append(wanted * direction / np.maximum(size, 1e-12))
    return Cause(name, basis, gyros, np.array(amplitudes), covariates)


def beside_constant(columns: Floats, u: Floats) -> Floats:
    """Columns (n, q) in u of the readings, off the zero rate."""
    white = columns / u[:, None]
    one = 1 / u / np.linalg.norm(1 / u)
    return white - np.outer(one, one @ white)


def _session(
    rng: np.random.Generator,
    rows: Rows,
    lengths: Floats,
    noise: float,
    zero: Floats,
    causes: Sequence[Cause],
    check: NDArray[np.bool_],
) -> Any:
    """The samples, as the package takes a session that somebody else has read."""
    from adis_gonio.model import Dwell, Session
    from adis_gonio.model.records import Turn

    dwells, turns = [], []
    number = -1
    for k, length in enumerate(lengths):
        n = round(length * RATE_HZ)
        time = rows.time_s[k] + (lengths[0] - length) / 2 + np.arange(n) / RATE_HZ
        around = _samples(rows, k, time - lengths[0] / 2)
        if rows.turn[k]:
            profile = 1 - np.cos(2 * np.pi * (np.arange(n) + 0.5) / n)
            profile *= 1 + 0.2 * np.sin(2 * np.pi * 3 * (np.arange(n) + 0.5) / n)
            profile /= profile.mean()
            off = rng.normal(0, MARK_DEG * np.sqrt(2))
            size = np.linalg.norm(rows.rate_dps[k])
            turned = size + off / length
            around = Rows(
                **{**vars(around), "rate_dps": profile[:, None] * rows.rate_dps[k] * turned / size}
            )
        gyro = around.rate_dps + zero + sum((c.added(around) for c in causes), np.zeros((n, 3)))
        gyro = gyro + rng.normal(0, noise, (n, 3))
        accel = 1000 * around.force_g + rng.normal(0, 2.0, (n, 3))
        inside = {"temperature_c": around.temperature_c, "supply_v": around.supply_v}
        if rows.turn[k]:
            sense = np.sign(rows.rate_dps[k] @ -rows.force_g[k])
            turns.append(Turn(number, number + 1, time, accel, gyro, **inside, turned_deg=360.0 * sense))
            continue
        number += 1
        use = "check" if check[k] else "fit"
        dwells.append(Dwell(number, time, accel, gyro=gyro, use=use, **inside))
    return Session(
        tuple(dwells),
        sensor="generic",
        accel_unit="mg",
        fixture_sigma_deg=float("inf"),
        plane="none",
        turns_from=lambda: tuple(turns),
    )


def _samples(rows: Rows, k: int, time: Floats) -> Rows:
    n = len(time)
    return Rows(
        time,
        np.full(n, rows.number[k]),
        np.full(n, rows.temperature_c[k]),
        np.full(n, rows.supply_v[k]),
        np.tile(rows.force_g[k], (n, 1)),
        np.tile(rows.rate_dps[k], (n, 1)),
        np.full(n, rows.turn[k]),
        rows.middle,
    )


# -- judging ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """What a trace said of a session, judged."""

    kind: str
    truth: tuple[str, ...]
    claimed: tuple[str, ...]
    found: bool
    exact: bool
    wrong: tuple[str, ...]
    covariate: bool
    said: str
    ratio: float
    covered: tuple[tuple[str, bool], ...]
    seconds: float = 0.0


def answer_of(blind: Blind) -> dict[str, Any]:
    """The product's answer as its JSON says it."""
    from adis_gonio.tracing.trace import trace

    result: dict[str, Any] = json.loads(json.dumps(trace(blind.session, part="gyro").as_dict()))
    return result


def judge(blind: Blind, answer: Mapping[str, Any], seconds: float = 0.0) -> Verdict:
    """Judge the JSON of `trace --sensor-part gyro`."""
    claimed = tuple(entry["effect"] for entry in answer["found"])
    unnamed = answer["unnamed"]
    groups = [set(group) for group in answer["confounded"]]
    found = all(
        cause.name in claimed or any(cause.name in g and g & set(claimed) for g in groups) or
        _stands_in(blind, cause, claimed)
        for cause in blind.causes if cause.name in NAMED
    )  # fmt: skip
    wrong = tuple(n for n in claimed if n not in blind.names and not _innocent(blind, n))
    exact = found and not wrong and unnamed is None and len(claimed) <= len(blind.causes)
    said = [] if unnamed is None else list(unnamed["covariates"])
    covariate = any(
        re.match(wanted, word) is not None
        for cause in blind.causes
        for wanted in cause.covariates
        for word in said
    )
    return Verdict(
        blind.kind,
        tuple(cause.name for cause in blind.causes),
        claimed,
        found,
        exact,
        wrong,
        covariate,
        "" if unnamed is None else unnamed["form"],
        _ratio(blind, answer),
        _coverage(blind, answer, claimed),
        seconds,
    )


def _unexplained(blind: Blind, cause: Cause, names: Sequence[str]) -> float:
    """Noncentrality of a cause that some names and the other causes cannot add."""
    total = 0.0
    for gyro, own in zip(cause.gyros, cause.amplitudes, strict=True):
        target = beside_constant((cause.basis(blind.rows, gyro) @ own)[:, None], blind.u_dps)[:, 0]
        beside = [NAMED[name][0](blind.rows, gyro) for name in names if name in NAMED]
        beside += [other.basis(blind.rows, gyro) for other in blind.causes if other is not cause]
        if beside:
            columns = beside_constant(np.concatenate(beside, axis=1), blind.u_dps)
            size = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
            solved = np.linalg.lstsq(columns / size, target, rcond=1e-9)[0]
            target = target - columns / size @ solved
        total += float(target @ target)
    return total


def _stands_in(blind: Blind, cause: Cause, claimed: Sequence[str]) -> bool:
    return bool(claimed) and _unexplained(blind, cause, claimed) < TELLABLE


def _innocent(blind: Blind, name: str) -> bool:
    """True where a name could stand in for one of the causes to within what the session tells."""
    return any(_unexplained(blind, cause, [name]) < TELLABLE for cause in blind.causes)


def _coverage(
    blind: Blind, answer: Mapping[str, Any], claimed: Sequence[str]
) -> tuple[tuple[str, bool], ...]:
    """Parameters of a single cause that was found alone, and whether 95 % intervals hold the truth."""
    if len(blind.causes) != 1 or tuple(claimed) != (blind.causes[0].name,):
        return ()
    cause, entry = blind.causes[0], answer["found"][0]
    stated = entry["parameters"]
    out = []
    for gyro, own in zip(cause.gyros, cause.amplitudes, strict=True):
        letter = "xyz"[gyro]
        others = [axis for axis in "xyz" if axis != letter]
        for k, pattern in enumerate(PARAMETERS[cause.name]):
            value = stated.get(pattern.format(letter, others[k % 2]))
            if value is not None and value["U"]:
                out.append((cause.name, abs(value["value"] - own[k]) <= value["U"]))
    return tuple(out)


def _ratio(blind: Blind, answer: Mapping[str, Any]) -> float:
    """Held-out error over that of the oracle, which knows the columns; NaN without check dwells."""
    after = answer["error"]["after"]["heldout_rms_dps"]
    if not blind.check.any() or after is None:
        return float("nan")
    mean = np.array([dwell.gyro.mean(axis=0) for dwell in blind.session.dwells])
    kept, left = ~blind.check, []
    for gyro in range(3):
        columns = [np.ones((len(mean), 1))]
        columns += [c.basis(blind.rows, gyro) for c in blind.causes if gyro in c.gyros]
        design = np.concatenate(columns, axis=1)
        size = np.maximum(np.abs(design).max(axis=0), 1e-12)
        solved = np.linalg.lstsq((design / size)[kept], mean[kept, gyro], rcond=1e-9)[0]
        left.append((mean[:, gyro] - design / size @ solved)[~kept])
    return float(after / np.sqrt(np.mean(np.square(left))))
