"""The usual ways of choosing terms, on the same blind sessions as `trace`.

    pip install scikit-learn pysindy
    python scripts/trace_peers.py --sessions 100 --jobs 2

Peers: LASSO (scikit-learn; penalty by five-fold cross-validation over whole dwells, or by BIC along the
path), stepwise forward and backward by AIC and by BIC, and STLSQ of pysindy (threshold by BIC). All have
the same whitened columns, base model projected out: every catalogue name on each axis, time constants on a
grid, each single dwell, and (dictionary `all`) the nameless terms "where it enters × what drives it"
besides. Chosen columns are refitted without penalty. Peers are told the true noise of the readings, which
`trace` has to estimate.

Per kind: identification, wrong names, held-out error over that of an oracle that knows the true form
(sessions with check dwells), and seconds; `trace` stands in the same table, timed with reading the file.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from tracing.blind import KINDS, Blind, draw
from tracing.lens import Lens
from tracing.named_truth import NAMES, Term, alternatives, on_axes
from tracing.plans import Floats, Rows
from tracing.rounds import crew, rounds
from tracing.verdict import Verdict, best_attitude, judge


@dataclass(frozen=True)
class Columns:
    """Candidates of a session: whitened columns of all dwells, one label each.

    `white` (k, d, 2), `base` (6, d, 2), `target` (d, 2) whitened; `plain` the same columns in mg.
    """

    labels: tuple[tuple[str, str], ...]
    white: Floats
    plain: Floats
    base: Floats
    base_plain: Floats
    target: Floats
    target_plain: Floats
    check: np.ndarray

    def past_base(self, keep: np.ndarray) -> tuple[Floats, Floats]:
        """Columns (2n, k) of unit length and target (2n,) of some dwells without the base model's part."""
        q = np.linalg.qr(self.base[:, keep].reshape(len(self.base), -1).T)[0]
        x = self.white[:, keep].reshape(len(self.labels), -1).T
        y = self.target[keep].ravel()
        return x - q @ (q.T @ x), y - q @ (q.T @ y)


def _drivers(
    rows: Rows, surroundings: bool, approach: bool
) -> Iterator[tuple[str, Callable[[Rows], Floats]]]:
    """Functions of one covariate or two, each centred and scaled, with the covariates' names."""

    def unit(values: Floats, of: Floats) -> Floats:
        half = np.ptp(values) / 2 or 1.0
        return (of - values.min()) / half - 1

    clocks: list[tuple[str, str]] = [("time", "time_s")]
    if surroundings:
        clocks += [("temperature", "temperature_c"), ("supply", "supply_v")]
    for name, attribute in clocks:
        every = getattr(rows, attribute)
        for power in (1, 2, 3):
            yield name, lambda r, a=attribute, e=every, p=power: unit(e, getattr(r, a)) ** p
        for share in (0.2, 0.35, 0.5, 0.65, 0.8):
            edge = float(np.quantile(every, share))
            yield name, lambda r, a=attribute, c=edge: (getattr(r, a) > c) * 1.0
            yield name, lambda r, a=attribute, c=edge: np.maximum(getattr(r, a) - c, 0.0)
    if surroundings:
        for (n1, a1), (n2, a2) in (
            (clocks[1], clocks[2]),
            (clocks[0], clocks[1]),
            (clocks[0], clocks[2]),
        ):
            e1, e2 = getattr(rows, a1), getattr(rows, a2)
            yield (
                f"{n1} {n2}",
                lambda r, a1=a1, a2=a2, e1=e1, e2=e2: unit(e1, getattr(r, a1)) * unit(e2, getattr(r, a2)),
            )
    if approach:
        yield "approach", lambda r: r.approach
    for wave in (np.sin, np.cos):
        yield "previous", lambda r, w=wave: w(r.previous_rad)
    for order in (1, 2, 3, 4, 5):
        for wave in (np.sin, np.cos):
            yield "angle", lambda r, w=wave, k=order: w(k * r.angle_rad)


def nameless(rows: Rows, surroundings: bool, approach: bool) -> Iterator[tuple[str, Term]]:
    """Nameless terms with their covariates: zero, gain, true angle by every driver; powers of readings."""
    for covariates, drive in _drivers(rows, surroundings, approach):
        yield covariates, Term("", lambda r, a, f=drive: f(r)[None], np.ones(1), attitude=True)
        for axis in "xy":
            zero = on_axes(axis, lambda r, a, i, f=drive: f(r))
            gain = on_axes(axis, lambda r, a, i, f=drive: f(r) * a[:, i] / 1000)
            yield covariates, Term("", zero, np.ones(1))
            yield covariates, Term("", gain, np.ones(1))
    for axis in "xy":
        for power in (2, 3, 4, 5):
            own = on_axes(axis, lambda r, a, i, p=power: (a[:, i] / 1000) ** p)
            across = on_axes(axis, lambda r, a, i, p=power: (a[:, 1 - i] / 1000) ** p)
            yield "reading", Term("", own, np.ones(1))
            yield "reading", Term("", across, np.ones(1))
        yield "reading", Term("", on_axes(axis, lambda r, a, i: np.abs(a[:, 1 - i]) / 1000), np.ones(1))


def columns_of(blind: Blind, with_nameless: bool) -> Columns:
    """All candidates of a session, linearised at a fit of the base model."""
    bench = blind.bench
    everything = Lens(bench, use=np.ones_like(bench.check))
    rows, have = everything.rows, {"surroundings": bench.has_surroundings, "approach": bench.has_approach}
    terms: list[tuple[str, str, Term]] = []
    for name in NAMES:
        for term in alternatives(name, rows):
            if all(have[need] for need in term.needs):
                terms.append((name, "", term))
    if with_nameless:
        terms += [("", covariates, term) for covariates, term in nameless(rows, *have.values())]
    labels, plain = [], []
    for name, covariates, term in terms:
        columns = everything.plain(term)
        labels += [(name, covariates)] * len(columns)
        plain.append(columns)
    stack = np.concatenate(plain)
    fit = ~bench.check
    size = np.sqrt(np.sum(everything.whiten(stack).reshape(len(stack), -1, 2)[:, fit] ** 2, axis=(1, 2)))
    some = size > 1e-9
    stack = stack[some] / size[some, None, None]
    left = blind.readings_mg - everything.ideal

    def white(of: Floats) -> Floats:
        return everything.whiten(of).reshape(len(of), -1, 2)

    return Columns(
        tuple(label for label, good in zip(labels, some, strict=True) if good),
        white(stack),
        stack,
        white(everything.base_mg),
        everything.base_mg,
        white(left[None])[0],
        left,
        bench.check,
    )


# The methods: from unit columns (2n, k) and target (2n,) to the chosen columns --------------------------


def _scores(x: Floats, y: Floats, chosen: list[int]) -> float:
    if not chosen:
        return float(y @ y)
    return float(np.sum((y - x[:, chosen] @ np.linalg.lstsq(x[:, chosen], y, rcond=1e-8)[0]) ** 2))


def stepwise(price: Callable[[int], float], x: Floats, y: Floats, dwells: int) -> list[int]:
    """Forward and backward, each column a degree of freedom of which the criterion asks `price(n)`."""
    cost = price(len(y))
    chosen: list[int] = []
    best = float(y @ y)
    for _ in range(60):
        q = np.linalg.qr(x[:, chosen])[0] if chosen else np.zeros((len(y), 0))
        left = y - q @ (q.T @ y)
        rest = x - q @ (q.T @ x)
        norms = np.sum(rest**2, axis=0)
        gain = np.where(norms > 1e-6, (left @ rest) ** 2 / np.maximum(norms, 1e-6), 0.0)
        add = int(np.argmax(gain))
        moves = [(best - gain[add] + cost, [*chosen, add])]
        for k in chosen:
            fewer = [c for c in chosen if c != k]
            moves.append((_scores(x, y, fewer) + cost * (len(fewer) - len(chosen)), fewer))
        value, to = min(moves, key=lambda move: move[0])
        if value >= best - 1e-9 or len(to) > len(y) - 6:
            break
        chosen, best = to, _scores(x, y, to)
    return chosen


def lasso_cv(x: Floats, y: Floats, dwells: int) -> list[int]:
    """Penalty by five-fold cross-validation over whole dwells."""
    from sklearn.linear_model import LassoCV

    groups = np.repeat(np.arange(dwells) % 5, 2)
    folds = [(np.flatnonzero(groups != k), np.flatnonzero(groups == k)) for k in range(5)]
    fitted = LassoCV(cv=folds, fit_intercept=False, alphas=60, max_iter=20000, tol=1e-3).fit(x, y)
    return np.flatnonzero(np.abs(fitted.coef_) > 1e-9).tolist()


def lasso_bic(x: Floats, y: Floats, dwells: int) -> list[int]:
    """Penalty by BIC along the path, with the known noise of whitened readings."""
    from sklearn.linear_model import LassoLarsIC

    fitted = LassoLarsIC(criterion="bic", fit_intercept=False, noise_variance=1.0, max_iter=60).fit(x, y)
    return np.flatnonzero(np.abs(fitted.coef_) > 1e-9).tolist()


def stlsq(x: Floats, y: Floats, dwells: int) -> list[int]:
    """Sequentially thresholded least squares, threshold by BIC."""
    from pysindy.optimizers import STLSQ

    best: tuple[float, list[int]] = (float(y @ y), [])
    for threshold in np.geomspace(2.0, 40.0, 12):
        fitted = STLSQ(threshold=threshold, alpha=0.05, max_iter=20).fit(x, y[:, None])
        chosen = np.flatnonzero(np.abs(np.asarray(fitted.coef_).ravel()) > 0).tolist()
        if len(chosen) < len(y) - 6:
            value = _scores(x, y, chosen) + np.log(len(y)) * len(chosen)
            best = min(best, (value, chosen), key=lambda pair: pair[0])
    return best[1]


PEERS: dict[str, Callable[[Floats, Floats, int], list[int]]] = {
    "LASSO, CV": lasso_cv,
    "LASSO, BIC": lasso_bic,
    "stepwise AIC": partial(stepwise, lambda n: 2.0),
    "stepwise BIC": partial(stepwise, lambda n: float(np.log(n))),
    "STLSQ": stlsq,
}


def _heldout(blind: Blind, columns: Columns, chosen: Sequence[int]) -> float | None:
    """Held-out rms in mg of the refit of the chosen columns with the base; None without check dwells."""
    out = columns.check
    if not out.any():
        return None
    fit = ~out
    picked = np.array(chosen, dtype=int)
    both = np.concatenate([columns.base, columns.white[picked]])[:, fit]
    both = both.reshape(len(both), -1)
    size = np.linalg.norm(both, axis=1)
    answer = np.linalg.lstsq((both / size[:, None]).T, columns.target[fit].ravel(), rcond=1e-9)[0] / size
    model = np.tensordot(answer, np.concatenate([columns.base_plain, columns.plain[picked]]), axes=1)
    left = (columns.target_plain - model)[out]
    bench = blind.bench
    slope = bench.slope_mg(bench.alpha - bench.dwells.angle_rad)[out]
    cover = np.deg2rad(bench.fixture_deg) ** 2 * np.einsum("ni,nj->nij", slope, slope)
    held = best_attitude(left, slope, cover + np.diag(bench.u_mg**2), bench.fixture_deg)
    return float(np.sqrt(np.mean(held**2)))


def run_peers(index: int, kind: str, seed: int, with_nameless: bool) -> dict[str, Verdict]:
    """Every peer's verdict on one session."""
    warnings.simplefilter("ignore")  # a path that does not converge is the method's own affair
    blind, _ = draw(kind, seed, index)
    verdicts = {}
    for peer, method in PEERS.items():
        begin = time.perf_counter()
        columns = columns_of(blind, with_nameless)
        x, y = columns.past_base(~columns.check)
        chosen = method(x, y, int((~columns.check).sum()))
        seconds = time.perf_counter() - begin
        names = [columns.labels[k][0] for k in chosen]
        unnamed = [columns.labels[k][1] for k in chosen if not columns.labels[k][0]]
        error = (
            {"heldout_rms_mg": _heldout(blind, columns, [])},
            {"heldout_rms_mg": _heldout(blind, columns, chosen)},
        )
        result: dict[str, Any] = {
            "adequate": True,
            "found": [
                {"effect": n, "axes": [], "parameters": {}} for n in dict.fromkeys(filter(None, names))
            ],
            "unnamed": {"covariates": sorted({w for u in unnamed for w in u.split()}), "form": ""}
            if unnamed
            else None,
            "confounded": [],
            "error": dict(zip(("before", "after"), error, strict=True)),
        }
        verdicts[peer] = judge(blind, result, seconds)
    return verdicts


def identified(v: Verdict) -> bool:
    """Whether the cause was told: the names and nothing else, or unnamed by the right covariate."""
    if v.kind in {"uncatalogued", "beyond"}:
        return v.covariate and not v.wrong and v.found
    return v.exact


def line(kind: str, who: str, verdicts: Sequence[Verdict]) -> tuple[float, float, float, float]:
    """Print one line of the table; identified, wrong names, held-out ratio, seconds."""
    right = float(np.mean([identified(v) for v in verdicts]))
    false = float(
        np.mean([bool(v.wrong) or (v.unnamed and v.kind in {"none", "one", "two"}) for v in verdicts])
    )
    ratios = [v.heldout_ratio for v in verdicts if not np.isnan(v.heldout_ratio)]
    ratio = float(np.median(ratios)) if ratios else np.nan
    high = float(np.quantile(ratios, 0.95)) if ratios else np.nan
    spent = float(np.median([v.seconds for v in verdicts]))
    print(f"{kind:13} {who:22} {right:9.1%} {false:9.1%} {ratio:9.3f} {high:9.3f} {spent:9.3f}")
    return right, false, ratio, spent


def main() -> int:
    """Print the table and say where `trace` is not ahead."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument(
        "--columns", choices=["named", "all"], default="all", help="dictionary of the peers"
    )
    parser.add_argument("--without-trace", action="store_true", help="the peers only")
    options = parser.parse_args()
    packages = {"scikit-learn": "sklearn", "pysindy": "pysindy"}
    missing = [name for name, module in packages.items() if find_spec(module) is None]
    if missing:
        raise SystemExit(f"{' and '.join(missing)} not installed: pip install {' '.join(missing)}")

    behind = []
    head = ("kind", "method", "right", "false", "held-out", "its 95 %", "seconds")
    print(f"{head[0]:13} {head[1]:22} " + " ".join(f"{word:>9}" for word in head[2:]))
    with crew(options.jobs) as pools:
        for kind in KINDS if options.kind == "all" else (options.kind,):
            task = partial(run_peers, kind=kind, seed=options.seed, with_nameless=options.columns == "all")
            answers = list(pools[0].map(task, range(options.sessions), chunksize=2))
            theirs = {peer: line(kind, peer, [answer[peer] for answer in answers]) for peer in PEERS}
            if options.without_trace:
                continue
            own = line(kind, "trace", rounds(kind, range(options.sessions), options.seed, pools))
            for peer, (right, false, ratio, spent) in theirs.items():
                lost = [
                    word
                    for word, bad in (
                        ("identification", own[0] < right),
                        ("false findings", own[1] > false),
                        ("held-out error", own[2] > ratio),
                        ("time", own[3] > spent),
                    )
                    if bad
                ]
                if lost:
                    behind.append(f"{kind}: {peer} is ahead in {', '.join(lost)}")
    if options.without_trace:
        return 0
    print("\n".join(behind) if behind else "trace is ahead of, or level with, every peer in every column")
    return 0


if __name__ == "__main__":
    sys.exit(main())
