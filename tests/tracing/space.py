"""Blind sessions in space: attitudes free, so that only the norm of a reading tells anything.

The counterpart of `tracing.blind`, `tracing.plans` and `tracing.lens`: 14 to 40 poses on the sphere, in no
plane and at no declared angle. Own physics in numpy; nothing here imports the product.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracing.blind import FOREIGN, KINDS, SEEN, SIZES, Blind, believable
from tracing.lens import remainder
from tracing.named_truth import Term, alternatives, draw_named
from tracing.plans import G_MG, Floats, Rows, course, draw_zero
from tracing.undeclared import BEYOND, GRAMMAR

SPACE = "space "
"""Mark of a kind of session in space."""
NAMES = (
    "quadratic",
    "cubic",
    "asymmetry",
    "bias_temperature",
    "scale_temperature",
    "bias_drift",
    "supply_bias",
    "scale_drift",
    "supply_scale",
    "creep",
    "warm_up",
    "thermal_lag",
    "outlier_dwell",
)
"""Names of the catalogue that the norm can show and of which the planar sessions have the physics."""
CROSS = ("cross_axis", "cross_quadratic")
FOREIGN_TERMS = (
    "bias_jump",
    "temperature_knee",
    "supply_times_temperature",
    "supply_square",
    "gain_jump",
    "drift_knee",
    "gain_temperature_knee",
)
BEYOND_TERMS = (
    "smooth_of_temperature",
    "smooth_of_time",
    "chirp_of_time",
    "resonance_in_temperature",
    "window_of_time",
    "supply_dropout",
    "gain_wanders",
)
AXES = ("x", "y", "z", "xyz")


@dataclass(frozen=True)
class SpaceBench:
    """Poses as they were measured.

    Attributes
    ----------
    samples, dwells : Rows
        Covariates of the samples, and means of the dwells.
    starts : (d + 1,) int
    check : (d,) bool
    unit : (d, 3) float
        Directions of gravity in the frame of the part.
    matrix : (3, 3) float
        Gains and skews, lower triangular.
    zero_mg : (3,) float
        Zeros of the axes.
    u_mg : (3,) float
        Standard uncertainty of a reading.
    """

    samples: Rows
    dwells: Rows
    starts: NDArray[np.int64]
    check: NDArray[np.bool_]
    unit: Floats
    matrix: Floats
    zero_mg: Floats
    u_mg: Floats
    has_surroundings: bool
    setting: str
    fixture_deg: float = np.inf
    has_approach: bool = False

    @property
    def ideal_mg(self) -> Floats:
        """Readings (d, 3) of the base model."""
        return G_MG * self.unit @ self.matrix.T

    def mean(self, values: Floats) -> Floats:
        """Means by dwell of (n, 3) samples."""
        return np.add.reduceat(values, self.starts[:-1], axis=0) / np.diff(self.starts)[:, None]


def _poses(rng: np.random.Generator) -> Floats:
    """Directions (d, 3): faces, edges and corners set down by hand, or anywhere on the sphere."""
    d = int(rng.integers(14, 41))
    grid = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T
    grid = grid[np.abs(grid).sum(axis=1) > 0].astype(float)
    if rng.random() < 0.5:
        faces = grid[np.abs(grid).sum(axis=1) == 1]
        others = grid[rng.integers(0, len(grid), d - len(faces))]
        poses = np.concatenate([faces, others])
        poses = poses / np.linalg.norm(poses, axis=1, keepdims=True) + rng.normal(0, 0.03, poses.shape)
    else:
        poses = rng.normal(size=(d, 3))
    if rng.random() < 0.7:
        rng.shuffle(poses)
    return poses / np.linalg.norm(poses, axis=1, keepdims=True)


def draw_space(rng: np.random.Generator) -> SpaceBench:
    """One round of poses with its surroundings, noise and hidden base parameters."""
    unit = _poses(rng)
    check = np.zeros(len(unit), bool)
    if rng.random() < 0.5:
        extra = rng.normal(size=(max(6, len(unit) // 4), 3))
        places = np.sort(rng.integers(1, len(unit) + 1, len(extra)))
        unit = np.insert(unit, places, extra / np.linalg.norm(extra, axis=1, keepdims=True), axis=0)
        check = np.insert(check, places, True)
    d, per_dwell = len(unit), int(rng.integers(50, 101))
    step = rng.uniform(0.08, 0.35)
    begin = np.cumsum(rng.uniform(5, 40, d)) + np.arange(d) * per_dwell * step
    time = np.round((begin[:, None] - begin[0] + np.arange(per_dwell) * step).ravel(), 4)
    index = np.repeat(np.arange(d), per_dwell)
    thermal = str(rng.choice(["cycling", "rising", "wandering", "cycling", "still"]))
    temperature = np.round(rng.uniform(18, 34) + rng.uniform(3, 12) * course(rng, time, thermal), 3)
    electric = str(rng.choice(["switched", "wandering", "cycling", "still"]))
    supply = np.round(rng.uniform(4.95, 5.05) + rng.uniform(0.05, 0.2) * course(rng, time, electric), 4)
    none = np.zeros(len(time))
    matrix = np.diag(1 + rng.normal(0, 0.01, 3)) + np.tril(np.deg2rad(rng.normal(0, 0.4, (3, 3))), -1)
    history, loads = (time, temperature), G_MG * (unit @ matrix.T)[index]
    samples = Rows(time, none, none, none, index.astype(float), temperature, supply, history, loads)
    starts = np.arange(d + 1) * per_dwell

    def mean(values: Floats) -> Floats:
        return np.add.reduceat(values, starts[:-1]) / per_dwell

    still = np.zeros(d)
    dwells = Rows(
        mean(time),
        still,
        still,
        still,
        np.arange(float(d)),
        mean(temperature),
        mean(supply),
        samples.history,
        samples.loads,
    )
    return SpaceBench(
        samples,
        dwells,
        starts,
        check,
        unit,
        matrix,
        draw_zero(rng, 3),
        u_mg=rng.uniform(0.05, 0.3) * rng.uniform(0.8, 1.25, 3),
        has_surroundings=bool(rng.random() < 0.9),
        setting=f"{d - check.sum()} poses, temperature {thermal}, supply {electric}",
    )


class SpaceLens:
    """Norms of the readings in `use`, whitened and past the base model; as `tracing.lens.Lens`."""

    def __init__(self, bench: SpaceBench, use: NDArray[np.bool_] | None = None) -> None:
        self.bench = bench
        fit = ~bench.check if use is None else use
        fields = [f for f in Rows.__dataclass_fields__ if f not in {"history", "loads"}]
        whole = {"history": bench.dwells.history, "loads": bench.dwells.loads}
        self.rows = Rows(*(getattr(bench.dwells, f)[fit] for f in fields), **whole)
        self.ideal = bench.ideal_mg[fit]
        # The normal of the ellipsoid on which the ideal readings lie, in the whitened space.
        normal = np.linalg.solve(bench.matrix.T, bench.unit[fit].T).T * bench.u_mg
        self.row = normal / np.linalg.norm(normal, axis=1, keepdims=True) / bench.u_mg
        pairs = np.tril_indices(3)
        base = np.zeros((9, len(self.ideal), 3))
        base[6:] = np.eye(3)[:, None]
        for k, (i, j) in enumerate(zip(*pairs, strict=True)):
            base[k, :, i] = G_MG * bench.unit[fit, j]
        self.base_rows = self.whiten(base)
        self.base = np.linalg.qr(self.base_rows.T)[0]

    def whiten(self, columns_mg: Floats) -> Floats:
        """From (k, n, 3) in mg to (k, n) in standard uncertainties of the norm."""
        return np.einsum("nj,knj->kn", self.row, columns_mg)

    def columns(self, term: Term) -> Floats:
        """Whitened columns (k, n) of a term past the base model."""
        columns = self.whiten(term.basis(self.rows, self.ideal))
        return columns - (columns @ self.base) @ self.base.T

    def contribution(self, term: Term) -> Floats:
        """Whitened contribution (n,) of a term past the base model."""
        return term.coefficients @ self.columns(term)

    def peak(self, term: Term) -> float:
        """Largest contribution to a dwell past the base model, in standard uncertainties of its norm."""
        return float(np.abs(self.contribution(term)).max())

    def unexplained(self, target: Floats, columns: Iterable[Floats]) -> float:
        """Noncentrality of `target` (n,) that the columns leave."""
        return float(np.sum(remainder(target, list(columns)) ** 2))

    def unexplained_by_names(
        self, target: Floats, names: Iterable[str], beside: Iterable[Floats] = ()
    ) -> float:
        """The same for catalogue names, each with the time constant, dwell or degree that suits best."""
        taken = list(beside)
        for terms in sorted((_alternatives(name, self.rows) for name in names), key=len):
            tried = [self.columns(term) for term in terms]
            left = [np.sum(remainder(target, [*taken, columns]) ** 2) for columns in tried]
            taken.append(tried[int(np.argmin(left))])
        return float(np.sum(remainder(target, taken) ** 2))


def _alternatives(name: str, rows: Rows) -> list[Term]:
    """All that a name could mean in space."""
    if name not in CROSS:
        return alternatives(name, rows, "xyz")

    def basis(r: Rows, a: Floats) -> Floats:
        out = []
        for i in range(3):
            for p in {0, 1, 2} - {i}:
                drive = a[:, i] * a[:, p] * 1e-6 if name == "cross_axis" else (a[:, p] / 1000) ** 2
                out.append(np.eye(3)[i] * drive[:, None])
        return np.array(out)

    return [Term(name, basis, np.ones(6))]


def draw(kind: str, seed: int, index: int) -> tuple[Blind, Floats]:
    """Session number `index` of a kind ("space …") with its samples (n, 3) in mg."""
    plain = kind.removeprefix(SPACE)
    key = (seed, 100 + KINDS.index(plain), index)
    rng = np.random.default_rng(key)
    for _ in range(3000):
        bench = draw_space(rng)
        terms = _draw_terms(plain, index, rng, bench)
        if terms is not None:
            break
    else:
        raise RuntimeError(f"no session of kind {kind} shows effect {index}")
    samples = _measure(bench, terms, rng)
    undeclared = plain in {"uncatalogued", "beyond"}
    return Blind(plain, key, bench, terms, undeclared, bench.mean(samples)), samples


def _draw_terms(
    kind: str, index: int, rng: np.random.Generator, bench: SpaceBench
) -> tuple[Term, ...] | None:
    """Terms of a session that these poses can show, or None."""
    if kind == "none":
        return ()
    lens = SpaceLens(bench)
    rows, check = bench.dwells, bench.check
    if kind == "one":
        drawn = [draw_named(rng, NAMES[index % len(NAMES)], rows, check, AXES)]
    elif kind == "two":
        drawn = [draw_named(rng, str(n), rows, check, AXES) for n in rng.choice(NAMES, 2, replace=False)]
    else:
        names, shapes = (FOREIGN_TERMS, GRAMMAR) if kind == "uncatalogued" else (BEYOND_TERMS, BEYOND)
        drawn = [shapes[names[index % len(names)]](rng, rows)]
    if not bench.has_surroundings and any("surroundings" in term.needs for term in drawn):
        return None
    sized = []
    for term in drawn:
        peak = lens.peak(term)
        if not peak > 1e-9:
            return None
        sized.append(term.scaled(rng.uniform(*SIZES) / peak))
    if not believable(sized):
        return None
    for k, term in enumerate(sized):
        others = [lens.columns(other) for j, other in enumerate(sized) if j != k]
        if lens.unexplained(lens.contribution(term), others) < SEEN:
            return None
    if kind in {"uncatalogued", "beyond"}:
        target = lens.contribution(sized[0])
        if any(lens.unexplained_by_names(target, [name]) < FOREIGN for name in (*NAMES, *CROSS)):
            return None
    return tuple(sized)


def _measure(bench: SpaceBench, terms: tuple[Term, ...], rng: np.random.Generator) -> Floats:
    """Samples (n, 3) in mg: base model, zeros, terms, white noise."""
    count = np.diff(bench.starts)
    ideal = np.repeat(bench.ideal_mg, count, axis=0)
    readings = ideal + sum((term.value(bench.samples, ideal) for term in terms), bench.zero_mg)
    noise = rng.normal(size=ideal.shape) * bench.u_mg * np.sqrt(np.repeat(count, count))[:, None]
    return np.round(readings + noise, 4)


def write(path: Path, blind: Blind, samples_mg: Floats) -> None:
    """The session as a samples CSV, which says nothing of what was put in."""
    bench: SpaceBench = blind.bench
    rows, index = bench.samples, bench.samples.order.astype(int)
    header = ["time_s", "position", "ax", "ay", "az"]
    columns = [np.char.mod("%.4f", rows.time_s), index.astype(str), *np.char.mod("%.4f", samples_mg).T]
    if bench.has_surroundings:
        header += ["temp_c", "supply_v"]
        columns += [np.char.mod("%.3f", rows.temperature_c), np.char.mod("%.4f", rows.supply_v)]
    if bench.check.any():
        header.append("use")
        columns.append(np.array(["check" if check else "fit" for check in bench.check])[index])
    lines = ["# sensor: generic", "# plane: none", "# fixture_sigma_deg: free", "# accel_unit: mg"]
    lines += [",".join(header), *map(",".join, zip(*columns, strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def oracle_rms(blind: Blind) -> tuple[float, bool]:
    """Held-out error in mg of the fit that knows the true form, and whether it is by folds."""
    check = blind.bench.check
    if check.any():
        return float(np.sqrt(np.mean(_squares(blind, ~check, check)))), False
    squares = [
        _squares(blind, k != np.arange(len(check)), k == np.arange(len(check))) for k in range(len(check))
    ]
    return float(np.sqrt(np.mean(squares))), True


def _squares(blind: Blind, fit: NDArray[np.bool_], out: NDArray[np.bool_]) -> Floats:
    """Squares in mg² of the distance from the surface that the other dwells give."""
    bench: SpaceBench = blind.bench
    lens = SpaceLens(bench, np.ones(len(bench.check), bool))
    added = sum((term.value(bench.dwells, bench.ideal_mg) for term in blind.terms), bench.zero_mg)
    left = lens.whiten((blind.readings_mg - bench.ideal_mg - added)[None])[0]
    columns = np.concatenate(
        [lens.base_rows, *(lens.whiten(term.basis(lens.rows, lens.ideal)) for term in blind.terms)]
    ).T
    size = np.maximum(np.linalg.norm(columns[fit], axis=0), 1e-12)
    columns = np.where(np.linalg.norm(columns[fit], axis=0) > 1e-9, columns / size, 0.0)
    error = left - columns @ np.linalg.lstsq(columns[fit], left[fit], rcond=1e-9)[0]
    # From standard uncertainties of the norm to mg across the surface.
    reach = np.linalg.norm(lens.row * bench.u_mg**2, axis=1)
    return (error * reach)[out] ** 2


__all__ = ["NAMES", "SPACE", "SpaceBench", "SpaceLens", "draw", "oracle_rms", "write"]
