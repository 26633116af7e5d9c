"""Compute what the rows of `trace` can reach at best: oracles that know how the sessions were drawn.

    python scripts/trace_limits.py two --sessions 300 --seed 114358700
    python scripts/trace_limits.py ladder --family two --sessions 100 --secret "t29 1208031785 two"
    python scripts/trace_limits.py strangers --sessions 240 --seed 3861329667

Blind sessions (`none`, `one`, `two`, `uncatalogued`, `beyond` of tests/tracing)
    The oracle knows the noise, the candidates, the distribution of their amplitudes and all unnamed shapes.
    It weighs every model of up to two causes; the five kinds are equally probable. Random functions are
    Gaussian processes; the other shapes are a list of draws that contains the true shape.
Ladder (benchmarks/blind_residual)
    The oracle of the benchmark. It also knows the causes that the catalogue does not have, by draws, with
    the share that the generator gives them. A cause is claimed if it is more than 95 % certain that there
    is one.
Strangers (benchmarks/strangers)
    *List*: the oracle knows a list of 6000 shapes that contains the true one; a kind and a name are equally
    probable. *Smooth*: it knows the place and the covariates of the true cause, and takes it for a smooth
    function of them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from benchmarks.strangers import score as judge, session as sessions
from benchmarks.strangers.kinds import KINDS as STRANGERS

from adis_gonio import load_session
from adis_gonio.base.uncertainty import wilson
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import ACCELEROMETER, readings_of_part
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.thresholds import limits
from blind_residual import generator
from blind_residual.catalogue import NAMES as LADDER_NAMES, terms as ladder_terms
from blind_residual.causes import CAUSES, names_of
from blind_residual.oracle import CLAIM, PRIOR, Weighing
from tracing.blind import FOREIGN, KINDS, SEEN, SIZES, Blind, draw
from tracing.lens import Lens
from tracing.named_truth import LASTING, NAMES, OF_ONE_AXIS, Term, catalogued_term
from tracing.plans import Floats
from tracing.undeclared import BEYOND, GRAMMAR
from tracing.verdict import drives, innocent, is_right_set

Outcomes = dict[str, float]
Answer = tuple[frozenset[str], tuple[str, ...] | None]
"""Names, and the covariates of a cause without a name."""

# -- blind sessions ------------------------------------------------------------------------------------

PROCESSES = {
    "smooth_of_angle": ("bias", "angle", (0.47, 0.63)),
    "smooth_turn_of_angle": ("turn", "angle", (0.41, 0.54)),
    "smooth_of_temperature": ("bias", "temperature", (0.18, 0.25)),
    "smooth_of_time": ("bias", "time", (0.15, 0.22)),
    "gain_wanders": ("gain", "time", (0.18, 0.25)),
    "lean_wanders": ("lean", "time", (0.18, 0.25)),
}
"""Shapes that are random functions: place, covariate, lengths."""
DRAWS = 40
"""Draws of each other shape."""
KEPT = 150
"""Models of a class whose evidence is integrated over the amplitudes."""
EQUAL = {"cross_quadratic": "quadratic"}
"""In a plane the squares of both readings add up to a constant, which is a bias."""
_NORMAL = np.random.default_rng(0).normal(size=(64, 4))


@dataclass(frozen=True)
class Block:
    """Whitened columns (k, rows) of one way in which a cause acts, and the log of its prior share."""

    names: tuple[str, ...]
    covariates: tuple[str, ...] | None
    share: float
    x: Floats

    @property
    def seen(self) -> bool:
        """True if each column has a part outside the base model."""
        return float(np.linalg.norm(self.x, axis=1).min()) > 1e-6


def named_blocks(blind: Blind, lens: Lens) -> list[Block]:
    """Return a block for each name of the catalogue in each way in which the generator draws it."""
    bench, rows = blind.bench, lens.rows
    taus = bench.dwells.time_s[-1] * np.geomspace(0.05, 0.4, 35)[1::2]
    angles = len(np.unique(np.round(np.mod(rows.angle_rad, 2 * np.pi), 6)))
    able = [name for name in NAMES if _can_show(blind, catalogued_term(name, "x", 3.0))]
    blocks = []
    for name in able:
        axes = {"x": 1 / 3, "y": 1 / 3, "xy": 1 / 3}
        choices: Sequence[float] = (0.0,)
        if name in OF_ONE_AXIS:
            axes = {"x": 2 / 3, "y": 1 / 3}
        elif catalogued_term(name, "x", 3.0).attitude or name == "outlier_dwell":
            axes = {"xy": 1.0}
        if name == "stage_periodic":
            choices = range(3, max((angles - 1) // 2, 3) + 1)
        elif name in LASTING:
            choices = taus.tolist()
        elif name in {"position_slip", "outlier_dwell"}:
            choices = np.flatnonzero(~bench.check)[1:].tolist()
        for own, part in axes.items():
            share = float(np.log(part / len(choices) / len(able)))
            blocks += [
                Block((name,), None, share, lens.columns(catalogued_term(name, own, float(choice))))
                for choice in choices
            ]
    return [block for block in blocks if block.seen]


def _can_show(blind: Blind, term: Term) -> bool:
    have = {"surroundings": blind.bench.has_surroundings, "approach": blind.bench.has_approach}
    return all(have[need] for need in term.needs)


def _said(term: Term) -> tuple[str, ...]:
    """Return the covariates of a shape; if the judge accepts either of two, the first one."""
    return (term.covariates[0].split("|")[0],) if len(term.covariates) == 1 else term.covariates


def shape_blocks(blind: Blind, lens: Lens, rng: np.random.Generator) -> list[Block]:
    """Return blocks of draws of the shapes without a name; the true shape is among them."""
    blocks = []
    for shapes in (GRAMMAR, BEYOND):
        for name, make in shapes.items():
            if name in PROCESSES:
                continue
            drawn = [make(rng, blind.bench.dwells) for _ in range(DRAWS)]
            drawn = [term for term in drawn if _can_show(blind, term)]
            drawn += [term for term in blind.terms[:1] if drawn and term.name == drawn[0].name]
            share = -float(np.log(max(len(drawn), 1) * len(shapes)))
            blocks += [Block((), _said(term), share, lens.columns(term)) for term in drawn]
    return [block for block in blocks if block.seen]


def process_blocks(blind: Blind, lens: Lens) -> Iterator[Block]:
    """Yield features of the random functions: their products are the covariance of the process."""
    axes = [((1.0, 0.0), 1 / 3), ((0.0, 1.0), 1 / 3)]
    axes += [((1.0, sign * ratio), 1 / 12) for sign in (1, -1) for ratio in (0.7, 1.4)]
    values = {
        "angle": lens.rows.angle_rad,
        "temperature": lens.rows.temperature_c,
        "time": lens.rows.time_s,
    }
    sizes = np.linspace(*SIZES, 5)[:-1] + 1
    for place, on, lengths in PROCESSES.values():
        span = float(np.ptp(values[on]))
        if (on == "temperature" and not blind.bench.has_surroundings) or span < 1e-6:
            continue
        apart = values[on][:, None] - values[on]
        for length in lengths:
            near = 2 * np.sin(apart / 2) ** 2 if on == "angle" else 0.5 * (apart / span) ** 2
            w, v = np.linalg.eigh(np.exp(-near / length**2))
            features = (v * np.sqrt(np.maximum(w, 0)))[:, w > 1e-4 * w.max()].T
            for sides, part in axes if place != "turn" else [((1.0, 1.0), 1.0)]:
                own = lens.ideal / 1000
                drive = {"bias": np.ones_like(own), "gain": own, "lean": own[:, ::-1]}
                drive["turn"] = np.deg2rad(lens.slope)
                white = lens.whiten(features[:, :, None] * drive[place] * np.array(sides))
                x = lens.past_base(white)
                # A process has a peak of about twice its standard deviation.
                scale = np.sqrt((x[:, np.abs(white).sum(axis=0) > 0] ** 2).sum(axis=0).mean())
                share = float(np.log(part / len(lengths) / len(sizes) / len(BEYOND)))
                for size in sizes if scale > 1e-12 else ():
                    yield Block((), (on,), share, x / scale * size / 2)


def log_density(x: Floats, a: Floats) -> Floats:
    """Return the log of the generator's density (m,) at coefficients a (m, k) of a block's columns x."""
    peak = np.abs(a @ x).max(axis=1)
    inside = (peak > SIZES[0]) & (peak < SIZES[1])
    width = SIZES[1] - SIZES[0]
    if len(x) == 1:
        return np.where(inside, np.log(np.abs(x).max() / (2 * width)), -np.inf)
    # Two coefficients: signs and ratio by their parts of 0.5 to 1, the length by the peak.
    length = np.linalg.norm(a, axis=1) + 1e-300
    least, most = (np.sort(np.abs(a), axis=1) / length[:, None]).T + 1e-300
    of_ratio = np.maximum(0.5 * ((1 / most) ** 2 - (0.5 / least) ** 2), 1e-300) / 0.25
    density = of_ratio / 4 * peak / (width * length**2)
    return np.where(inside & (most < 2 * least), np.log(density), -np.inf)


def evidence(y: Floats, blocks: Sequence[Block], others: Sequence[Floats] = ()) -> float:
    """Return the log evidence of a model, integrated over the amplitudes as they are drawn.

    A first block without a name must differ from each of the names with the orthonormal columns `others`.
    """
    x = np.concatenate([block.x for block in blocks])
    gram = x @ x.T
    try:
        root = np.linalg.cholesky(gram)
    except np.linalg.LinAlgError:
        return -np.inf
    along = np.linalg.solve(root, x @ y)
    best = np.linalg.solve(root.T, along)
    drawn = best + np.linalg.solve(root.T, _NORMAL[:, : len(x)].T).T
    logs = np.zeros(len(drawn))
    begin = 0
    for block in blocks:
        own = np.arange(begin, begin + len(block.x))
        rest = np.setdiff1d(np.arange(len(x)), own)
        part = gram[np.ix_(own, own)]
        part = part - gram[np.ix_(own, rest)] @ np.linalg.solve(
            gram[np.ix_(rest, rest)], gram[np.ix_(rest, own)]
        )
        a = drawn[:, own]
        visible = np.einsum("mi,ij,mj->m", a, part, a) >= SEEN
        logs += np.where(visible, log_density(block.x, a), -np.inf) + block.share
        begin += len(own)
    if len(others):
        target = best[: len(blocks[0].x)] @ blocks[0].x
        if target @ target - max(float(((q @ target) ** 2).sum()) for q in others) < FOREIGN:
            return -np.inf
    volume = len(x) / 2 * np.log(2 * np.pi) - np.log(np.diag(root)).sum()
    return float(along @ along / 2 + volume + logsumexp(logs) - np.log(len(drawn)))


class Screen:
    """Blocks with orthonormal columns, padded to two, for a quick score of single blocks and of pairs."""

    def __init__(self, blocks: Sequence[Block], rows: int) -> None:
        self.u, self.price = np.zeros((len(blocks), 2, rows)), np.full(len(blocks), -np.inf)
        for i, block in enumerate(blocks):
            scaled = block.x / np.abs(block.x).max(axis=1, keepdims=True)
            q, r = np.linalg.qr(scaled.T)
            size = np.abs(np.diag(r))
            if size.min() > 1e-3:
                self.u[i, : len(scaled)] = q.T
                density = {1: 1 / 16, 2: 1 / 150}[len(scaled)] * (2 * np.pi) ** (len(scaled) / 2)
                self.price[i] = np.log(density) - np.log(size).sum() + block.share

    def alone(self, y: Floats) -> Floats:
        """Return the score (m,) of each block."""
        return np.asarray(((self.u @ y) ** 2).sum(axis=1) / 2 + self.price)

    def with_second(self, y: Floats, second: Screen) -> Floats:
        """Return the score (m, m') of each pair of a block and a block of `second`."""
        mine, theirs = self.u @ y, second.u @ y
        cross = np.einsum("air,bjr->abij", self.u, second.u, optimize=True)
        left = theirs - np.einsum("abij,ai->abj", cross, mine)
        gain, det = quadratic_form(np.eye(2) - np.einsum("abij,abik->abjk", cross, cross), left)
        price = self.price[:, None] + second.price - np.log(np.maximum(det, 1e-9)) / 2
        first = (mine**2).sum(axis=1)[:, None]
        return np.where(det > 1e-4, (first + gain) / 2 + price, -np.inf)


def quadratic_form(m: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return zᵀ m⁻¹ z and the determinant of symmetric matrices m (…, 2, 2), for z (…, 2)."""
    det = m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] ** 2
    form = m[..., 1, 1] * z[..., 0] ** 2 + m[..., 0, 0] * z[..., 1] ** 2
    form = form - 2 * m[..., 0, 1] * z[..., 0] * z[..., 1]
    return form / np.maximum(det, 1e-9), det


def best_first(scores: Floats, count: int) -> list[int]:
    """Return the indices of the largest finite scores."""
    order = np.argsort(-scores, axis=None)[:count]
    return [int(k) for k in order if np.isfinite(scores.flat[k])]


def blind_posterior(blind: Blind, lens: Lens, seed: Sequence[int]) -> dict[Answer, float]:
    """Return the probability of each answer to a blind session."""
    fit = ~blind.bench.check
    misfit = blind.readings_mg[fit] - lens.ideal - blind.bench.zero_mg
    y = lens.past_base(lens.whiten(misfit[None]))[0]
    names = named_blocks(blind, lens)
    shapes = shape_blocks(blind, lens, np.random.default_rng(seed))
    spans = [np.linalg.qr(block.x.T)[0].T for block in names]
    by_name, by_shape = Screen(names, len(y)), Screen(shapes, len(y))
    # The two kinds without a name are in company in a third of the sessions.
    alone, company = np.log(2 / 3), np.log(1 / 3)
    scored: list[tuple[Answer, float]] = [((frozenset(), None), 0.0)]

    def score(prior: float, *blocks: Block) -> None:
        covariates = blocks[0].covariates
        word = frozenset(name for block in blocks for name in block.names)
        value = evidence(y, blocks, spans if covariates else ())
        scored.append(((word, covariates), float(prior) + value))

    single = by_name.alone(y)
    for k in best_first(single, KEPT):
        score(0.0, names[k])
    label = np.array([block.names[0] for block in names])
    pairs = by_name.with_second(y, by_name)
    pairs[(label[:, None] == label) | np.tri(len(names), dtype=bool)] = -np.inf
    count = len(set(label))
    for k in best_first(pairs, 2 * KEPT):
        i, j = divmod(k, len(names))
        score(np.log(2 * count / (count - 1)), names[i], names[j])
    for k in best_first(by_shape.alone(y), KEPT):
        score(alone, shapes[k])
    span = spans[int(np.argmax(single))]
    rest = y - span.T @ (span @ y)
    chosen = sorted({*best_first(by_shape.alone(y), 80), *best_first(by_shape.alone(rest), 80)})
    some = [shapes[k] for k in chosen]
    for k in best_first(Screen(some, len(y)).with_second(y, by_name), KEPT):
        i, j = divmod(k, len(names))
        score(company, some[i], names[j])
    for block in process_blocks(blind, lens):
        w, v = np.linalg.eigh(block.x @ block.x.T)
        w = np.maximum(w, 0)
        root = (v.T @ block.x) / np.sqrt(1 + w)[:, None]
        value = float(((root @ y) ** 2).sum() - np.log1p(w).sum()) / 2 + block.share
        scored.append(((frozenset(), block.covariates), alone + value))
        along = by_name.u @ root.T
        matrix = np.eye(2) - np.einsum("aiq,ajq->aij", along, along)
        gain, det = quadratic_form(matrix, by_name.u @ y - along @ (root @ y))
        both = gain / 2 + by_name.price - np.log(np.maximum(det, 1e-9)) / 2
        for k in best_first(np.where(det > 1e-6, both, -np.inf), 5):
            answer = frozenset(names[k].names), block.covariates
            scored.append((answer, float(company + value + both[k])))
    total = logsumexp([value for _, value in scored])
    posterior: dict[Answer, float] = defaultdict(float)
    for answer, value in scored:
        posterior[answer] += float(np.exp(value - total))
    return posterior


def is_right(blind: Blind, lens: Lens, answer: Answer) -> bool:
    """Judge an answer as scripts/trace_statistics.py does."""
    names, covariates = answer
    if blind.undeclared:
        return covariates is not None and drives(blind.terms[0], list(covariates), lens)
    if covariates is not None:
        return False
    return names == blind.names or (bool(names) and is_right_set(blind, lens, tuple(names)))


def blind_outcomes(kind: str, seed: int, index: int) -> Outcomes:
    """Outcomes of one blind session."""
    blind, _ = draw(kind, seed, index)
    lens = Lens(blind.bench)
    posterior = blind_posterior(blind, lens, (seed, 7, index))
    likely = max(posterior, key=posterior.__getitem__)
    each: Counter[str] = Counter()
    together: Counter[str] = Counter()
    for (names, _), share in posterior.items():
        each.update(dict.fromkeys(names, share))
        together.update(dict.fromkeys({EQUAL.get(name, name) for name in names}, share))
    nameless = {answer: share for answer, share in posterior.items() if answer[1] is not None}
    stated = frozenset(name for name, share in each.items() if share >= limits.certain)
    leading = {EQUAL.get(name, name): name for name, _ in reversed(each.most_common())}
    equals = frozenset(leading[name] for name, share in together.items() if share >= limits.certain)
    said = None
    if sum(nameless.values()) >= limits.certain:
        said = max(nameless, key=nameless.__getitem__)[1]
    return {
        "right, the most probable answer": is_right(blind, lens, likely),
        "right, names from 55 % on": is_right(blind, lens, (stated, said)),
        "right, equal names counted together": is_right(blind, lens, (equals, said)),
        "a wrong name": any(not innocent(name, blind, lens) for name in equals),
    }


# -- ladder --------------------------------------------------------------------------------------------


def ladder_outcomes(secret: str, family: str, index: int) -> Outcomes:
    """Outcomes of one session of the ladder: shares of the true names in sets that are claimed."""
    _, truth = generator.draw(secret, index, family)
    linear = truth.problem()
    c, rows = linear.c, int(linear.fit.sum())
    weighing = Weighing(linear, [t for name in LADDER_NAMES for t in ladder_terms(name, c, linear.ideal_g)])
    share = generator.FAMILIES
    nothing = share["nothing"] + share["bias"] + share["within"]
    prior = np.array([nothing, share["catalogue"], share["two"]])
    size = np.array([len(model) for model in weighing.models])
    logs = np.log(np.maximum(weighing.weight, 1e-300) / weighing.weight[0])
    logs += np.log(PRIOR["nothing"] * prior / np.array(list(PRIOR.values())))[size]
    have = {
        "temperature": not np.isnan(c.temp_c).any(),
        "supply": not np.isnan(c.supply_v).any(),
        "approach": np.ptp(c.approach) > 0,
        "vibration": np.ptp(c.variance_mg2) > 0,
        "fine_angles": True,
    }
    rng = np.random.default_rng([5, index])
    nameless = [name for kind in ("foreign", "stranger") for name in names_of(kind)]
    others = []
    for cause in (CAUSES[name] for name in nameless):
        if not (cause.plane if c.plane else cause.space) or not all(have[need] for need in cause.needs):
            continue
        gains = []
        for _ in range(30):
            try:
                made = cause.make(c, linear.ideal_g, rng)
            except ValueError:  # this session cannot have it
                continue
            columns = linear.rows(made.reading[:, :, None], made.angle[:, None])
            gains.append(weighing.white.gain(columns) if np.isfinite(columns).all() else 0.0)
        if gains:
            others.append(logsumexp((np.array(gains) - np.log(rows)) / 2) - np.log(len(gains)))
    each = (share["foreign"] + share["stranger"]) / len(nameless)
    unknown = logsumexp(others) + np.log(each) if others else -np.inf
    total = np.logaddexp(logsumexp(logs), unknown)
    claimed = np.exp(logs[0] - total) <= 1 - CLAIM
    if not truth.names:
        return {"something claimed": bool(claimed)}
    sets = [set(cause["names"]) for cause in weighing.causes()]
    right = sum(any(name in one for one in sets) for name in truth.names) / len(truth.names)
    least = min(truth.gain)
    rung = next(
        (f"{a} to {b}" for a, b in ((10, 16), (16, 30), (30, 50)) if a <= least < b),
        "from 50 on" if least >= 50 else "below 10",
    )
    return {f"gain {rung}": right * float(claimed and np.exp(unknown - total) < 0.5)}


# -- strangers -----------------------------------------------------------------------------------------

EACH = 100
"""Shapes of each kind in the list."""
LENGTHS = (0.1, 0.18, 0.32, 0.56, 1.0)
AMPLITUDES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


class View:
    """Whitened rows of a session of a stranger; `fit` are the rows of dwells that are no check dwells."""

    def __init__(self, one: sessions.StrangeSession) -> None:
        self.one, self.bench = one, one.bench
        self.fit = (~self.bench.check).repeat(2)
        self.base = sessions.base_columns(self.bench)
        self.q = np.linalg.qr(self.base[self.fit])[0]
        self.y = self.white(sessions.dwell_means(one))
        self.rest = self.past_base(self.y)

    def white(self, values: Floats) -> Floats:
        """Whiten changes (n, 2) of the readings to (2 n,)."""
        return np.asarray(sessions.whiten(self.bench, values).ravel())

    def past_base(self, columns: Floats) -> Floats:
        """Return the rows of the fit outside the base model."""
        rows = columns[self.fit]
        return np.asarray(rows - self.q @ (self.q.T @ rows))

    def errors(self, added: Floats) -> tuple[float, float]:
        """Return the rms of check dwells and of the other dwells if the cause contributes `added`."""
        left = self.y - added
        solved = np.linalg.lstsq(self.base[self.fit], left[self.fit], rcond=None)[0]
        mg, _ = sessions.unwhiten(self.bench, (left - self.base @ solved).reshape(-1, 2))
        return sessions.rms(mg[self.bench.check]), sessions.rms(mg[~self.bench.check])

    def residual_left(self, check_mg: float, fit_mg: float) -> bool:
        """Return True if noise alone does not leave these errors."""
        p = (
            sessions.noise_alone(self.bench, True, check_mg),
            sessions.noise_alone(self.bench, False, fit_mg),
        )
        return min(p) < judge.UNLIKELY / 2


def listed(view: View, rng: np.random.Generator) -> tuple[list[str], Floats]:
    """Return the kind and the whitened column (2 n, m) of each shape of the list, the truth first."""
    names, columns = [view.one.kind.name], [view.white(view.one.basis_mg)]
    for kind in STRANGERS.values():
        for _ in range(EACH):
            axis = int(rng.integers(2))
            shape = kind.shape(view.bench, rng, axis)
            ratio = rng.choice([-1, 1]) * rng.uniform(0.4, 1.5)
            names.append(kind.name)
            columns.append(view.white(sessions.placed_basis(kind, view.bench, shape, axis, ratio)))
    return names, np.column_stack(columns)


def weigh_listed(view: View, columns: Floats) -> tuple[Floats, Floats]:
    """Return the log evidence (m,) of each column and its mean amplitude; sizes as they are drawn."""
    fitted, rest = columns[view.fit], view.past_base(columns)
    length = np.linalg.norm(rest, axis=0)
    seen = length > sessions.LEAST_SEEN * np.linalg.norm(fitted - fitted.mean(axis=0), axis=0)
    length = np.where(seen, length, 1.0)
    sizes = np.geomspace(sessions.WEAKEST, sessions.STRONGEST, 400) * np.sqrt(view.fit.sum() / 2)
    sizes = np.concatenate([sizes, -sizes])
    logs = np.outer(view.rest @ rest / length, sizes) - sizes**2 / 2 - np.log(len(sizes))
    total = logsumexp(logs, axis=1)
    mean = np.exp(logs - total[:, None]) @ sizes / length
    return np.where(seen, total, -np.inf), mean


def weigh_names(view: View) -> dict[str, float]:
    """Return the log evidence of each name of the catalogue, with the amplitudes of the trace's prior."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.csv"
        path.write_text(view.one.csv, encoding="utf-8")
        data = readings_of_part(load_session(path), ACCELEROMETER).training
    fit = Fit.begin(data).refit()
    found: dict[str, list[float]] = defaultdict(list)
    for term in named_terms(data)[0]:
        if term.constant:
            continue
        raw = fit.candidate(term)
        whole = np.zeros((len(view.bench.check), 2, raw.shape[2]))
        whole[~view.bench.check] = raw
        rest = view.past_base(np.column_stack([view.white(whole[:, :, k]) for k in range(raw.shape[2])]))
        u, s, _ = np.linalg.svd(rest, full_matrices=False)
        u = u[:, s > 1e-6 * max(s[0], 1e-300)]
        grown = 1 + limits.prior_snr**2 / (u**4).sum(axis=0)
        gain = (u.T @ view.rest) ** 2 * (1 - 1 / grown) - np.log(grown)
        found[str(term.name)].append(float(gain.sum()) / 2)
    return {name: float(logsumexp(logs) - np.log(len(logs))) for name, logs in found.items()}


def smooth_prediction(view: View) -> tuple[Floats, float]:
    """Predict the cause as a smooth function of its true covariates at its true place.

    The first result (2 n,) is the mean over lengths and amplitudes. The second is the p-value of the check
    dwells under the best of these processes, by the exact covariance of the prediction.
    """
    bench, kind = view.bench, view.one.kind
    values = {
        "temperature": bench.temp_c,
        "temperature_rate": np.gradient(bench.temp_c, bench.time_s),
        "supply": bench.supply_v,
        "time": bench.time_s,
        "order": np.arange(float(len(bench.time_s))),
        "approach": bench.approach,
        "angle": bench.theta,
        "previous_angle": np.concatenate([bench.theta[:1], bench.theta[:-1]]),
    }
    causes = kind.causes - {"order"} if "time" in kind.causes else kind.causes
    distance = np.zeros((len(bench.time_s),) * 2)
    for name in causes:
        v = values[name]
        turns = name in {"angle", "previous_angle"}
        apart = np.sin((v[:, None] - v) / 2) if turns else (v[:, None] - v) / max(np.ptp(v), 1e-9)
        distance += apart**2
    logs, means, best = [], [], (-np.inf, np.zeros((0, 0)))
    for length in LENGTHS:
        w, v = np.linalg.eigh(np.exp(-0.5 * distance / length**2))
        roots = (v * np.sqrt(np.maximum(w, 0)))[:, w > 1e-9].T
        axis = int(view.one.axis == "y")
        placed = [sessions.placed_basis(kind, bench, root, axis, 0.0) for root in roots]
        placed += [one[:, ::-1] for one in placed if kind.enters == "zeros"]
        features = np.column_stack([view.white(one) for one in placed])
        u, s, vt = np.linalg.svd(view.past_base(features), full_matrices=False)
        unit = float(np.mean((features[view.fit] ** 2).sum(axis=1)))
        for amplitude in AMPLITUDES:
            prior = amplitude**2 / unit
            grown, along = 1 + prior * s**2, u.T @ view.rest
            logs.append(float((prior * s**2 * along**2 / grown - np.log(grown)).sum()) / 2)
            means.append(features @ (vt.T @ (prior * s * along / grown)))
            best = max(best, (logs[-1], features * np.sqrt(prior)), key=lambda item: item[0])
    weight = np.exp(np.array(logs) - max(logs))
    # Covariance of all rows: noise, process and a base model without a prior.
    whole = np.eye(len(view.y)) + best[1] @ best[1].T + 1e6 * view.base @ view.base.T
    fit, check = np.ix_(view.fit, view.fit), np.ix_(~view.fit, ~view.fit)
    gain = np.linalg.solve(whole[fit], whole[np.ix_(view.fit, ~view.fit)]).T
    left = view.y[~view.fit] - gain @ view.y[view.fit]
    spread = whole[check] - gain @ whole[np.ix_(view.fit, ~view.fit)]
    p = float(chi2.sf(left @ np.linalg.solve(spread, left), len(left)))
    return np.column_stack(means) @ (weight / weight.sum()), p


def stranger_outcomes(seed: int, index: int) -> Outcomes:
    """Outcomes of one session of a stranger."""
    one = sessions.session_of(index, seed)
    view, true = View(one), sessions.consult_oracle(one)
    kinds, columns = listed(view, np.random.default_rng([seed, 3, index]))
    logs, means = weigh_listed(view, columns)
    by_name = weigh_names(view)
    of_list = logs - np.log(len(STRANGERS) * EACH)
    of_names = np.array(list(by_name.values())) - np.log(len(by_name))
    total = logsumexp(np.concatenate([of_list, of_names]))
    wrong = [
        float(np.exp(value - total))
        for name, value in zip(by_name, of_names, strict=True)
        if not judge.is_fair(one.kind, name)
    ]
    weight = np.exp(logs - logsumexp(logs))
    check, _ = view.errors(columns @ np.where(weight > 0, weight * means, 0.0))
    smooth, p = smooth_prediction(view)
    smooth_check, smooth_fit = view.errors(smooth)
    fits = sessions.noise_alone(view.bench, False, smooth_fit) >= limits.adequate
    out: Outcomes = {
        "list: a wrong name": max(wrong) >= limits.certain,
        "list: a wrong name has more than 95 %": max(wrong) > judge.CERTAIN,
        "list: the right kind": kinds[int(np.argmax(weight))] == one.kind.name,
        "smooth: adequate although a residual is left": fits
        and p >= limits.adequate
        and view.residual_left(smooth_check, smooth_fit),
    }
    for word, error in (("true shape", true.check_mg), ("list", check), ("smooth", smooth_check)):
        out[f"{word}: check dwells worse than with bias alone"] = error > 1.02 * true.bias_check_mg
        out[f"{word}: check error above 1.3 times the oracle's"] = error > judge.TOO_LARGE * true.check_mg
    return out


def main() -> None:
    """Draw, weigh and print a rate for each outcome."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=[*KINDS, "ladder", "strangers"])
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--secret", default="1", help="of the ladder")
    parser.add_argument("--family", default="catalogue", choices=("nothing", "catalogue", "two"))
    given = parser.parse_args()
    outcomes: Callable[..., Any] = blind_outcomes
    arguments: tuple[Any, ...] = (given.kind, given.seed)
    if given.kind == "ladder":
        outcomes, arguments = ladder_outcomes, (given.secret, given.family)
    elif given.kind == "strangers":
        outcomes, arguments = stranger_outcomes, (given.seed,)
    found: dict[str, list[float]] = defaultdict(list)
    for index in range(given.sessions):
        for what, value in outcomes(*arguments, index).items():
            found[what].append(float(value))
    for what, values in found.items():
        low, high = wilson(round(sum(values)), len(values))
        count = f"{sum(values):6g} of {len(values):3}"
        print(f"{what:58} {count}  {np.mean(values):6.1%}  [{low:.1%}, {high:.1%}]")


if __name__ == "__main__":
    main()
